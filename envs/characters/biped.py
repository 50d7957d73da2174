"""The biped: two legs and a torso."""

from torchrl_mcp.envs.characters.character import Character

BIPED = Character(
    name="biped",
    feet=("right_ankle", "left_ankle"),
    key_bodies=("right_ankle", "left_ankle"),
    carrier="torso",
)
"""23 degrees of freedom, 17 controls, 42 kg, 1.34 m (Table 3)."""
