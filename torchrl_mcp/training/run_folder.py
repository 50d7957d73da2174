"""The files of a run folder: their names, and how they are written."""

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
"""Every setting of the run. A folder holds a run if it has this file."""

METRICS = "metrics.csv"
"""A row of metrics per iteration."""

NORMALISED_RETURN = "episode/normalised_return"
"""The column of metrics with the mean of the episodes that ended; ``nan`` if none did, or none can be whole yet."""

EVALUATION = "evaluation.json"
"""The evaluation of the final policy."""

MODES = ("deterministic", "stochastic")
"""How the policy chooses its actions in an evaluation; the names of its parts."""

PROVENANCE = "origin.json"
"""The run's provenance: command, commit, versions and machine."""

LOG = "train.log"
"""The output of a run of a benchmark."""

WANDB = "wandb-id"
"""The identifier of the run at W&B, by which a resumed run goes on there."""

CHECKPOINTS = "checkpoints"
"""The folder of checkpoints."""

CHECKPOINT = "checkpoint-{:012d}.torchrl"
"""Name of a checkpoint file by environment steps, in the form of TorchRL's rotation."""

PARTIAL = ".partial"
"""Suffix of the name of a file that is being written."""

CSV_LOGGER = "csv/scalars"
"""The folder of the files of TorchRL's csv logger, with lines ``step,value``."""

UNPACKED = "torchrl-checkpoint-load-*"
"""Folders into which TorchRL unpacks checkpoints to read them, in the system's folder for temporary files."""

LARGEST = 2**24
"""Most bytes of a JSON file. A run's has a few thousand."""

STALE = 3600.0
"""Seconds after which no process can still be reading a checkpoint."""


def is_run(names: Collection[str]) -> bool:
    """Return whether a folder with entries of these names holds a run; a ``config.yaml`` may be another program's."""
    return METRICS in names or (CONFIG in names and not {CHECKPOINTS, EVALUATION, PROVENANCE}.isdisjoint(names))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Replace a file atomically: the block writes to a temporary path, which then becomes ``path``.

    Readers find either the old content or the new, also after a crash or a power failure: content and folder are
    flushed to the disk. If the block fails, the old file stays. Missing folders are created.
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
        ValueError: If it is damaged, too large or nested too deeply, or holds no object.
        OSError: If the file cannot be read.
    """
    if path.stat().st_size > LARGEST:
        raise ValueError(f"it has more than {LARGEST} bytes")
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(content, dict):
        raise ValueError("it holds no object")
    return content


def read_metrics(run: Path) -> list[dict[str, float]]:
    """Return the rows of a run's ``metrics.csv``; blanks become NaN, and an incomplete last row is left out.

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
            raise ValueError(f"{path}:{rows.line_num} is damaged: {error}; correct or remove the line") from error


def find_all(run: Path) -> list[Path]:
    """Return the checkpoint files that training wrote to a run folder, newest first."""
    # By name alone: TorchRL's rotation skips unreadable files, and an older checkpoint would be a surprise.
    return sorted(
        (path for path in (run / CHECKPOINTS).glob("checkpoint-*.torchrl") if frames(path) >= 0), reverse=True
    )


def frames(path: Path) -> int:
    """Return the environment steps in the name of a checkpoint file, -1 if there are none.

    A copy such as ``checkpoint-best.torchrl`` has none.
    """
    step = path.stem.removeprefix("checkpoint-")
    return int(step) if step.isdecimal() else -1


def remove_leftovers(run: Path) -> None:
    """Remove unfinished files of killed processes, and checkpoints that they unpacked.

    No other process may be working on the run. Other files stay: the folder may be the user's, or hold other runs.
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
    """Return the seconds since a file was changed, 0 if it no longer exists."""
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def flush(path: Path) -> None:
    """Flush a file, or the entries of a folder, to the disk."""
    if path.is_dir() and sys.platform == "win32":
        return  # Windows cannot flush folders, and files only if they are open for writing
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
