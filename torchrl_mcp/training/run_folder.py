"""The files of a run folder: their names, and how they are written."""

import csv
import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CONFIG = "config.yaml"
"""Every setting of the run. A folder holds a run if it has this file."""

METRICS = "metrics.csv"
"""A row of metrics per iteration."""

NORMALISED_RETURN = "episode/normalised_return"
"""The column of metrics with the mean of the episodes that ended, blank if none did."""

EVALUATION = "evaluation.json"
"""The evaluation of the final policy."""

PROVENANCE = "origin.json"
"""The run's provenance: command, commit, versions and machine."""

LOG = "train.log"
"""The output of a run of a benchmark."""

CHECKPOINTS = "checkpoints"
"""The folder of checkpoints."""

CHECKPOINT = "checkpoint-{:012d}.torchrl"
"""Of a checkpoint file, by environment steps, as TorchRL's rotation has it."""

PARTIAL = ".partial"
"""At the end of the name of a file that is being written."""

UNPACKED = "torchrl-checkpoint-load-*"
"""Folders into which TorchRL unpacks checkpoints to read them, in the system's folder for temporary files."""

LARGEST = 2**24
"""Bytes of a JSON file that is read. One of a run has some thousand."""

STALE = 3600.0
"""Seconds after which nobody reads a checkpoint any more."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Replace a file in one step: the block writes to the path that it is given, which then becomes ``path``.

    Readers find the old content or the new one and nothing between, also after a crash or a power failure: content
    and folder are flushed to the disk. If the block fails, the old file stays. Missing folders are made.
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
    """Return what a JSON file holds.

    Raises:
        ValueError: If it is damaged, too large or nested too deeply, or holds no object.
        OSError: If it cannot be read.
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
    """Return the rows of a run's ``metrics.csv``; blank is NaN, and a row half written is left out."""
    path = run / METRICS
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return [
            {name: float(value or "nan") for name, value in row.items()}
            for row in csv.DictReader(file)
            if None not in row.values()
        ]


def find_all(run: Path) -> list[Path]:
    """Return the checkpoint files of a run folder that training wrote, the newest first."""
    # By name alone: TorchRL's rotation passes over what it cannot read, and an older checkpoint would be a surprise.
    return sorted(
        (path for path in (run / CHECKPOINTS).glob("checkpoint-*.torchrl") if frames(path) >= 0), reverse=True
    )


def frames(path: Path) -> int:
    """Return after how many environment steps the checkpoint file ``path`` of a run folder was written.

    That of another file, such as a copy ``checkpoint-best.torchrl``, is -1.
    """
    step = path.stem.removeprefix("checkpoint-")
    return int(step) if step.isdecimal() else -1


def remove_leftovers(run: Path) -> None:
    """Remove what processes that were killed left of files that they wrote, and of checkpoints that they read.

    Nobody else may be at work on the run.
    """
    # TorchRL hides what it has not finished.
    unfinished = [*(run / CHECKPOINTS).glob(".*"), *run.rglob(f"*{PARTIAL}")]
    stale = [path for path in Path(tempfile.gettempdir()).glob(UNPACKED) if _age(path) > STALE]
    for path in unfinished + stale:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _age(path: Path) -> float:
    """Return the seconds since a file was changed, 0 if it is gone."""
    try:
        return time.time() - path.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def flush(path: Path) -> None:
    """Make the system write a file, or the entries of a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
