"""The humanoid."""

from torchrl_mcp.envs.characters.character import Character

HUMANOID = Character(
    name="humanoid",
    feet=("right_ankle", "left_ankle"),
    key_bodies=("neck", "right_wrist", "left_wrist", "right_ankle", "left_ankle"),
    carrier="chest",
)
"""34 degrees of freedom, 28 controls, 45 kg, 1.62 m (Table 3)."""
