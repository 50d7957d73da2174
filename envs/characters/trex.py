"""The T-Rex."""

from torchrl_mcp.envs.characters.character import Character

TREX = Character(
    name="trex",
    feet=("right_toe", "left_toe"),
    key_bodies=("head", "tail_5", "right_toe", "left_toe"),
    carrier="head",
)
"""A Tyrannosaurus of 54.5 kg with its head at 1.66 m: 15 ball joints, hinges at knees and ankles."""
