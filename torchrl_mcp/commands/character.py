"""``torchrl-mcp-character``: check whether an MJCF file is a character, or convert a body into a character."""

import argparse
import keyword
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import yaml  # type: ignore[import-untyped]

from torchrl_mcp.commands.parsing import announce, entry_point, new_parser
from torchrl_mcp.training.run_folder import replacing

if TYPE_CHECKING:
    from torchrl_mcp.envs.characters.adapt import Adapted
    from torchrl_mcp.envs.characters.contract import Violation
    from torchrl_mcp.envs.characters.drives import Drive

PROGRAM = "torchrl-mcp-character"

EXAMPLES = f"""\
examples:
  {PROGRAM} check robot.xml                # every violation of the contract, with its remedy
  {PROGRAM} adapt robot.xml --name robot2  # writes robot2.xml, robot2.py and own/character/robot2.yaml
  {PROGRAM} adapt robot.xml --name robot2 --pose home --sides FR_:FL_ RR_:RL_ --torque hip=24 calf=36 --gain .=50

A PATTERN is a regular expression. It applies to every joint or body whose name contains a match.
"""

MODULE = '''\
"""The character {name}, made of {source} by torchrl-mcp-character adapt."""

from pathlib import Path

from torchrl_mcp.envs.characters import CHARACTERS, Character

CHARACTERS["{name}"] = Character(
    name="{name}",
    feet={feet!r},
    key_bodies={key_bodies!r},
    carrier=None,
    file=Path(__file__).with_name("{name}.xml"),
    sides={sides!r},
)
'''

CONFIG = """\
# Made by torchrl-mcp-character adapt
name: {name}
module: {name} # is imported before the character is looked up
action_std: 0.1 # of the action before training, where 1 is half the range of a joint's targets
"""

GRAVITY = 9.81
"""Acceleration of free fall in m/s^2, by which the unit of length of a file is recognised."""


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Run the subcommand, and exit with its status."""
    arguments = parser().parse_args(words)
    if not arguments.file.is_file():
        sys.exit(f"{PROGRAM}: there is no file {arguments.file}")
    announce(PROGRAM)
    sys.exit(arguments.run(arguments))


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
    command.set_defaults(run=check)
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
    command.add_argument(
        "--torque", nargs="+", default=[], type=_value, metavar="PATTERN=NM", help="torque limits of joints in N m"
    )
    command.add_argument(
        "--gain", nargs="+", default=[], type=_value, metavar="PATTERN=KP", help="gains of joints in N m/rad"
    )
    command.set_defaults(run=adapt)
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


def check(arguments: argparse.Namespace) -> int:
    """Print each violation of the contract; return the exit status."""
    from torchrl_mcp.envs.characters.contract import guessed_feet, passive_bodies, violations
    from torchrl_mcp.envs.characters.files import read_body
    from torchrl_mcp.envs.characters.mirror import SIDES, guessed_sides

    spec = read_body(arguments.file)
    model = spec.compile()
    names = [model.body(body).name for body in range(1, model.nbody)]
    sides = tuple(arguments.sides or guessed_sides(names)) or SIDES
    feet = arguments.feet or guessed_feet(model, sides)
    faults = violations(spec, feet=feet, sides=sides)
    _print(faults)
    if faults:
        command = f"{PROGRAM} adapt {shlex.quote(str(arguments.file))} --name NAME"
        print(f"{arguments.file}: {len(faults)} violations. {command} converts what can be converted")
    else:
        print(f"{arguments.file} is a character, with {', '.join(feet)} as feet")
    if passive := passive_bodies(model):
        print(f"passive, because they have no actuator: {', '.join(passive)}")
    return bool(faults)


def adapt(arguments: argparse.Namespace) -> int:
    """Convert a file into a character, and write it with its module and its configuration.

    Raises:
        ValueError: If MuJoCo cannot read the file or the converted body, a file to write exists already, or another
            character or module has the name.
    """
    from torchrl_mcp.envs.characters.adapt import adapted, key_bodies
    from torchrl_mcp.envs.characters.contract import violations
    from torchrl_mcp.envs.characters.files import parse_body, read_body

    name = arguments.name
    folder = arguments.output
    source = read_body(arguments.file, floating=arguments.floating, trunk=arguments.root).compile()
    body = adapted(
        source,
        root=arguments.root,
        pose=arguments.pose,
        feet=arguments.feet,
        sides=arguments.sides and tuple(arguments.sides),
        torques=dict(arguments.torque),
        gains=dict(arguments.gain),
    )
    body.spec.modelname = name
    body.spec.compile()
    text = body.spec.to_xml()
    written = parse_body(text, f"the converted {arguments.file}")
    model = written.compile()
    ends = tuple(key_bodies(model))
    _require_unused(name, folder)
    _write(
        {
            folder / f"{name}.xml": text,
            folder / f"{name}.py": MODULE.format(
                name=name, source=arguments.file.name, feet=body.feet, key_bodies=ends, sides=body.sides
            ),
            folder / "own" / "character" / f"{name}.yaml": CONFIG.format(name=name),
        }
    )
    gravity = float(abs(source.opt.gravity).max())
    print(*_description(body, gravity, arguments), sep="\n")
    faults = violations(written, feet=body.feet, key_bodies=ends, sides=body.sides)
    _print(faults)
    print(f"{name}: {model.nv} degrees of freedom, {model.nu} controls, {model.body_mass.sum():.3g} kg. Next:")
    if folder != Path():
        print(f"  cd {shlex.quote(str(folder))}")
    print(f"  torchrl-mcp-play --agent zero --config-dir own task=heading character={name}")
    print(f"  torchrl-mcp-train --config-dir own task=heading character={name} method=scratch")
    return bool(faults)


def _require_unused(name: str, folder: Path) -> None:
    """Check that no character of the library and no other module has the name.

    Raises:
        ValueError: If one has. Python would import the other module instead of the character's.
    """
    from torchrl_mcp.envs.characters import CHARACTERS

    if (folder / f"{name}.xml").exists():
        return  # the name is that of the character to write, which _write refuses to replace
    if name in {"ant", *(name for name, character in CHARACTERS.items() if character.file is None)}:
        raise ValueError(f"{name} is the name of a character of the library: choose another (--name)")
    if (module := find_spec(name)) and module.origin:
        raise ValueError(f"{name} is the name of a Python module, {module.origin}: choose another (--name)")


def _description(body: "Adapted", gravity: float, arguments: argparse.Namespace) -> Iterator[str]:
    """Yield lines about the choices that were made, and tables of the joints and of the omitted parts.

    Args:
        body: The converted body.
        gravity: Greatest component of the acceleration of free fall in the file.
        arguments: The command line.
    """
    from torchrl_mcp.envs.characters.drives import GUESSED, PASSIVE
    from torchrl_mcp.runs.tables import text_table

    yield f"root: {body.root}{'' if arguments.root else ' (guessed: pass another with --root)'}"
    yield f"pose: {' '.join(arguments.pose) or 'as in the file'}"
    yield f"feet: {', '.join(body.feet)}{'' if arguments.feet else ' (guessed: pass others with --feet)'}"
    sides = " ".join(f"{right}:{left}" for right, left in body.sides) or "none found"
    yield f"sides: {sides}{'' if arguments.sides else ' (guessed: pass others with --sides)'}"
    if gravity and abs(gravity / GRAVITY - 1) > 0.1:
        yield f"units: gravity is {gravity:.4g} in the file, so its lengths are not in metres; they are read as metres"
    yield ""
    yield text_table([_row(name, drive, body.ranges[name]) for name, drive in body.drives.items()])
    if body.left_out:
        yield ""
        rows = [
            {"left out": kind, "number": str(len(names)), "names": ", ".join(names)}
            for kind, names in body.left_out.items()
        ]
        yield text_table(rows)
    if passive := [name for name, drive in body.drives.items() if drive.torque_from == PASSIVE]:
        yield f"{', '.join(passive)} stay passive, because no actuator of the file acts on them: --torque adds one"
    guesses = sum([drive.torque_from, drive.gain_from].count(GUESSED) for drive in body.drives.values())
    if guesses:
        yield f"{guesses} values are guessed from the weights: pass the maker's values with --torque and --gain"


def _row(name: str, drive: "Drive", limits: tuple[float, float]) -> dict[str, str]:
    from torchrl_mcp.envs.characters.drives import PASSIVE

    low, high = limits
    passive_forces = {"spring": drive.spring, "friction": drive.friction}
    remarks = [f"{name} {value:.3g}" for name, value in passive_forces.items() if value]
    return {
        "joint": name,
        "range rad": f"{low:.3g} to {high:.3g}",
        "torque N m": PASSIVE if drive.torque_from == PASSIVE else f"{drive.torque:.3g} {drive.torque_from}",
        "gain N m/rad": PASSIVE if drive.gain_from == PASSIVE else f"{drive.gain:.3g} {drive.gain_from}",
        "damping N m s/rad": f"{drive.damping:.3g} + {drive.passive:.3g}",
        "armature kg m2": f"{drive.armature:.3g}",
        "": ", ".join(filter(None, [*remarks, drive.remark])),
    }


def _write(texts: Mapping[Path, str]) -> None:
    """Write files.

    Raises:
        ValueError: If one exists already. Then none is written.
    """
    for path in texts:
        if path.exists():
            raise ValueError(f"{path} exists already: pass another --name or --output, or remove it")
    for path, text in texts.items():
        with replacing(path) as partial:
            partial.write_text(text, encoding="utf-8")
        print(path)


def _print(faults: Sequence["Violation"]) -> None:
    for fault in faults:
        print(f"- {fault}")


if __name__ == "__main__":
    main()
