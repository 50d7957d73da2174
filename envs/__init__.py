"""Simulated characters and tasks in MuJoCo, imported as ``torchrl_mcp.envs``."""

if __name__ != "torchrl_mcp.envs":
    raise ImportError(
        "import torchrl_mcp.envs, not envs: this folder is a part of the torchrl_mcp package "
        "(install it with `pip install -e .` and use the full name)"
    )

from torchrl_mcp.envs.base import CharacterEnv
from torchrl_mcp.envs.holdout import Holdout

__all__ = ["CharacterEnv", "Holdout"]
