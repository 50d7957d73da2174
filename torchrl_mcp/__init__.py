"""Multiplicative Compositional Policies as TorchRL components.

Reference:
    Peng, Chang, Zhang, Abbeel and Levine, "MCP: Learning Composable Hierarchical Control with
    Multiplicative Compositional Policies", NeurIPS 2019, https://arxiv.org/abs/1905.09808
"""

from itertools import product

import gymnasium

__version__ = "0.1.0"

TASKS = ("Carry", "Dribble", "Heading", "Imitation", "Location")
NAMES = [*product(TASKS, ("biped", "humanoid", "trex")), ("Holdout", "ant")]
"""Tasks and characters of the Gymnasium environments, such as ``torchrl_mcp/Heading-Biped-v0``."""

for task, character in NAMES:
    gymnasium.register(
        f"torchrl_mcp/{task}-{character.capitalize()}-v0",
        entry_point="torchrl_mcp.envs.gymnasium_env:make",  # imported when an environment is made
        kwargs={"task": task, "character": character},
    )
