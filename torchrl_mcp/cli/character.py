"""``torchrl-mcp-character``: check whether an MJCF file is a character, or convert a body into a character."""

import argparse
import keyword
import re
import sys
from pathlib import Path

import yaml  # type: ignore[import-untyped]

from torchrl_mcp.cli.parsing import explained, new_parser
from torchrl_mcp.commands import announce

PROGRAM = "torchrl-mcp-character"

EXAMPLES = f"""\
examples:
  {PROGRAM} check robot.xml                # every violation of the contract, with its remedy
  {PROGRAM} adapt robot.xml --name robot2  # writes robot2.xml, robot2.py and own/character/robot2.yaml
  {PROGRAM} adapt robot.xml --name robot2 --pose home --sides FR_:FL_ RR_:RL_ --torque hip=24 calf=36 --gain .=50

A PATTERN is a regular expression. It applies to every joint or body whose name contains a match.
"""


@explained(PROGRAM)
def main() -> None:
    """Run the command."""
    arguments = parser().parse_args()
    if not arguments.file.is_file():
        sys.exit(f"{PROGRAM}: there is no file {arguments.file}")
    announce(PROGRAM)
    from torchrl_mcp.commands import character

    sys.exit(getattr(character, arguments.run)(arguments))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Check whether an MJCF file is a character, or convert it into a character.", EXAMPLES)
    commands = parser.add_subparsers(required=True, metavar="command")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("file", type=Path, metavar="FILE", help="MJCF or URDF")
    shared.add_argument(
        "--feet",
        nargs="+",
        metavar="BODY",
        help="bodies that may touch the ground (default: the lowest bodies at the ends of limbs)",
    )

    shared.add_argument(
        "--sides",
        nargs="+",
        type=_pair,
        metavar="RIGHT:LEFT",
        help="how names of bodies on the right and on the left begin or end (default: usual pairs in the file)",
    )

    command = commands.add_parser(
        "check",
        parents=[shared],
        help="list what keeps the file from being a character; the exit status is 1 if there is anything",
    )
    command.set_defaults(run="check")
    command = commands.add_parser(
        "adapt", parents=[shared], help="convert the file into a character, with its module and its configuration"
    )
    command.add_argument("--name", type=_name, required=True, help="name of the character and of its files")
    command.add_argument("--output", type=Path, default=Path(), help="folder to write to (default here)")
    command.add_argument(
        "--root", metavar="BODY", help="body that carries all others (default: the body that carries the most)"
    )
    command.add_argument(
        "--floating", action="store_true", help="give the trunk a free joint first, for a URDF with a fixed base"
    )
    command.add_argument(
        "--pose",
        nargs="+",
        default=[],
        metavar="POSE",
        help="rest pose: a keyframe of the file, or angles of hinges as PATTERN=RADIANS",
    )
    for option, unit, what in (
        ("torque", "NM", "torque limits of joints in N m"),
        ("gain", "KP", "gains of joints in N m/rad"),
    ):
        command.add_argument(f"--{option}", nargs="+", default=[], type=_value, metavar=f"PATTERN={unit}", help=what)
    command.set_defaults(run="adapt")
    return parser


def _pair(text: str) -> tuple[str, str]:
    right, _, left = text.partition(":")
    if not right or not left or right == left:
        raise argparse.ArgumentTypeError(f"{text!r} must have the form RIGHT:LEFT, such as FR_:FL_")
    return right, left


def _value(text: str) -> tuple[str, float]:
    pattern, _, number = text.rpartition("=")
    try:
        re.compile(pattern)
        value = float(number)
    except (re.error, ValueError):
        value = 0.0
    if not (pattern and 0 < value < float("inf")):
        raise argparse.ArgumentTypeError(f"{text!r} must have the form PATTERN=NUMBER, such as ankle=50")
    return pattern, value


def _name(text: str) -> str:
    if not re.fullmatch(r"[a-z][a-z0-9_]*", text):
        raise argparse.ArgumentTypeError(
            f"{text!r} must also be the name of a Python module: use small letters, digits and _"
        )
    if keyword.iskeyword(text) or yaml.safe_load(text) != text:
        raise argparse.ArgumentTypeError(f"{text!r} has a meaning in Python or YAML: choose another name")
    return text


if __name__ == "__main__":
    main()
