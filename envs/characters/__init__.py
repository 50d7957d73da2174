"""Simulated bodies in MuJoCo, without tasks."""

from torchrl_mcp.envs.characters.ant import ant
from torchrl_mcp.envs.characters.biped import BIPED
from torchrl_mcp.envs.characters.character import Character
from torchrl_mcp.envs.characters.humanoid import HUMANOID
from torchrl_mcp.envs.characters.trex import TREX

CHARACTERS = {character.name: character for character in (BIPED, HUMANOID, TREX)}
"""The characters under PD control, by name."""

__all__ = ["BIPED", "CHARACTERS", "HUMANOID", "TREX", "Character", "ant"]
