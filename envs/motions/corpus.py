"""The reference motions that come with the library."""

from torchrl_mcp.envs.motions.gait_corpus import walking_corpus
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.motions.trex import trex_corpus

TREX_CLIPS = ("straight", "left_gentle", "left_sharp", "right_gentle", "right_sharp")


def generated_library(character: str, seed: int) -> MotionLibrary:
    """Return the generated corpus of a character: walking and turning, 230 s of two-legged ones and 11 s of a T-Rex.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        seed: Of the paths that two-legged characters walk.

    Raises:
        ValueError: If no motions of the character can be generated.
    """
    if character == "trex":
        return MotionLibrary(dict(zip(TREX_CLIPS, trex_corpus(), strict=True)))
    return MotionLibrary(walking_corpus(character, seed))
