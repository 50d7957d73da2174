"""Importing, inspecting and drawing motion files, and rebuilding the paper's corpus."""

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from zipfile import BadZipFile

from torch import Tensor

from torchrl_mcp.envs.motions.archive import Archive
from torchrl_mcp.envs.motions.capture.fit import Import
from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.capture.joint_motion import HUMANS
from torchrl_mcp.envs.motions.capture.key_bodies import read_key_map
from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.inspection.feasibility import feasibility
from torchrl_mcp.envs.motions.inspection.pictures import contact_sheet, save_film, save_picture
from torchrl_mcp.envs.motions.inspection.statistics import GaitStatistics, gait_statistics
from torchrl_mcp.envs.motions.inspection.summary import Summary, summarised
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.run_folder import replacing

PAPER_CORPUS = {
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

COLUMNS = (
    "clip",
    "character",
    "seconds",
    "frames/s",
    "m/s",
    "|rad/s|",
    "slide m/s",
    "standing soles",
    "cut to limits",
    "beyond limits",
    "below ground",
    "legs in legs",
    "torque/limit",
    "rest pose leans",
)
"""Columns of the table, from ``summary`` and ``feasibility`` of ``torchrl_mcp.envs.motions.inspection``."""

STRIDES: dict[str, Callable[[GaitStatistics], Tensor]] = {
    "length m": lambda strides: strides.stride_length,
    "steps/min": lambda strides: strides.cadence,
    "width m": lambda strides: strides.step_width,
    "stance": lambda strides: strides.stance,
    "double support": lambda strides: strides.double_support,
    "bob m": lambda strides: strides.bob,
    "sway m": lambda strides: strides.sway,
    "knee swing deg": lambda strides: strides.knee_swing,
    "foot strikes deg": lambda strides: strides.pitch_strike,
    "arm swing deg": lambda strides: strides.arm_swing,
}
"""Columns of the table of strides, which shows medians."""

MIRRORED = "_mirrored"
"""End of the names of mirror images."""

Failures = dict[Path, Exception]
"""Errors by the files that could not be read."""

SLIDING = 0.2
"""Speed in m/s that sliding feet exceed if a motion is read incorrectly, and do not reach if it is read correctly."""

GLIDING = 0.7
"""The same for the slowest of the lowest points of the body."""

CAUSES = "unit, frame rate, map or order of rotations"
"""Settings that make feet slide if they are wrong."""


def import_files(arguments: argparse.Namespace) -> None:
    """Write a clip for each file as soon as it is read, and its mirror image if requested."""
    names = [path.stem for path in arguments.files]
    images = [f"{name}{MIRRORED}" for name in names if arguments.mirror]
    if taken := set(names) & set(images):
        raise ValueError(f"a file and a mirror image are both called {min(taken)}: leave the file out, or --mirror")
    _require_no_recordings(names + images, arguments.output, arguments.files)
    written: dict[str, Import] = {}
    failed: Failures = {}
    for name, motion in _read(arguments, failed):
        made = {name: motion}
        if arguments.mirror:
            made[f"{name}{MIRRORED}"] = motion._replace(clip=motion.clip.mirrored())
        _save(made, arguments.output)
        written |= made
    if written:
        print(f"{_table(written)}\nwritten to {arguments.output}")
    _raise(failed, len(arguments.files))


def inspect_files(arguments: argparse.Namespace) -> None:
    """Print tables about motions."""
    failed: Failures = {}
    motions = dict(_read(arguments, failed))
    if motions:
        print(_table(motions))
        if arguments.strides:
            print(f"\n{_strides(motions)}")
    _raise(failed, len(arguments.files))


def render_files(arguments: argparse.Namespace) -> None:
    """Draw a contact sheet and a film of each motion."""
    arguments.output.mkdir(parents=True, exist_ok=True)
    failed: Failures = {}
    for name, (clip, *_) in _read(arguments, failed):
        sheet, film = arguments.output / f"{name}.png", arguments.output / f"{name}.gif"
        save_picture(contact_sheet(clip), sheet)
        save_film(clip, film, seconds=arguments.seconds)
        print(f"{sheet}\n{film}")
    _raise(failed, len(arguments.files))


def build_paper_corpus(arguments: argparse.Namespace) -> None:
    """Write the clips of the paper's corpus, from files that the user has downloaded."""
    paths = {name: sorted(arguments.folder.rglob(name))[:1] for name in PAPER_CORPUS}
    if missing := [name for name, found in paths.items() if not found]:
        lines = "".join(f"\n  {name} (from {SOURCES[Path(name).suffix]})" for name in missing)
        raise ValueError(f"{arguments.folder} lacks{lines}\nDownload them into it, and mind their terms of use.")
    motions = {}
    for name, [path] in paths.items():
        motion = imported(path, arguments.character or HUMANS[0], rate=arguments.rate)
        clip = motion.clip
        if abs(clip.duration - PAPER_CORPUS[name]) > 0.1:
            expected = f"{path} lasts {clip.duration:.2f} s, and the paper's corpus needs {PAPER_CORPUS[name]:.2f} s"
            raise ValueError(f"{expected}: it is another file, or was changed; download it again")
        motions[path.stem] = motion
        if not clip.loop:
            motions[f"{path.stem}{MIRRORED}"] = motion._replace(clip=clip.mirrored())
    _require_no_recordings(motions, arguments.output)
    _save(motions, arguments.output)
    print(f"{_table(motions)}\nwritten to {arguments.output}")


def _read(arguments: argparse.Namespace, failed: Failures) -> Iterator[tuple[str, Import]]:
    """Yield the motion of each file, with its name without suffix, and put errors of the others into ``failed``."""
    for path in arguments.files:
        if sum(path.stem == other.stem for other in arguments.files) > 1:
            raise ValueError(f"two files are called {path.stem}: rename one, or call the program for each")
    joint_map = _joint_map(arguments.map)
    bodies = read_key_map(arguments.bodies) if arguments.bodies else None
    for path in arguments.files:
        try:
            archived = path.suffix.lower() == ".npz" and _is_clip(path)
            character = str(Archive(path).array("character")) if archived else HUMANS[0]
            motion = imported(
                path,
                arguments.character or character,
                rate=arguments.rate,
                fps=arguments.fps,
                scale=arguments.scale,
                joint_map=joint_map,
                skip=arguments.skip,
                rest_frame=arguments.rest_frame,
                up=arguments.up,
                asf=arguments.asf,
                body_model=arguments.body_model,
                quaternion=arguments.quaternion,
                joints=[name.strip() for name in arguments.joints.split(",")] if arguments.joints else None,
                bodies=bodies,
            )
        except (BadZipFile, ImportError, OSError, RuntimeError, ValueError) as error:
            failed[path] = error
        else:
            yield path.stem, motion


def _raise(failed: Failures, number: int) -> None:
    """Raise an error that names each file that could not be read, if there are any.

    Args:
        failed: The errors of these files.
        number: Number of all files.
    """
    messages: dict[str, list[str]] = {}
    for path, error in failed.items():
        messages.setdefault(str(error), []).append(str(path))
    if len(messages) == 1 and len(failed) == number:
        raise ValueError(*messages)
    if messages:
        lines = (text if paths[0] in text else f"{', '.join(paths)}: {text}" for text, paths in messages.items())
        raise ValueError(f"{len(failed)} of {number} files were left out:\n" + "\n".join(lines))


def _require_no_recordings(names: Iterable[str], folder: Path, recordings: Sequence[Path] = ()) -> None:
    """Check that clips replace no recording: none of ``recordings``, and no other file that is no clip.

    Raises:
        ValueError: If one would.
    """
    for path in filter(Path.exists, (folder / f"{name}.npz" for name in names)):
        if any(map(path.samefile, recordings)) or not _is_clip(path):
            raise ValueError(f"{path} is a recording that the clip would replace: give another --output")


def _is_clip(path: Path) -> bool:
    try:
        return "character" in Archive(path).names
    except MotionFormatError:
        return False


def _save(motions: Mapping[str, Import], folder: Path) -> None:
    """Write clips into a folder."""
    for name, (clip, *_) in motions.items():
        with replacing(folder / f"{name}.npz") as partial, partial.open("wb") as file:
            clip.save(file)


def _table(motions: Mapping[str, Import]) -> str:
    """Return a line for each clip, with a warning about clips whose feet slide."""
    summaries = {name: summarised(motion.clip) for name, motion in motions.items()}
    rows = [_row(name, motion, summaries[name]) for name, motion in motions.items()]
    total = f"{sum(numbers.duration for numbers in summaries.values()):.1f}"
    rows.append(("total", "", total, *[""] * (len(COLUMNS) - 3)))
    lines = text_table([dict(zip(COLUMNS, row, strict=True)) for row in rows])
    for name, motion in motions.items():
        if motion.bodies:
            often, most = (float(motion.missed.quantile(share)) for share in (0.5, 1.0))
            lines += (
                f"\nBones miss their directions in {name} by {often:.1f} deg in the median, {most:.1f} deg at most."
            )
    for character, bodies in {motion.clip.character: motion.bodies for motion in motions.values()}.items():
        if bodies:
            pairs = ", ".join(f"{part}: {body}" for part, body in bodies.items())
            lines += f"\n{character} follows with {pairs}. If this is wrong, give a file of such lines (--bodies)."
    for name, motion in motions.items():
        if motion.assumed:
            lines += f"\nAssumed for {name}: {motion.assumed}. If this is wrong, say which axis points up (--up) "
            lines += "or which frame stands (--rest-frame)."
    for note in dict.fromkeys(motion.ground for motion in motions.values() if motion.ground):
        names = ", ".join(name for name, motion in motions.items() if motion.ground == note)
        lines += f"\nIn {names}, {note}."
    if sliding := [name for name, numbers in summaries.items() if numbers.slide > SLIDING]:
        lines += f"\nThe feet slide in {', '.join(sliding)}: {CAUSES} may be wrong."
    if gliding := [name for name, numbers in summaries.items() if numbers.gliding > GLIDING and name not in sliding]:
        lines += f"\nNo part of the body rests on the ground in {', '.join(gliding)}: {CAUSES} may be wrong."
    return lines


def _row(name: str, motion: Import, numbers: Summary) -> tuple[str, ...]:
    clip, rest_lean, cut, *_ = motion
    demand = feasibility(clip)
    return (
        name,
        clip.character,
        f"{numbers.duration:.2f}",
        f"{clip.fps:.4g}{' loop' if clip.loop else ''}",
        f"{numbers.speed:.2f}",
        f"{numbers.turn_rate:.2f}",
        "-" if math.isnan(numbers.slide) else f"{numbers.slide:.3f}",
        "-" if math.isnan(numbers.sole) else f"{round(100 * numbers.sole, 1) + 0.0:.1f} cm",
        f"{float(cut.max()):.1f} deg, {100 * float((cut > 1).double().mean()):.0f} %" if len(cut) else "-",
        f"{math.degrees(demand.limit):.1f} deg",
        f"{100 * demand.penetration:.1f} cm",
        f"{100 * demand.crossing:.1f} cm",
        f"{demand.torque:.2f}",
        "-" if math.isnan(rest_lean) else f"{rest_lean:.1f} deg",
    )


def _strides(motions: Mapping[str, Import]) -> str:
    """Return a line of medians over the complete strides of each clip of a human body."""
    rows = []
    for name, (clip, *_) in motions.items():
        if clip.character in HUMANS:
            strides = gait_statistics(clip)
            medians = [
                float(measure(strides).quantile(0.5)) if len(strides.speed) else math.nan
                for measure in STRIDES.values()
            ]
            cells = ("-" if math.isnan(median) else f"{median:.3g}" for median in medians)
            rows.append({"clip": name, "strides": str(len(strides.speed)), **dict(zip(STRIDES, cells, strict=True))})
    return text_table(rows)


def _joint_map(pairs: list[str]) -> dict[str, str] | None:
    """Parse ``PART=JOINT``."""
    if wrong := [pair for pair in pairs if "=" not in pair]:
        raise ValueError(f"--map {wrong[0]} is not of the form PART=JOINT, such as left_knee=LKnee")
    return {part.strip(): joint.strip() for part, _, joint in (pair.partition("=") for pair in pairs)} or None
