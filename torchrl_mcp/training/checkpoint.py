"""Checkpoints: one archive per save, written atomically, checked on loading, and free of pickled code.

A checkpoint is an archive of TorchRL's :class:`torchrl.checkpoint.Checkpoint`: a ZIP file with a checksum per tensor,
and with a JSON manifest that records the run's configuration and the library versions. Every part of an agent is a
separate component, so that transfer can load the parts that it keeps without the rest.
"""

import errno
import zlib
from collections.abc import Collection, Mapping
from logging import ERROR
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import torch
from torch import nn
from torchrl import torchrl_logger
from torchrl.checkpoint import Checkpoint, CheckpointError, CheckpointRotation, GlobalRNGState

from torchrl_mcp.training.run_folder import CHECKPOINT, CHECKPOINTS, find_all, replacing

DAMAGED = ".damaged"
"""Suffix of the name of a checkpoint that could not be restored."""

# Exceptions that torchrl, tensordict, zipfile and json raise for a file that is damaged or of another kind.
UNREADABLE = (
    AttributeError,
    BadZipFile,
    EOFError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    zlib.error,
)

PASSING = (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM)
"""System errors which do not mean that the file is damaged, such as a full disk."""


class RunRandomness(GlobalRNGState):
    """State of a run's random generators: the generators of the CPU, and the generator of the run's GPU.

    TorchRL's class stores the generators of all GPUs, and cannot restore them on a machine with fewer GPUs. For a run
    on the CPU, no generator of a GPU is stored.

    Args:
        device: Device of the run's networks.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device

    def state_dict(self) -> dict[str, Any]:
        """Return the states."""
        state = super().state_dict()
        state.pop("torch_cuda", None)
        return state | ({"cuda": torch.cuda.get_rng_state(self.device)} if self.device.type == "cuda" else {})

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Restore the states."""
        super().load_state_dict({name: state for name, state in state_dict.items() if name != "torch_cuda"})
        if self.device.type == "cuda" and "cuda" in state_dict:
            torch.cuda.set_rng_state(state_dict["cuda"].cpu(), self.device)


def run_checkpoint(parts: nn.ModuleDict, **components: Any) -> Checkpoint:
    """Return the checkpoint of a run: the agent's ``parts`` by name, and further ``components`` with a state."""
    return Checkpoint(format="archive", **{_component(name): part for name, part in parts.items()}, **components)


def load(checkpoint: Checkpoint, path: Path, components: Collection[str] | None = None) -> None:
    """Restore ``checkpoint`` from the file ``path``.

    Args:
        checkpoint: The objects to restore.
        path: The file.
        components: Names of the objects to restore, or None for all.

    Raises:
        ValueError: If the file is missing, damaged, of another kind, or written for other networks.
        OSError: If the system cannot read the file, for example for lack of permission.
    """
    if not path.is_file():
        raise ValueError(f"there is no checkpoint file {path}")
    level = torchrl_logger.level
    torchrl_logger.setLevel(ERROR)  # otherwise TorchRL warns even of another build of the same version, such as +cu128
    try:
        _require_plain_data(path)
        report = checkpoint.load(path, components=components, map_location="cpu")
    except UNREADABLE as error:
        _raise_passing(error)
        raise ValueError(
            f"cannot restore {path}: {error}. The file is damaged or belongs to a different method, character, task or "
            "network size; give a checkpoint of the same configuration"
        ) from error
    finally:
        torchrl_logger.setLevel(level)
    versions = report.comparison.get("versions", {})
    if changed := [name for name, pair in versions.items() if _plain(pair["checkpoint"]) != _plain(pair["runtime"])]:
        torchrl_logger.warning(f"{path} was written with another version of {', '.join(changed)}")


def load_parts(parts: nn.ModuleDict, names: Collection[str], path: Path) -> None:
    """Restore only the parts ``names`` from the checkpoint file ``path``.

    Raises:
        ValueError: As :func:`load`.
    """
    load(run_checkpoint(nn.ModuleDict({name: parts[name] for name in names})), path)


def load_agent(parts: nn.ModuleDict, path: Path, optional: Collection[str] = ("critic",)) -> None:
    """Restore all parts of an agent from the checkpoint file ``path``.

    Args:
        parts: The agent's parts.
        path: The file.
        optional: Names of parts that the file may lack, in addition to the parts that it declares as :func:`shared`.

    Raises:
        ValueError: As :func:`load`.
    """
    components = _manifest(path)["components"]
    may_be_missing = {*optional, *shared(path)}
    load_parts(parts, [name for name in parts if name not in may_be_missing or _component(name) in components], path)


def rotation(run: Path, keep_last: int) -> CheckpointRotation:
    """Return the rotation of a run folder's checkpoints, which keeps the newest ``keep_last``."""
    return CheckpointRotation(run / CHECKPOINTS, keep_last=keep_last)


def save(checkpoint: Checkpoint, checkpoints: CheckpointRotation, *, step: int, config: Mapping[str, Any]) -> None:
    """Write ``checkpoint`` to the rotation ``checkpoints``, and only then remove older checkpoints.

    Raises:
        OSError: If the file cannot be written, for example because the disk is full.
    """
    path = checkpoints.directory / CHECKPOINT.format(step)
    try:
        with replacing(path) as partial:
            checkpoint.save(partial, metadata={"config": config})
    except RuntimeError as error:  # torch raises this for errors of the system
        raise OSError(f"cannot write {path}: {error}") from error
    checkpoints.prune()


def find(path: Path | str) -> Path:
    """Return ``path`` if it is a file, or the newest checkpoint of the run folder ``path``.

    Raises:
        ValueError: If there is no checkpoint.
    """
    path = Path(path)
    if path.is_file():
        return path
    if saved := find_all(path):
        return saved[0]
    raise ValueError(f"{path} is neither a checkpoint file nor a run folder with one in {CHECKPOINTS}/")


def is_intact(path: Path) -> bool:
    """Return whether the file ``path`` is a complete checkpoint, with a manifest and correct checksums.

    Raises:
        OSError: If the system cannot read the file, for example for lack of permission.
    """
    try:
        _manifest(path)
        with ZipFile(path) as archive:
            return archive.testzip() is None
    except UNREADABLE as error:
        _raise_passing(error)
        return False


def _raise_passing(error: BaseException) -> None:
    """Raise ``error`` if its cause is the system and not the file."""
    if isinstance(error, OSError) and error.errno in PASSING:
        raise error


def set_aside(path: Path) -> None:
    """Rename a damaged checkpoint, so that it no longer counts as a checkpoint of the run."""
    path.replace(path.with_name(f"{path.name}{DAMAGED}"))


def saved_config(path: Path) -> Mapping[str, Any]:
    """Return the configuration of the run that wrote the checkpoint file ``path``.

    Raises:
        ValueError: If the file is not a checkpoint of this library.
    """
    return _manifest(path)["metadata"]["config"]


def shared(path: Path) -> Mapping[str, str]:
    """Return fingerprints, by name, of the parts that ``path`` does not store because other networks share them.

    Raises:
        ValueError: If the file is not a checkpoint of this library.
    """
    return _manifest(path)["metadata"].get("shared", {})


def _manifest(path: Path) -> Mapping[str, Any]:
    """Return the manifest of the checkpoint file ``path``."""
    try:
        _require_plain_data(path)
        manifest = Checkpoint.manifest(path)
        if "config" in manifest["metadata"]:
            return manifest
    except UNREADABLE as error:
        _raise_passing(error)
        raise ValueError(
            f"{path} is damaged, or is not a checkpoint of torchrl-mcp: {error}. Give another file, such as an older "
            "checkpoint of the run"
        ) from error
    raise ValueError(f"{path} is not a checkpoint of torchrl-mcp: its manifest has no configuration")


def _require_plain_data(path: Path) -> None:
    """Refuse an archive that contains compressed files, or files other than JSON and tensors.

    Tensordict would unpickle some other kinds of files, which can run any code. Compressed files could fill a disk.
    """
    with ZipFile(path) as archive:
        for name in archive.namelist():
            if not name.endswith((".json", ".memmap")):
                raise CheckpointError(f"the archive contains {name}, which is neither JSON nor a tensor")
        if sum(member.file_size for member in archive.infolist()) > path.stat().st_size:
            raise CheckpointError("the archive is compressed, which no checkpoint of torchrl-mcp is")


def _plain(version: str) -> str:
    """Return a version without the name of its build, such as ``+cpu``."""
    return version.partition("+")[0]


def _component(part: str) -> str:
    return f"part-{part}"
