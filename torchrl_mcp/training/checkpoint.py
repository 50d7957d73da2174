"""Checkpoints: one archive per save, written atomically, checked on loading, and free of pickled code.

They are TorchRL's own :class:`torchrl.checkpoint.Checkpoint` archives: a ZIP file with a checksum per tensor and a JSON
manifest that holds the run's configuration and the library versions. Every part of an agent is a separate
component, so that transfer can load only the parts that it keeps.
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

# Exceptions of torchrl, tensordict, zipfile and json when a file is damaged or of another kind.
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
"""Numbers of errors of the system that say nothing about a file."""


class RunRandomness(GlobalRNGState):
    """State of the random generators of a run: those of the CPU, and that of its own GPU.

    TorchRL's class has those of all GPUs, and cannot be restored on a machine with fewer. On a CPU the state of a GPU
    is left out.

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
    """Return the checkpoint of a run: its ``parts``, each under its name, and further ``components`` with state."""
    return Checkpoint(format="archive", **{_component(name): part for name, part in parts.items()}, **components)


def load(checkpoint: Checkpoint, path: Path) -> None:
    """Restore ``checkpoint`` from the file ``path``.

    Raises:
        ValueError: If the file is missing, truncated, damaged, of another kind, or does not fit.
        OSError: If the system fails, which says nothing about the file.
    """
    if not path.is_file():
        raise ValueError(f"there is no checkpoint file {path}")
    level = torchrl_logger.level
    torchrl_logger.setLevel(ERROR)  # it also warns of another build of a version, as for CUDA
    try:
        _require_plain_data(path)
        report = checkpoint.load(path, map_location="cpu")
    except UNREADABLE as error:
        _raise_passing(error)
        raise ValueError(
            f"cannot restore {path}: {error}. The file is damaged or belongs to a different method, character, task or "
            "network size; give a checkpoint of the same configuration"
        ) from error
    finally:
        torchrl_logger.setLevel(level)
    versions = report.comparison.get("versions", {})
    if other := [name for name, pair in versions.items() if _plain(pair["checkpoint"]) != _plain(pair["runtime"])]:
        torchrl_logger.warning(f"{path} was written with another version of {', '.join(other)}")


def load_parts(parts: nn.ModuleDict, names: Collection[str], path: Path) -> None:
    """Restore the parts ``names`` alone from the checkpoint file ``path``.

    Raises:
        ValueError: As :func:`load`.
    """
    load(run_checkpoint(nn.ModuleDict({name: parts[name] for name in names})), path)


def load_agent(parts: nn.ModuleDict, path: Path, optional: Collection[str] = ("critic",)) -> None:
    """Restore all parts of an agent from the checkpoint file ``path``.

    Args:
        parts: The agent's parts.
        path: The file.
        optional: Names of parts that the file may lack, besides those that it declares as :func:`shared`.

    Raises:
        ValueError: As :func:`load`.
    """
    components = _manifest(path)["components"]
    missing = {*optional, *shared(path)}
    load_parts(parts, [name for name in parts if name not in missing or _component(name) in components], path)


def rotation(run: Path, keep_last: int) -> CheckpointRotation:
    """Return the rotation of a run folder's checkpoints, which keeps the newest ``keep_last``."""
    return CheckpointRotation(run / CHECKPOINTS, keep_last=keep_last)


def save(checkpoint: Checkpoint, checkpoints: CheckpointRotation, *, step: int, config: Mapping[str, Any]) -> None:
    """Write ``checkpoint`` to the rotation ``checkpoints``. It is on the disk before older ones are removed.

    Raises:
        OSError: If it cannot be written, for example because the disk is full.
    """
    path = checkpoints.directory / CHECKPOINT.format(step)
    try:
        with replacing(path) as partial:
            checkpoint.save(partial, metadata={"config": config})
    except RuntimeError as error:  # torch's form of what the system refuses
        raise OSError(f"cannot write {path}: {error}") from error
    checkpoints.prune()


def find(path: Path) -> Path:
    """Return ``path`` if it is a file, or the newest checkpoint of the run folder ``path``.

    Raises:
        ValueError: If there is none.
    """
    if path.is_file():
        return path
    if saved := find_all(path):
        return saved[0]
    raise ValueError(f"{path} is neither a checkpoint file nor a run folder with one in {CHECKPOINTS}/")


def is_intact(path: Path) -> bool:
    """Return whether the file ``path`` is a complete checkpoint, with a manifest and correct checksums.

    Raises:
        OSError: If the system fails, which says nothing about the file.
    """
    try:
        _manifest(path)
        with ZipFile(path) as archive:
            return archive.testzip() is None
    except UNREADABLE as error:
        _raise_passing(error)
        return False


def _raise_passing(error: BaseException) -> None:
    """Raise an error that says nothing about a file, instead of judging the file by it."""
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
    """Return the fingerprints, by name, of the parts that the checkpoint file ``path`` leaves to other networks.

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
    raise ValueError(f"{path} is not a checkpoint of torchrl-mcp: it holds no configuration")


def _require_plain_data(path: Path) -> None:
    """Refuse an archive with compressed files, or with other files than JSON and tensors.

    Tensordict would unpickle some other files, which can run any code, and compressed files could fill a disk.
    """
    with ZipFile(path) as archive:
        for name in archive.namelist():
            if not name.endswith((".json", ".memmap")):
                raise CheckpointError(f"it holds {name}, which is neither JSON nor a tensor")
        if sum(member.file_size for member in archive.infolist()) > path.stat().st_size:
            raise CheckpointError("it would unpack to more than its own size, which no checkpoint of torchrl-mcp does")


def _plain(version: str) -> str:
    """Return a version without its build, such as ``+cpu``."""
    return version.partition("+")[0]


def _component(part: str) -> str:
    return f"part-{part}"
