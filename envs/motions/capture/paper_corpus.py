"""The corpus of walks on which the paper trains, from files that the user has downloaded."""

from pathlib import Path

from torchrl_mcp.envs.motions.capture.fit import MIRRORED, Import
from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.capture.joint_motion import HUMANS

DURATIONS = {
    "humanoid3d_long_walk1.txt": 32.79,
    "humanoid3d_long_walk2.txt": 24.56,
    "humanoid3d_long_walk3.txt": 17.74,
    "0005_Walking001.bvh": 39.09,
    "humanoid3d_walk.txt": 1.27,
}
"""Seconds of each file. With mirror images of all but the last, which loops, they add up to appendix C's 230 s."""

SOURCES = {
    ".txt": "https://github.com/xbpeng/DeepMimic, data/motions",
    ".bvh": "https://mocap.cs.sfu.ca, subject 0005, Walking001",
}
"""Where to download a file, by its suffix."""


def paper_corpus(folder: Path, character: str = HUMANS[0], *, rate: float | None = None) -> dict[str, Import]:
    """Return the motions of the paper's corpus by name, with the mirror images of all that do not loop.

    Args:
        folder: Folder with the downloaded files at any depth.
        character: Name of the character.
        rate: Frames per second of the clips; None for 30.

    Raises:
        ValueError: If a file is missing, or has another duration than the file that the paper uses.
    """
    paths = {name: sorted(folder.rglob(name))[:1] for name in DURATIONS}
    if missing := [name for name, found in paths.items() if not found]:
        lines = "".join(f"\n  {name} (from {SOURCES[Path(name).suffix]})" for name in missing)
        raise ValueError(f"{folder} lacks{lines}\nDownload them into it, and mind their terms of use.")
    motions = {}
    for name, [path] in paths.items():
        motion = imported(path, character, rate=rate)
        duration = motion.clip.duration
        if abs(duration - DURATIONS[name]) > 0.1:
            raise ValueError(
                f"{path} lasts {duration:.2f} s, and the paper's corpus needs {DURATIONS[name]:.2f} s: it is another "
                "file, or was changed; download it again"
            )
        motions[path.stem] = motion
        if not motion.clip.loop:
            motions[f"{path.stem}{MIRRORED}"] = motion.mirrored()
    return motions
