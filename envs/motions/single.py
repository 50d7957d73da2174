"""Single reference motions, for methods that learn one skill at a time."""

from torchrl_mcp.envs.motions import MotionClip, MotionLibrary, trex_corpus, turning_clips
from torchrl_mcp.envs.motions.corpus import TREX_CLIPS


def single_motion(character: str, clip: str | None = None) -> MotionLibrary:
    """Return a library of one generated clip: walking at one speed and turn rate.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        clip: Name of the clip, or None for the first, straight ahead.

    Raises:
        ValueError: If the character has no such clip.

    Example:
        >>> single_motion("biped", "left_sharp").names
        ['left_sharp']
    """
    clips = _walks(character)
    name = next(iter(clips)) if clip is None else clip
    if name not in clips:
        raise ValueError(
            f"clip={clip!r} is not a generated motion of character={character!r}: pass one of {list(clips)}"
        )
    return MotionLibrary({name: clips[name]})


def _walks(character: str) -> dict[str, MotionClip]:
    if character == "trex":
        return dict(zip(TREX_CLIPS, trex_corpus(), strict=True))
    return turning_clips(character)
