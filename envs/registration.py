"""Names by which ``gymnasium.make`` knows the tasks, such as ``torchrl_mcp/Heading-Biped-v0``."""

from itertools import product

import gymnasium

TASKS = ("Carry", "Dribble", "Heading", "Imitation", "Location")
CHARACTERS = ("biped", "humanoid", "trex")


def register() -> None:
    """Register every task with every character that can do it."""
    for task, character in (*product(TASKS, CHARACTERS), ("Holdout", "ant")):
        gymnasium.register(
            f"torchrl_mcp/{task}-{character.capitalize()}-v0",
            entry_point="torchrl_mcp.envs.gymnasium_env:make",  # imported when an environment is made
            kwargs={"task": task, "character": character},
        )
