"""Checking files of characters, and converting other bodies into characters."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import tensordict  # noqa: F401 - before mujoco, see envs/__init__.py

# isort: split
import mujoco

from torchrl_mcp.envs.characters.adapt import adapted, key_bodies
from torchrl_mcp.envs.characters.contract import Violation, lowest_bodies, violations
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
)
'''

CONFIG = """\
# Made by torchrl-mcp-character adapt
name: {name}
module: {name} # is imported before the character is looked up
action_std: 0.1 # of the action before training, where 1 is half the range of a joint's targets
"""


def check(arguments: argparse.Namespace) -> int:
    """Print each violation of the contract; return the exit status."""
    model = _read(arguments.file)
    found = violations(model, feet=_feet(model, arguments.feet))
    print(*(f"- {violation}" for violation in found), sep="\n", end="\n" if found else "")
    print(_verdict(arguments.file, found, _feet(model, arguments.feet)))
    return bool(found)


def adapt(arguments: argparse.Namespace) -> int:
    """Convert a file into a character, and write it with its module and its configuration.

    Raises:
        ValueError: If MuJoCo cannot read the file, or one to write is there already.
    """
    name, folder = arguments.name, arguments.output
    spec = adapted(_read(arguments.file))
    spec.modelname = name
    model = spec.compile()
    feet = _feet(model, arguments.feet)
    written = {
        folder / f"{name}.xml": spec.to_xml(),
        folder / f"{name}.py": MODULE.format(
            name=name, source=arguments.file.name, feet=tuple(feet), key_bodies=tuple(key_bodies(model))
        ),
        folder / "own" / "character" / f"{name}.yaml": CONFIG.format(name=name),
    }
    for path in written:
        if path.exists():
            raise ValueError(f"{path} is there already: pass another --name or --output, or remove it")
    for path, text in written.items():
        with replacing(path) as partial:
            partial.write_text(text)
        print(path)
    found = violations(model, feet=feet, key_bodies=key_bodies(model))
    print(*(f"- {violation}" for violation in found), sep="\n", end="\n" if found else "")
    print(f"{name}: {model.nv} degrees of freedom, {model.nu} controls, {model.body_mass.sum():.1f} kg. Next:")
    if folder != Path():
        print(f"  cd {folder}")
    print(f"  torchrl-mcp-play --agent zero --config-dir own task=heading character={name}")
    print(f"  torchrl-mcp-train --config-dir own task=heading character={name} method=scratch")
    return bool(found)


def _read(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file.

    Raises:
        ValueError: If MuJoCo cannot read it.
    """
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"MuJoCo cannot read {path}: {error}") from error


def _feet(model: mujoco.MjModel, named: Sequence[str] | None) -> list[str]:
    return list(named) if named else lowest_bodies(model)[1]


def _verdict(path: Path, found: Sequence[Violation], feet: Sequence[str]) -> str:
    if found:
        return f"{path}: {len(found)} violations. torchrl-mcp-character adapt {path} --name NAME converts what can be"
    return f"{path} is a character, with {', '.join(feet)} as feet"
