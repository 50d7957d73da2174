"""Reference motions: clips, libraries of clips, and a generator of walking."""

from torchrl_mcp.envs.motions.clip import MotionClip, concatenated
from torchrl_mcp.envs.motions.corpus import generated_library
from torchrl_mcp.envs.motions.gait.corpus import turning_clips, walking_corpus
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.motions.trex import trex_corpus

__all__ = [
    "MotionClip",
    "MotionLibrary",
    "concatenated",
    "generated_library",
    "trex_corpus",
    "turning_clips",
    "walking_corpus",
]
