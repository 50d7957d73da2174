"""The files of a run folder: their names, and functions that read and write them."""

import csv
import json
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CONFIG = "config.yaml"
"""All settings of the run."""

METRICS = "metrics.csv"
"""One row of metrics per iteration."""

NORMALISED_RETURN = "episode/normalised_return"
"""The column with the mean of the ended episodes: ``nan`` if none ended, or if none can have its full length yet."""

EVALUATION = "evaluation.json"
"""The evaluation of the final policy."""

MODES = ("deterministic", "stochastic")
"""How the policy chooses its actions in an evaluation; the keys of ``evaluation.json``."""

PROVENANCE = "origin.json"
"""The run's provenance: command, commit, versions and machine."""

LOG = "train.log"
"""The output of a run that is part of a benchmark."""

WANDB = "wandb-id"
"""The identifier of the run at W&B, with which a resumed run continues to log."""

CHECKPOINTS = "checkpoints"
"""The folder of checkpoints."""

UNREADABLE = (ArithmeticError, AttributeError, LookupError, OSError, TypeError, ValueError, csv.Error)
"""Exceptions that reading a damaged file raises."""

CHECKPOINT = "checkpoint-{:012d}.torchrl"
"""Name of a checkpoint file, with the number of environment steps, as TorchRL's rotation expects it."""

PARTIAL = ".partial"
"""Suffix of the name of a file that is being written."""

CSV_LOGGER = "csv/scalars"
"""The folder in which TorchRL's csv logger writes its files, with lines ``step,value``."""

UNPACKED = "torchrl-checkpoint-load-*"
"""Folders for temporary files into which TorchRL unpacks the checkpoints that it reads."""

LARGEST = 2**24
"""Most bytes of a JSON file that is read. The JSON files of a run have a few thousand bytes."""

STALE = 3600.0
"""Seconds after which a folder with an unpacked checkpoint is no longer in use."""


def is_run(names: Collection[str]) -> bool:
    """Return whether a folder with entries ``names`` contains a run; ``config.yaml`` alone is not enough.

    Other programs also write files with this name.
    """
    return METRICS in names or (CONFIG in names and not {CHECKPOINTS, EVALUATION, PROVENANCE}.isdisjoint(names))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Replace a file atomically: the block writes to a temporary path, which then becomes ``path``.

    Readers see either the old content or the new content, even after a crash or a power failure, because the file and
    its folder are flushed to the disk. If the block fails, the old file stays. Missing folders are created.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}{PARTIAL}")
    try:
        yield partial
        flush(partial)
        partial.replace(path)
        flush(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write ``content`` as JSON with :func:`replacing`."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")


def read_json(path: Path) -> dict[str, Any]:
    """Return the content of a JSON file.

    Raises:
        ValueError: If the file is damaged, too large or nested too deeply, or is not a JSON object; the message names
            the file.
        OSError: If the file cannot be read.
    """
    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path} has more than {LARGEST} bytes: remove it, or restore it from a copy")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError(f"{path} is nested too deeply: remove it, or restore it from a copy") from error
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}. Remove it, or restore it from a copy") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path} is not a JSON object: remove it, or restore it from a copy")
    return content


def read_metrics(run: Path) -> list[dict[str, float]]:
    """Return the rows of a run's ``metrics.csv``, without an incomplete last row; empty fields become NaN.

    Raises:
        ValueError: If a row is damaged.
    """
    path = run / METRICS
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows = csv.DictReader(line for line in file if line.endswith("\n"))
        try:
            return [{name: float(value or "nan") for name, value in row.items()} for row in rows]
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}:{rows.line_num} is damaged: {error}. Correct or remove the line") from error


def find_all(run: Path) -> list[Path]:
    """Return the checkpoint files that training wrote to a run folder, newest first."""
    # The name decides: TorchRL's rotation skips unreadable files, so that a run would silently load an older one.
    return sorted(
        (path for path in (run / CHECKPOINTS).glob("checkpoint-*.torchrl") if frames(path) >= 0), reverse=True
    )


def frames(path: Path) -> int:
    """Return the environment steps in the name of a checkpoint file, or -1 if the name contains none.

    A copy such as ``checkpoint-best.torchrl`` is an example of such a name.
    """
    step = path.stem.removeprefix("checkpoint-")
    return int(step) if step.isdecimal() else -1


def remove_leftovers(run: Path) -> None:
    """Remove unfinished files of killed processes, and checkpoints that these processes unpacked.

    The caller ensures that no other process works on the run. All other files stay, because the folder may belong to
    the user or contain other runs.
    """
    unfinished = [
        *(path for name in (CONFIG, METRICS, EVALUATION, PROVENANCE) for path in run.glob(f"{name}{PARTIAL}")),
        *(run / CHECKPOINTS).glob(f"checkpoint-*.torchrl{PARTIAL}"),
        *(run / CHECKPOINTS).glob(f".checkpoint-*.torchrl{PARTIAL}.*"),  # TorchRL hides its unfinished files
        *(run / CSV_LOGGER).rglob(f"*.csv{PARTIAL}"),
    ]
    stale = [path for path in Path(tempfile.gettempdir()).glob(UNPACKED) if _age(path) > STALE]
    for path in unfinished + stale:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _age(path: Path) -> float:
    """Return the seconds since a file was changed, or 0 if the file no longer exists."""
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def flush(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    if path.is_dir() and sys.platform == "win32":
        return  # Windows cannot flush folders
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)  # Windows flushes only writable files
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
