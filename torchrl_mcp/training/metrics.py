"""The metrics of a run: one CSV file, and any of TorchRL's loggers."""

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path

from torchrl.record.loggers.common import Logger

from torchrl_mcp.training.run_folder import METRICS, replacing


class MetricsWriter:
    """A writer of one row of metrics per iteration, to ``metrics.csv`` and to loggers.

    Args:
        folder: The run folder.
        loggers: TorchRL loggers.
    """

    def __init__(self, folder: Path, loggers: Iterable[Logger] = ()) -> None:
        self.path = folder / METRICS
        self.loggers = list(loggers)
        self._columns: list[str] = []

    def write(self, metrics: Mapping[str, float], *, step: int) -> None:
        """Append ``metrics``, which hold the same names every time, at environment step ``step``."""
        new = not self._columns
        if new:
            self._columns = list(metrics)
        with self.path.open("a", newline="") as file:
            writer = csv.DictWriter(file, self._columns)
            if new:
                writer.writeheader()
            writer.writerow(dict(metrics))
        for logger in self.loggers:
            logger.log_metrics({k: v for k, v in metrics.items() if v == v}, step=step)

    def rewind(self, iteration: int) -> None:
        """Drop the rows after ``iteration``, which a run wrote that was killed before its next checkpoint."""
        if not self.path.exists():
            return
        with self.path.open(newline="") as file:
            rows = csv.DictReader(file)
            kept = [row for row in rows if None not in row.values() and int(row["iteration"]) <= iteration]
        # Without rows the header may be cut short as well: the next row writes it anew.
        self._columns = list(kept[0]) if kept else []
        with replacing(self.path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns)
            if kept:
                writer.writeheader()
            writer.writerows(kept)
