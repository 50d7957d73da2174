"""Importing, inspecting and drawing motion files, and rebuilding the paper's corpus."""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from zipfile import BadZipFile

from torchrl_mcp.envs.motions.archive import Archive
from torchrl_mcp.envs.motions.capture.fit import MIRRORED, Import
from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.capture.joint_motion import HUMANS
from torchrl_mcp.envs.motions.capture.key_bodies import read_key_map
from torchrl_mcp.envs.motions.capture.paper_corpus import paper_corpus
from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.inspection.pictures import contact_sheet, save_film, save_picture
from torchrl_mcp.envs.motions.inspection.tables import clip_table, stride_table
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.run_folder import replacing

Failures = dict[Path, Exception]
"""Errors by the files that could not be read."""


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
            made[f"{name}{MIRRORED}"] = motion.mirrored()
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
    motions = paper_corpus(arguments.folder, arguments.character or HUMANS[0], rate=arguments.rate)
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
    """Return a table of clips, and the remarks on them below."""
    rows, remarks = clip_table(motions)
    return "\n".join([text_table(rows), *remarks])


def _strides(motions: Mapping[str, Import]) -> str:
    """Return a table of the strides of human bodies."""
    rows = stride_table(motions)
    return text_table(rows) if rows else f"no strides: only those of {' and '.join(HUMANS)} are measured"


def _joint_map(pairs: list[str]) -> dict[str, str] | None:
    """Parse ``PART=JOINT``."""
    if wrong := [pair for pair in pairs if "=" not in pair]:
        raise ValueError(f"--map {wrong[0]} is not of the form PART=JOINT, such as left_knee=LKnee")
    return {part.strip(): joint.strip() for part, _, joint in (pair.partition("=") for pair in pairs)} or None
