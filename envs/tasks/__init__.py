"""Tasks: one class in one file each, read from top to bottom, over rewards that are pure functions."""

from torchrl_mcp.envs.tasks.carry import Carry
from torchrl_mcp.envs.tasks.dribble import Dribble
from torchrl_mcp.envs.tasks.heading import Heading
from torchrl_mcp.envs.tasks.holdout import Holdout
from torchrl_mcp.envs.tasks.imitation import Imitation
from torchrl_mcp.envs.tasks.location import Location

__all__ = ["Carry", "Dribble", "Heading", "Holdout", "Imitation", "Location"]
