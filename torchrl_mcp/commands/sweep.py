"""Sweeps that continue after a failed run, with every launcher and sweeper of Hydra."""

import os
import shlex
import sys
import traceback
from contextlib import redirect_stderr
from datetime import datetime
from io import StringIO
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig


class Sweep(Callback):
    """Writes a log for each failed run of a sweep, and lists the failed runs at the end.

    For Hydra a failed run ends without a return value, because launchers and sweepers would stop at an exception.
    Optuna counts such a trial as failed. Launchers send this object to their processes with each run.
    """

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Choose a folder of the logs that no other sweep uses, even if it begins in the same second."""
        name = f"failed-{datetime.now():%Y-%m-%d-%H%M%S}-{os.getpid()}"
        self.folder = Path(config.hydra.sweep.dir).absolute() / name

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Write the log of a failed run, and hide its exception from Hydra."""
        if config.hydra.mode != RunMode.MULTIRUN or job_return.status != JobStatus.FAILED:
            return
        try:
            with redirect_stderr(StringIO()):  # Hydra prints the run's settings
                _ = job_return.return_value
        except Exception as error:
            reason = str(error).partition("\n")[0] or type(error).__name__
            line = f"{shlex.join(job_return.overrides or [])}: {reason}"
            self.folder.mkdir(parents=True, exist_ok=True)
            log = "".join([f"{line}\n", *traceback.format_exception(error)])
            (self.folder / f"{config.hydra.job.num}.log").write_text(log, encoding="utf-8")
            print(f"failed: {line}", file=sys.stderr, flush=True)
        job_return.status = JobStatus.COMPLETED
        job_return.return_value = None

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """List the failed runs.

        Raises:
            SystemExit: If a run has failed.
        """
        if not (logs := sorted(self.folder.glob("*.log"), key=lambda log: int(log.stem))):
            return
        lines = [f"failed: {log.read_text(encoding='utf-8').partition(chr(10))[0]}, see {log}" for log in logs]
        sys.exit("\n".join([*lines, "all other runs are complete: repeat the command to run the failed ones alone"]))
