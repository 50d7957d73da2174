"""Checking files of characters, and converting other bodies into characters."""

import argparse
import shlex
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

import tensordict  # noqa: F401 - before mujoco, see envs/__init__.py

# isort: split
import mujoco

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.adapt import Adapted, adapted, key_bodies
from torchrl_mcp.envs.characters.contract import Violation, guessed_feet, passive_bodies, violations
from torchrl_mcp.envs.characters.drives import GUESSED, PASSIVE, Drive
from torchrl_mcp.envs.characters.files import parse_body, read_body
from torchrl_mcp.envs.characters.sides import SIDES, Sides, guessed_sides
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.run_folder import replacing

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


def check(arguments: argparse.Namespace) -> int:
    """Print each violation of the contract; return the exit status."""
    spec = read_body(arguments.file)
    model = spec.compile()
    sides = _sides(model, arguments.sides)
    feet = arguments.feet or guessed_feet(model, sides)
    faults = violations(spec, feet=feet, sides=sides)
    _print(faults)
    print(_verdict(arguments.file, faults, feet))
    if passive := passive_bodies(model):
        print(f"passive, because they have no actuator: {', '.join(passive)}")
    return bool(faults)


def adapt(arguments: argparse.Namespace) -> int:
    """Convert a file into a character, and write it with its module and its configuration.

    Raises:
        ValueError: If MuJoCo cannot read the file or what was made of it, a file to write is there already, or the name
            is of another character or module.
    """
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
    written = parse_body(text, f"what was made of {arguments.file}")
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
    print(*_description(body, source, arguments), sep="\n")
    faults = violations(written, feet=body.feet, key_bodies=ends, sides=body.sides)
    _print(faults)
    print(f"{name}: {model.nv} degrees of freedom, {model.nu} controls, {model.body_mass.sum():.3g} kg. Next:")
    if folder != Path():
        print(f"  cd {shlex.quote(str(folder))}")
    print(f"  torchrl-mcp-play --agent zero --config-dir own task=heading character={name}")
    print(f"  torchrl-mcp-train --config-dir own task=heading character={name} method=scratch")
    return bool(faults)


def _require_unused(name: str, folder: Path) -> None:
    """Check that a new name is of no character and no module, which would be imported instead."""
    known = {"ant", *(name for name, character in CHARACTERS.items() if character.file is None)}
    module = find_spec(name)
    if not (folder / f"{name}.xml").exists() and (name in known or (module and module.origin)):
        owner = "a character of the library" if name in known else f"a Python module, {module and module.origin}"
        raise ValueError(f"{name} is the name of {owner}: choose another (--name)")


def _description(body: Adapted, source: mujoco.MjModel, arguments: argparse.Namespace) -> Iterator[str]:
    """Yield what was found and chosen, and tables of the joints and of what is left out."""
    yield f"root: {body.root}{'' if arguments.root else ' (guessed: give another with --root)'}"
    yield f"pose: {' '.join(arguments.pose) or 'as in the file'}"
    yield f"feet: {', '.join(body.feet)}{'' if arguments.feet else ' (guessed: name others with --feet)'}"
    sides = " ".join(f"{right}:{left}" for right, left in body.sides) or "none found"
    yield f"sides: {sides}{'' if arguments.sides else ' (guessed: give others with --sides)'}"
    gravity = float(abs(source.opt.gravity).max())
    if gravity and abs(gravity / GRAVITY - 1) > 0.1:
        yield f"units: gravity is {gravity:.4g} in the file, so its lengths are not in metres; they are taken as metres"
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
        yield f"{', '.join(passive)} stay passive: no actuator of the file acts on them, and --torque gives them one"
    guesses = sum([drive.torque_from, drive.gain_from].count(GUESSED) for drive in body.drives.values())
    if guesses:
        yield f"{guesses} values are guessed from the weights: give those of the maker with --torque and --gain"


def _row(name: str, drive: Drive, limits: tuple[float, float]) -> dict[str, str]:
    low, high = limits
    kept = {"spring": drive.spring, "friction": drive.friction}
    return {
        "joint": name,
        "range rad": f"{low:.3g} to {high:.3g}",
        "torque N m": PASSIVE if drive.torque_from == PASSIVE else f"{drive.torque:.3g} {drive.torque_from}",
        "gain N m/rad": PASSIVE if drive.gain_from == PASSIVE else f"{drive.gain:.3g} {drive.gain_from}",
        "damping N m s/rad": f"{drive.damping:.3g} + {drive.passive:.3g}",
        "armature kg m2": f"{drive.armature:.3g}",
        "": ", ".join([*(f"{key} {value:.3g}" for key, value in kept.items() if value), *filter(None, [drive.remark])]),
    }


def _write(written: dict[Path, str]) -> None:
    """Write files, none of which may be there."""
    for path in written:
        if path.exists():
            raise ValueError(f"{path} exists already: pass another --name or --output, or remove it")
    for path, text in written.items():
        with replacing(path) as partial:
            partial.write_text(text, encoding="utf-8")
        print(path)


def _print(found: Sequence[Violation]) -> None:
    for violation in found:
        print(f"- {violation}")


def _sides(model: mujoco.MjModel, given: Sequence[tuple[str, str]] | None) -> Sides:
    return tuple(given or guessed_sides(model.body(body).name for body in range(1, model.nbody))) or SIDES


def _verdict(path: Path, found: Sequence[Violation], feet: Sequence[str]) -> str:
    if found:
        command = f"torchrl-mcp-character adapt {shlex.quote(str(path))} --name NAME"
        return f"{path}: {len(found)} violations. {command} converts what can be"
    return f"{path} is a character, with {', '.join(feet)} as feet"
