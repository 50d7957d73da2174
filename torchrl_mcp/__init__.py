"""Multiplicative Compositional Policies as TorchRL components.

Reference:
    Peng, Chang, Zhang, Abbeel and Levine, "MCP: Learning Composable Hierarchical Control with
    Multiplicative Compositional Policies", NeurIPS 2019, https://arxiv.org/abs/1905.09808
"""

from itertools import product
from pathlib import Path

import gymnasium

__version__ = "0.1.0"

# Without them Python may find torchrl_mcp.envs and torchrl_mcp.conf in another clone that is installed.
for folder in (Path(__file__).with_name(name) for name in ("conf", "envs")):
    if not folder.is_dir():
        raise ImportError(
            f"{folder} must be a folder, in a clone a link to ../{folder.name}: let Git write links by "
            f"`git config core.symlinks true`, then run `git checkout -- torchrl_mcp/conf torchrl_mcp/envs`"
        )

TASKS = ("Carry", "Dribble", "Heading", "Imitation", "Location")
NAMES = [*product(TASKS, ("biped", "humanoid", "trex")), ("Holdout", "ant")]
"""Tasks and characters of the Gymnasium environments, such as ``torchrl_mcp/Heading-Biped-v0``."""

for task, character in NAMES:
    gymnasium.register(
        f"torchrl_mcp/{task}-{character.capitalize()}-v0",
        entry_point="torchrl_mcp.envs.gymnasium_env:make",  # imported when an environment is made
        kwargs={"task": task, "character": character},
    )
