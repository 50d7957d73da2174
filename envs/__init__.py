"""Simulated characters and tasks in MuJoCo, imported as ``torchrl_mcp.envs``.

Every environment holds N simulations. Its tensors have the batch shape ``(N,)``: ``observation`` ``(N, S)``, ``goal``
``(N, G)``, ``action`` ``(N, A)`` and ``reward`` ``(N, 1)``.
"""

if __name__ != "torchrl_mcp.envs":
    raise ImportError(
        "import torchrl_mcp.envs, not envs: this folder is a part of the torchrl_mcp package "
        "(install it with `pip install -e .` and use the full name). A folder `envs` of your own needs an __init__.py"
    )

# Before mujoco: with triton, which a CUDA build of torch brings and tensordict imports, the process would crash if
# MuJoCo had loaded OSMesa first (MUJOCO_GL=osmesa).
import tensordict  # noqa: F401

from torchrl_mcp.envs.base import CharacterEnv
from torchrl_mcp.envs.curriculum import Curriculum
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.registration import register
from torchrl_mcp.envs.tasks import Carry, Dribble, Heading, Holdout, Imitation, Location

__all__ = [
    "Carry",
    "CharacterEnv",
    "Curriculum",
    "Dribble",
    "Heading",
    "Holdout",
    "Imitation",
    "Location",
    "PDCharacterEnv",
]

register()
