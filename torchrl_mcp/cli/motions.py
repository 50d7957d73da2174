"""``torchrl-mcp-motions``: import and inspect motion capture, and rebuild the paper's corpus."""

import argparse
from pathlib import Path
from zipfile import BadZipFile

from torchrl_mcp.cli.parsing import explained, index, new_parser, own_module, seconds

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


@explained(PROGRAM, BadZipFile, ImportError, RuntimeError)
def main() -> None:
    """Run the command."""
    arguments = parser().parse_args()
    require_files(arguments)
    from torchrl_mcp.commands import motions
    from torchrl_mcp.runs.requirements import import_own

    if arguments.module:
        import_own(arguments.module, "--module names")
    getattr(motions, arguments.run)(arguments)


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
    target, source = argparse.ArgumentParser(add_help=False), argparse.ArgumentParser(add_help=False)
    target.add_argument(
        "--character", metavar="NAME", help="character of the clips (default: that of a clip, otherwise humanoid)"
    )
    target.add_argument(
        "--module", type=own_module, metavar="MODULE", help="Python module that adds the character to the library"
    )
    target.add_argument(
        "--rate", type=float, help="frames per second of the clips (default: that of a clip, otherwise 30)"
    )
    source.add_argument("files", nargs="+", type=Path, metavar="FILE", help="motion capture or clips")
    source.add_argument("--fps", type=float, help="frames per second of the files (default: what they say; .amc: 120)")
    source.add_argument(
        "--scale", type=float, help="metres per unit of length (default: fits the length of the character's legs)"
    )
    source.add_argument(
        "--map", action="append", default=[], metavar="PART=JOINT", help="joint that is a part of the body; repeatable"
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
        "--joints", metavar="NAME,NAME,...", help="joints in the order of the columns of files of states"
    )

    command = commands.add_parser("import", parents=[source, target], help="convert motion capture into clips (.npz)")
    command.add_argument("--mirror", action="store_true", help="also write mirror images")
    command.add_argument("--output", type=Path, default=Path(), help="folder (default here)")
    command.set_defaults(run="import_files")
    command = commands.add_parser(
        "inspect", parents=[source, target], help="print duration, speed, turn rate, slide, soles and limits of clips"
    )
    command.add_argument(
        "--strides", action="store_true", help="also print length, cadence, width and more of human strides"
    )
    command.set_defaults(run="inspect_files")
    command = commands.add_parser(
        "render", parents=[source, target], help="draw a contact sheet (.png) and a film (.gif)"
    )
    command.add_argument(
        "--seconds", type=seconds, default=10.0, help="maximum duration of the film (default %(default)s)"
    )
    command.add_argument("--output", type=Path, default=Path(), help="folder (default here)")
    command.set_defaults(run="render_files")
    command = commands.add_parser(
        "build-paper-corpus", parents=[target], help="convert the paper's 230 s of walking from your downloads"
    )
    command.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the downloaded files")
    command.add_argument("--output", type=Path, default=Path("corpus"), help="folder (default %(default)s)")
    command.set_defaults(run="build_paper_corpus")
    return parser


if __name__ == "__main__":
    main()
