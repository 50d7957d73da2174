"""Motions of the Tyrannosaurus beyond the paper's: standing, walking slowly, and turning on the spot."""

import torch

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.corpus import TREX_CLIPS
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.motions.trex import FPS, STRIDE_TIME, STRIDES, trex_corpus, trex_walk

SLOW = (0.5, 0.0)
LEFT_ON_THE_SPOT = (0.0, 0.7)
"""Speeds in m/s and turn rates in rad/s, as of the walks."""


def standing_library(character: str) -> MotionLibrary:
    """Return the generated motions of the T-Rex with those of standing and turning on the spot, 20 s.

    Args:
        character: ``"trex"``; the generated walks of biped and humanoid have stops.

    Raises:
        ValueError: If it is another character.
    """
    if character != "trex":
        raise ValueError(f"character={character!r} has stops among its generated motions: pass motions=generated")
    walks = dict(zip(TREX_CLIPS, trex_corpus(), strict=True))
    return MotionLibrary({**walks, **trex_stops()}, dtype=torch.float32)


def trex_stops() -> dict[str, MotionClip]:
    """Generate 9 s of loops: standing, walking slowly, and turning on the spot to the left and to the right.

    Example:
        >>> {name: round(float(clip.cycle.turn), 1) for name, clip in trex_stops().items()}
        {'standing': 0.0, 'slow': 0.0, 'left_on_the_spot': 1.5, 'right_on_the_spot': -1.5}
    """
    left = trex_walk(*LEFT_ON_THE_SPOT)
    walks = {"slow": trex_walk(*SLOW), "left_on_the_spot": left, "right_on_the_spot": left.mirrored()}
    return {"standing": trex_stand(), **walks}


def trex_stand() -> MotionClip:
    """Stand still at rest, for as long as a walk."""
    rest = torch.from_numpy(character_model("trex").qpos0)
    return MotionClip("trex", rest.repeat(round(STRIDES * STRIDE_TIME * FPS) + 1, 1), FPS, loop=True)
