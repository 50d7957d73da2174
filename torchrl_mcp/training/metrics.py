"""Measures the episodes that end during training, and writes the metrics of a run to files and loggers."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.record.loggers.common import Logger
from torchrl.record.loggers.tensorboard import TensorboardLogger

from torchrl_mcp.adapters.contract import task_reward
from torchrl_mcp.training.run_folder import CSV_LOGGER, METRICS, flush, replacing


class EpisodeStatistics:
    """Returns and lengths of episodes that span several batches, from the task's own rewards.

    Args:
        num_envs: Number of environments, ``N``.

    Attributes:
        steps: Steps so far in each environment. While this number is below the longest episode, only shorter episodes
            have ended, and the mean of their returns differs from the mean of all episodes.
    """

    def __init__(self, num_envs: int) -> None:
        self.steps: float = 0
        self.returns = torch.zeros(num_envs)
        self.lengths = torch.zeros(num_envs)

    def update(self, batch: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Add trajectories ``(N, T)``; return the return and length of each of the ``E`` ended episodes, ``(E,)``."""
        ended_returns = []
        ended_lengths = []
        self.steps += batch.shape[1]
        rewards = task_reward(batch["next"]).squeeze(-1).cpu()
        dones = batch["next", "done"].squeeze(-1).cpu()
        for reward, done in zip(rewards.unbind(1), dones.unbind(1), strict=True):
            self.returns += reward
            self.lengths += 1
            ended_returns.append(self.returns[done])
            ended_lengths.append(self.lengths[done])
            self.returns[done] = 0
            self.lengths[done] = 0
        return torch.cat(ended_returns), torch.cat(ended_lengths)

    def state_dict(self) -> dict[str, Any]:
        """Return the steps, and returns and lengths so far of the unfinished episodes, ``(N,)``."""
        return {"steps": self.steps, "returns": self.returns, "lengths": self.lengths}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the result of :meth:`state_dict`."""
        self.steps = state["steps"]
        self.returns = state["returns"].clone()
        self.lengths = state["lengths"].clone()


def begin_after(logger: Logger, frames: int) -> None:
    """Make TensorBoard drop the values that a killed run logged after environment step ``frames``.

    Other loggers need no change: the files of the csv logger are rewound with ``metrics.csv``, W&B ignores steps that
    it has already received, and MLflow treats a resumed run as a new run.
    """
    if isinstance(logger, TensorboardLogger):
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        start = Event(session_log=SessionLog(status=SessionLog.START))
        logger.experiment.file_writer.add_event(start, frames + 1)


class MetricsWriter:
    """Writes one row of metrics per iteration to ``metrics.csv`` and to loggers.

    Args:
        folder: The run folder.
        loggers: TorchRL loggers.
    """

    def __init__(self, folder: Path, loggers: Iterable[Logger] = ()) -> None:
        self.path = folder / METRICS
        self.loggers = list(loggers)
        self._columns: list[str] = []

    def write(self, metrics: Mapping[str, float], *, step: int) -> None:
        """Append ``metrics`` at environment step ``step``. New metrics get a column, which is NaN in earlier rows.

        Raises:
            FileNotFoundError: If the file was removed since the last row.
        """
        if self._columns and not self.path.exists():
            raise FileNotFoundError(f"{self.path} was removed, with the rows written so far")
        if metrics.keys() - self._columns:
            self._rewrite(self._rows(), metrics)
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, self._columns, restval=math.nan).writerow(dict(metrics))
        for logger in self.loggers:
            logger.log_metrics({k: v for k, v in metrics.items() if not math.isnan(v)}, step=step)

    def flush(self) -> None:
        """Flush the file to the disk.

        Raises:
            FileNotFoundError: If the file was removed since the last row.
        """
        if self._columns:
            flush(self.path)

    def rewind(self, iteration: int) -> None:
        """Drop the rows after ``iteration``, which a run wrote that was killed before its next checkpoint.

        Raises:
            ValueError: If the rows end before ``iteration``.
        """
        kept = [row for row in self._rows() if int(row["iteration"]) <= iteration]
        if (last := int(kept[-1]["iteration"]) if kept else 0) < iteration:
            raise ValueError(
                f"{self.path} ends after iteration {last}, but the checkpoint is of iteration {iteration}: restore the "
                "file from a copy, or start a new run in another folder"
            )
        if not self.path.exists():
            return
        # A file without rows may have an incomplete header: the next row writes the header again.
        self._rewrite(kept)
        self._rewind_csv_logger(int(kept[-1]["frames"]) if kept else 0)

    def _rewrite(self, rows: Sequence[Mapping[str, str]], names: Iterable[str] = ()) -> None:
        """Replace the file by ``rows``, with further columns for ``names``; missing values become NaN."""
        self._columns = list(dict.fromkeys([*(rows[0] if rows else ()), *names]))
        with replacing(self.path) as partial, partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns, restval=math.nan)
            if self._columns:
                writer.writeheader()
            writer.writerows(rows)

    def _rewind_csv_logger(self, frames: int) -> None:
        """Drop the lines that TorchRL's csv logger, which only appends, wrote after environment step ``frames``."""
        for path in (self.path.parent / CSV_LOGGER).rglob("*.csv"):
            lines = path.read_text(errors="replace").splitlines(keepends=True)
            pairs = [line for line in lines if line.partition(",")[0].isdecimal() and line.endswith("\n")]
            with replacing(path) as partial:
                partial.write_text("".join(line for line in pairs if int(line.partition(",")[0]) <= frames))

    def _rows(self) -> list[dict[str, str]]:
        """Return all complete rows that have an iteration."""
        if not self.path.exists():
            return []
        with self.path.open(newline="", errors="replace") as file:
            rows = csv.DictReader(line.replace("\0", "") for line in file)
            whole = (row for row in rows if None not in row and None not in row.values())
            return [row for row in whole if row.get("iteration", "").isdecimal()]
