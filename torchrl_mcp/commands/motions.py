"""``torchrl-mcp-motions``: import and inspect motion capture, and rebuild the paper's corpus."""

import argparse
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING
from zipfile import BadZipFile

from torchrl_mcp.commands.parsing import entry_point, index, new_parser, own_module, seconds
from torchrl_mcp.training.run_folder import replacing

if TYPE_CHECKING:
    from torchrl_mcp.envs.motions.capture.fit import Import

PROGRAM = "torchrl-mcp-motions"

EXAMPLES = f"""\
Files can be BVH (.bvh), Acclaim (.amc, beside its .asf), SMPL and AMASS (.npz), DeepMimic (.json, .txt), states of a
character (.csv, .npz), or clips that this program wrote (.npz).

examples:
  {PROGRAM} import walk.bvh 02_01.amc --character humanoid --output clips
  {PROGRAM} import CMU/01/01_01_poses.npz --output clips
  {PROGRAM} import walk.csv --character trex --fps 50 --quaternion xyzw
  {PROGRAM} import walk.bvh --scale 0.3048 --map left_knee=LKnee --map right_knee=RKnee
  {PROGRAM} import walk.bvh clips/walk.npz --character g1 --module g1 --output g1_clips
  {PROGRAM} inspect clips/*.npz --strides
  {PROGRAM} render clips/walk.npz --output pictures
  {PROGRAM} build-paper-corpus downloads --output corpus
"""


Failures = dict[Path, Exception]
"""Errors by the files that could not be read."""


@entry_point(PROGRAM, BadZipFile, ImportError, RuntimeError)
def main(words: list[str]) -> None:
    """Run the subcommand."""
    arguments = parser().parse_args(words)
    require_files(arguments)
    from torchrl_mcp.runs.imports import import_own

    if arguments.module:
        import_own(arguments.module, "--module names")
    arguments.run(arguments)


def require_files(arguments: argparse.Namespace) -> None:
    """Check that the files on the command line exist.

    Raises:
        FileNotFoundError: If one does not.
    """
    for path in getattr(arguments, "files", []):
        if not path.exists():
            raise FileNotFoundError(f"there is no file {path}")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Import motion capture, inspect it, and rebuild the paper's corpus.", EXAMPLES)
    commands = parser.add_subparsers(required=True, metavar="command")
    target = argparse.ArgumentParser(add_help=False)
    target.add_argument(
        "--character", metavar="NAME", help="character of the clips (default: that of a clip, otherwise humanoid)"
    )
    target.add_argument(
        "--module", type=own_module, metavar="MODULE", help="Python module that adds the character to the library"
    )
    target.add_argument(
        "--rate", type=float, help="frames per second of the clips (default: that of a clip, otherwise 30)"
    )
    source = argparse.ArgumentParser(add_help=False)
    source.add_argument("files", nargs="+", type=Path, metavar="FILE", help="motion capture or clips")
    source.add_argument("--fps", type=float, help="frames per second of the files (default: what they say; .amc: 120)")
    source.add_argument(
        "--scale", type=float, help="metres per unit of length (default: fits the length of the character's legs)"
    )
    source.add_argument(
        "--map",
        type=_part,
        action="append",
        default=[],
        metavar="PART=JOINT",
        help="joint that is a part of the body; repeatable",
    )
    source.add_argument("--skip", type=index, metavar="N", help="leave out the first N frames, for example a T-pose")
    source.add_argument(
        "--rest-frame",
        type=index,
        metavar="N",
        help="number of a frame, from 0, that stands, if the rest pose does not",
    )
    source.add_argument(
        "--up", metavar="AXIS", help="axis of the files that points up: x, y or z; --up=-y if y points down"
    )
    source.add_argument(
        "--bodies",
        type=Path,
        metavar="FILE",
        help="bodies of the character by part of a person, as 'PART: BODY' lines (default: guessed from names)",
    )
    source.add_argument("--asf", type=Path, help="skeleton of .amc files (default: in their folder)")
    source.add_argument("--body-model", type=Path, help="body model (.npz) of SMPL files (default: the mean body)")
    source.add_argument(
        "--quaternion", choices=("wxyz", "xyzw"), help="order of quaternions in files of joint rotations"
    )
    source.add_argument(
        "--joints",
        type=_names,
        metavar="NAME,NAME,...",
        help="joints in the order of the columns of files of states",
    )

    command = commands.add_parser("import", parents=[source, target], help="convert motion capture into clips (.npz)")
    command.add_argument("--mirror", action="store_true", help="also write mirror images")
    command.add_argument("--output", type=Path, default=Path(), help="folder (default here)")
    command.set_defaults(run=import_files)
    command = commands.add_parser(
        "inspect", parents=[source, target], help="print duration, speed, turn rate, slide, soles and limits of clips"
    )
    command.add_argument(
        "--strides", action="store_true", help="also print length, cadence, width and more of human strides"
    )
    command.set_defaults(run=inspect_files)
    command = commands.add_parser(
        "render", parents=[source, target], help="draw a contact sheet (.png) and a film (.gif)"
    )
    command.add_argument(
        "--seconds", type=seconds, default=10.0, help="maximum duration of the film (default %(default)s)"
    )
    command.add_argument("--output", type=Path, default=Path(), help="folder (default here)")
    command.set_defaults(run=render_files)
    command = commands.add_parser(
        "build-paper-corpus", parents=[target], help="convert the paper's 230 s of walking from your downloads"
    )
    command.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the downloaded files")
    command.add_argument("--output", type=Path, default=Path("corpus"), help="folder (default %(default)s)")
    command.set_defaults(run=build_paper_corpus)
    return parser


def _part(text: str) -> tuple[str, str]:
    part, separator, joint = text.partition("=")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r} must have the form PART=JOINT, such as left_knee=LKnee")
    return part.strip(), joint.strip()


def _names(text: str) -> list[str]:
    return [name.strip() for name in text.split(",")]


def import_files(arguments: argparse.Namespace) -> None:
    """Write a clip for each file as soon as it is read, and its mirror image if requested."""
    from torchrl_mcp.envs.motions.capture.fit import MIRRORED

    names = [path.stem for path in arguments.files]
    images = [f"{name}{MIRRORED}" for name in names if arguments.mirror]
    if taken := set(names) & set(images):
        raise ValueError(f"a file and a mirror image are both called {min(taken)}: leave the file out, or --mirror")
    _require_no_recordings(names + images, arguments.output, arguments.files)
    written: dict[str, Import] = {}
    failed: Failures = {}
    for name, motion in _read(arguments, failed):
        clips = {name: motion}
        if arguments.mirror:
            clips[f"{name}{MIRRORED}"] = motion.mirrored()
        _save(clips, arguments.output)
        written |= clips
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
    from torchrl_mcp.envs.motions.inspection.pictures import contact_sheet, save_film, save_picture

    arguments.output.mkdir(parents=True, exist_ok=True)
    failed: Failures = {}
    for name, motion in _read(arguments, failed):
        sheet = arguments.output / f"{name}.png"
        film = arguments.output / f"{name}.gif"
        save_picture(contact_sheet(motion.clip), sheet)
        save_film(motion.clip, film, seconds=arguments.seconds)
        print(f"{sheet}\n{film}")
    _raise(failed, len(arguments.files))


def build_paper_corpus(arguments: argparse.Namespace) -> None:
    """Write the clips of the paper's corpus, from files that the user has downloaded."""
    from torchrl_mcp.envs.motions.capture.joint_motion import HUMANS
    from torchrl_mcp.envs.motions.capture.paper_corpus import paper_corpus

    motions = paper_corpus(arguments.folder, arguments.character or HUMANS[0], rate=arguments.rate)
    _require_no_recordings(motions, arguments.output)
    _save(motions, arguments.output)
    print(f"{_table(motions)}\nwritten to {arguments.output}")


def _read(arguments: argparse.Namespace, failed: Failures) -> Iterator[tuple[str, "Import"]]:
    """Yield the name of each file without its suffix, and its motion; put the errors of other files into ``failed``."""
    from torchrl_mcp.envs.motions.archive import Archive
    from torchrl_mcp.envs.motions.capture.importer import imported
    from torchrl_mcp.envs.motions.capture.joint_motion import HUMANS
    from torchrl_mcp.envs.motions.capture.key_bodies import read_key_map

    for path in arguments.files:
        if sum(path.stem == other.stem for other in arguments.files) > 1:
            raise ValueError(f"two files are called {path.stem}: rename one, or run the command once for each")
    bodies = read_key_map(arguments.bodies) if arguments.bodies else None
    for path in arguments.files:
        try:
            is_clip = path.suffix.lower() == ".npz" and _is_clip(path)
            default = str(Archive(path).array("character")) if is_clip else HUMANS[0]
            motion = imported(
                path,
                arguments.character or default,
                rate=arguments.rate,
                fps=arguments.fps,
                scale=arguments.scale,
                joint_map=dict(arguments.map) or None,
                skip=arguments.skip,
                rest_frame=arguments.rest_frame,
                up=arguments.up,
                asf=arguments.asf,
                body_model=arguments.body_model,
                quaternion=arguments.quaternion,
                joints=arguments.joints,
                bodies=bodies,
            )
        except (BadZipFile, ImportError, OSError, RuntimeError, ValueError) as error:
            failed[path] = error
        else:
            yield path.stem, motion


def _raise(failed: Failures, number: int) -> None:
    """Raise an error that names all files that could not be read, if there are any.

    Args:
        failed: Errors of the files that could not be read.
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
    """Check that clips replace only clips.

    Args:
        names: Names of the clips to write.
        folder: The folder to write to.
        recordings: Files to keep, even if they are clips.

    Raises:
        ValueError: If a clip would replace another file.
    """
    for path in filter(Path.exists, (folder / f"{name}.npz" for name in names)):
        if any(map(path.samefile, recordings)) or not _is_clip(path):
            raise ValueError(f"{path} is a recording that the clip would replace: pass another --output")


def _is_clip(path: Path) -> bool:
    from torchrl_mcp.envs.motions.archive import Archive
    from torchrl_mcp.envs.motions.errors import MotionFormatError

    try:
        return "character" in Archive(path).names
    except MotionFormatError:
        return False


def _save(motions: Mapping[str, "Import"], folder: Path) -> None:
    """Write clips into a folder."""
    for name, motion in motions.items():
        with replacing(folder / f"{name}.npz") as partial, partial.open("wb") as file:
            motion.clip.save(file)


def _table(motions: Mapping[str, "Import"]) -> str:
    """Return a table of clips, and the remarks on them below."""
    from torchrl_mcp.envs.motions.inspection.tables import clip_table
    from torchrl_mcp.runs.tables import text_table

    rows, remarks = clip_table(motions)
    return "\n".join([text_table(rows), *remarks])


def _strides(motions: Mapping[str, "Import"]) -> str:
    """Return a table of the strides of human bodies."""
    from torchrl_mcp.envs.motions.capture.joint_motion import HUMANS
    from torchrl_mcp.envs.motions.inspection.tables import stride_table
    from torchrl_mcp.runs.tables import text_table

    rows = stride_table(motions)
    return text_table(rows) if rows else f"no strides: only those of {' and '.join(HUMANS)} are measured"


if __name__ == "__main__":
    main()
