"""The files of a run folder: their names, and how they are written."""

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

CONFIG = "config.yaml"
"""Every setting of the run. A folder holds a run if it has this file."""

METRICS = "metrics.csv"
"""A row of metrics per iteration."""

EVALUATION = "evaluation.json"
"""The evaluation of the final policy."""

PROVENANCE = "origin.json"
"""The run's provenance: command, commit, versions and machine."""

LOG = "train.log"
"""The output of a run of a benchmark."""


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Replace a file in one step: the block writes to the path that it is given, which then becomes ``path``.

    Readers find the old content or the new one and nothing between, also after a crash or a power failure: content
    and folder are flushed to the disk. If the block fails, the old file stays. Missing folders are made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.partial")
    try:
        yield partial
        _flush(partial)
        partial.replace(path)
        _flush(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write ``content`` as JSON with :func:`replacing`."""
    with replacing(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")


def _flush(path: Path) -> None:
    """Make the system write a file, or the entries of a folder, to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
