"""Libraries of reference motions: the generated ones, and folders of clips."""

from pathlib import Path

import torch

from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.corpus import walking_corpus
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.motions.trex import trex_corpus
from torchrl_mcp.values import Seed

TREX_CLIPS = ("straight", "left_gentle", "left_sharp", "right_gentle", "right_sharp")


def generated_library(character: str, seed: Seed) -> MotionLibrary:
    """Return the generated corpus of a character: walking and turning, 230 s for biped and humanoid, 11 s for T-Rex.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        seed: Seed of the paths of biped and humanoid.

    Raises:
        ValueError: If there is no generator for the character.
    """
    if character == "trex":
        return MotionLibrary(dict(zip(TREX_CLIPS, trex_corpus(), strict=True)), dtype=torch.float32)
    return MotionLibrary(walking_corpus(character, seed), dtype=torch.float32)


def folder_library(character: str, path: str | Path) -> MotionLibrary:
    """Return the clips in a folder of ``torchrl-mcp-motions import``, by file name without suffix.

    Args:
        character: Character of the clips.
        path: Folder with ``.npz`` files.

    Raises:
        ValueError: If there are no clips, one is damaged, or one is of another character.
    """
    files = sorted(Path(path).glob("*.npz"))
    if not files:
        raise ValueError(f"path={str(path)!r} holds no clips (.npz): write some with torchrl-mcp-motions import")
    clips = {file.stem: MotionClip.load(file) for file in files}
    if others := [name for name, clip in clips.items() if clip.character != character]:
        raise ValueError(
            f"path={str(path)!r} holds clips of other characters, such as {others[0]}: import them again with "
            f"--character {character}"
        )
    return MotionLibrary(clips, dtype=torch.float32)
