"""Handles files and folders in configurations, so that a run can be moved, copied and continued from anywhere.

A stored configuration contains the run folder as ``.``, and files and folders outside it as absolute paths. These paths
do not identify a run, but the contents of the files and folders do.
"""

import hashlib
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast
from zipfile import ZipFile, is_zipfile

from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs.settings import leaves, replaced
from torchrl_mcp.training.run_folder import find_all

RUN = "."
"""The run folder in the configuration that it contains."""

PRETRAINED = "pretrained"
"""Name of the settings whose value is a run folder or a checkpoint."""

FOLDER_LIBRARY = "torchrl_mcp.envs.motions.corpus.folder_library"
"""The function whose argument ``path`` is a folder. The ``path`` of other functions may be anything."""

BUILTIN = "builtin"
"""Value of ``pretrained``, or beginning of this value, for the networks that come with the library."""


def settings(config: Any) -> Iterator[tuple[str, str]]:
    """Yield the name and the value of every setting whose value is a file or folder.

    >>> list(settings({"seed": 0, "pretrained": "runs/a", "motions": {"_target_": FOLDER_LIBRARY, "path": "clips"}}))
    [('pretrained', 'runs/a'), ('motions.path', 'clips')]
    """
    values = dict(leaves(config))
    for name, value in values.items():
        group, _, key = name.rpartition(".")
        from_library = key == "path" and values.get(f"{group}._target_") == FOLDER_LIBRARY
        from_training = key == PRETRAINED and str(value).partition(":")[0] != BUILTIN
        if isinstance(value, str) and (from_library or from_training):
            yield name, value


def outside(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the files and folders outside the run folder, each by the shortest name of its settings."""
    by_name: dict[str, str] = {}
    for name, value in sorted(settings(config), key=lambda pair: pair[0].count(".")):
        if value not in by_name.values():
            by_name[name] = value
    return by_name


def stored(cfg: DictConfig) -> dict[str, Any]:
    """Return a run's configuration as it is stored: with resolved references, and valid if the folder is moved."""
    relative = OmegaConf.merge(cfg, {"run_dir": RUN, "run_root": RUN})
    config = cast("dict[str, Any]", OmegaConf.to_container(relative, resolve=True))
    moves = {value: str(Path(value).absolute()) for _, value in settings(config)}
    return moved(config, moves)


def moved(config: Mapping[str, Any], moves: Mapping[str, str]) -> dict[str, Any]:
    """Return a configuration with new paths of files and folders.

    Args:
        config: The configuration.
        moves: New paths by the old paths.
    """
    return replaced(config, {name: moves.get(value, value) for name, value in settings(config)})


def located(config: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a stored configuration in which references to ``run_dir``, set to ``folder``, replace :data:`RUN`."""
    texts = [(name, value) for name, value in leaves(config) if isinstance(value, str)]
    inside = {
        name: f"${{run_dir}}{value.removeprefix(RUN)}"
        for name, value in texts
        if value == RUN or value.startswith(f"{RUN}/")
    }
    return replaced(config, inside) | {"run_dir": str(folder), "run_root": str(folder)}


def placeless(config: Mapping[str, Any]) -> Any:
    """Return a configuration, or a part of it, in which the values of files and folders are empty."""
    return replaced(config, {name: "" for name, _ in settings(config)})


def digests(config: Mapping[str, Any]) -> dict[str, str]:
    """Return the :func:`digest` of every existing file or folder outside the run folder, by the name of its setting.

    For a user's character, ``character`` is the digest of its MJCF file.
    """
    from torchrl_mcp.envs.characters import CHARACTERS  # imports MuJoCo, which would slow down --help

    character = CHARACTERS.get(config["character"]["name"])
    model = {"character": digest(character.file)} if character and character.file else {}
    return {name: digest(Path(value)) for name, value in outside(config).items() if Path(value).exists()} | model


def digest(path: Path) -> str:
    """Return eight letters that identify the content of a file or folder, but not its path.

    For a checkpoint, or the newest checkpoint of a run folder, the content is the networks. For any other folder, the
    content is the names and sizes of its files.
    """
    file = next(iter(find_all(path)), path)
    if file.is_dir():
        members = sorted(member for member in file.rglob("*") if member.is_file())
        parts = [(str(member.relative_to(file)), member.stat().st_size) for member in members]
    else:
        parts = _networks(file) if is_zipfile(file) else [("", zlib.crc32(file.read_bytes()))]
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:8]


def _networks(file: Path) -> list[tuple[str, int]]:
    """Return the names and checksums of the tensors of an agent's parts in a checkpoint file."""
    with ZipFile(file) as archive:
        members = [(member.filename.partition("-part-")[2], member.CRC) for member in archive.infolist()]
    return sorted(pair for pair in members if pair[0].endswith(".memmap"))
