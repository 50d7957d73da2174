"""Shows the progress of the runs in a folder.

The progress is read from the run folders. Any process, on any machine that shares the folders, can therefore show it
while a benchmark runs.
"""

import csv
import math
import os
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TextIO

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from torchrl_mcp.evaluation.wording import duration
from torchrl_mcp.runs import lock
from torchrl_mcp.runs.tables import plain_table
from torchrl_mcp.runs.trust import read_config
from torchrl_mcp.training import run_folder
from torchrl_mcp.training.run_folder import (
    CONFIG,
    EVALUATION,
    LOG,
    METRICS,
    NORMALISED_RETURN,
    UNREADABLE,
    is_run,
    read_json,
    write_json,
)

MANIFEST = "benchmark-{}.json"
"""Name of the file that lists the runs of a benchmark, by the name of the benchmark."""

STYLES = {"running": "cyan", "damaged": "red", "stopped": "red", "done": "green", "waiting": "dim"}
"""Colours of the states of a run, in the order of the table."""

INTERVAL = 1.0
"""Seconds between updates."""

Runs = Mapping[Path, int | None]
"""Run folders with their total environment steps; None stands for the number in the run's configuration."""


@dataclass(frozen=True)
class Status:
    """The progress of a run.

    Attributes:
        folder: Run folder.
        state: ``waiting``, ``running``, ``stopped`` (failed or killed), ``done`` (has its last checkpoint, and its
            evaluation unless the run has none), or ``damaged`` (cannot be read).
        frames: Environment steps so far.
        total: Environment steps of the whole run.
        speed: Environment steps per second in the last iteration.
        normalised_return: Normalised return of the evaluation, or else of the last row of the metrics, or None.
    """

    folder: Path
    state: str
    frames: int
    total: int
    speed: float = 0.0
    normalised_return: float | None = None

    @property
    def remaining(self) -> float | None:
        """Seconds until the end of training, or None if unknown."""
        return max(self.total - self.frames, 0) / self.speed if self.state == "running" and self.speed else None


@contextmanager
def overview(folder: Path, runs: Runs | None = None) -> Iterator[None]:
    """Show the progress of ``runs``, or of all runs in a folder, during the block.

    On a terminal, a table is updated every :data:`INTERVAL` seconds. Elsewhere, a line is printed whenever the state of
    a run changes.
    """
    console = Console(file=sys.stdout)
    if console.is_terminal:
        with Live(
            get_renderable=lambda: table(look(folder, runs), folder, console.height - 4),
            console=console,
            refresh_per_second=1 / INTERVAL,
            redirect_stdout=False,
            redirect_stderr=False,
        ):
            yield
        return
    ended = threading.Event()
    thread = threading.Thread(target=_print_changes, args=(folder, runs, ended, sys.stdout), daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def look(folder: Path, runs: Runs | None = None) -> list[Status]:
    """Return the status of ``runs``, or of all runs in ``folder``, including runs that its benchmarks plan."""
    damaged: list[Status] = []
    if runs is None:
        configs = sorted(path for path in folder.rglob(CONFIG) if is_run(os.listdir(path.parent)))
        totals: dict[Path, int | None] = {path.parent.resolve(): None for path in configs}
        for path in sorted(folder.rglob(MANIFEST.format("*"))):
            try:
                totals |= read_manifest(path)
            except UNREADABLE:
                damaged.append(Status(path, "damaged", 0, 0))
        runs = totals
    return [_status(run, total) for run, total in runs.items()] + damaged


def _status(run: Path, total: int | None) -> Status:
    try:
        return status(run, total)
    except UNREADABLE:
        return Status(run, "damaged", 0, total or 0)


def write_manifest(runs: Mapping[Path, int], path: Path) -> None:
    """Add the runs of a benchmark and their environment steps to a file, which other processes read.

    The file keeps the runs of earlier commands, which may have trained other parts of the benchmark.
    """
    folder = path.parent.resolve()
    with lock.hold(folder, wait=True):  # another benchmark may write the same file
        try:
            earlier = read_manifest(path) if path.exists() else {}
        except UNREADABLE:
            earlier = {}
        steps = {os.path.relpath(run.resolve(), folder): total for run, total in {**earlier, **runs}.items()}
        write_json(steps, path)


def read_manifest(path: Path) -> dict[Path, int]:
    """Return the run folders of a benchmark, with the environment steps of each run."""
    return {(path.parent / run).resolve(): int(total) for run, total in read_json(path).items()}


def status(run: Path, total: int | None = None) -> Status:
    """Return the status of a run of ``total`` environment steps, by default the number in its configuration."""
    total = _plan(run)[0] if total is None else total
    last = _last_row(run / METRICS)
    frames = int(last.get("frames", 0))
    speed = last.get("time/steps_per_second", 0.0)
    last_return = last.get(NORMALISED_RETURN, math.nan)
    score = None if math.isnan(last_return) else last_return
    if (run / EVALUATION).exists():
        evaluated = float(read_json(run / EVALUATION)["deterministic"]["normalised_return"])
        if frames >= total:  # otherwise, the run is continued after an evaluation
            return Status(run, "done", frames, total, speed, evaluated)
    if lock.holder(run):
        return Status(run, "running", frames, total, speed, score)
    if _is_saved(run, total) and not _plan(run)[1]:
        return Status(run, "done", frames, total, speed, score)
    begun = (run / CONFIG).exists() or (run / LOG).exists()
    return Status(run, "stopped" if begun else "waiting", frames, total, speed, score)


def table(statuses: Sequence[Status], folder: Path, height: int | None = None) -> Table:
    """Return a table of runs with at most ``height`` rows, sorted by state in the order of :data:`STYLES`."""
    order = list(STYLES)
    rows = sorted(statuses, key=lambda one: order.index(one.state))
    shown = rows if height is None or len(rows) <= height else rows[: max(height, 1)]
    hidden = f"; {len(rows) - len(shown)} not shown" if len(shown) < len(rows) else ""
    result = plain_table(_count(statuses) + hidden)
    result.add_column("run", overflow="fold")
    result.add_column("state")
    for name in ("steps", "steps/s", "return", "left"):
        result.add_column(name, justify="right", no_wrap=True)
    for one in shown:
        result.add_row(Text(_name(one.folder, folder)), *_cells(one), style=STYLES[one.state])
    return result


def _print_changes(folder: Path, runs: Runs | None, ended: threading.Event, terminal: TextIO) -> None:
    """Print a line whenever a run changes its state; runs in this process replace ``sys.stdout`` by their log."""
    states: dict[Path, str] = {}
    last = False
    while not last:
        last = ended.wait(INTERVAL)
        statuses = look(folder, runs)
        for one in statuses:
            if states.get(one.folder, "waiting") != one.state:
                state, *cells = _cells(one)
                line = f"{time.strftime('%H:%M:%S')} {state:8} {_name(one.folder, folder)} {' '.join(cells[:3])}"
                print(f"{line} ({_count(statuses)})", file=terminal, flush=True)
            states[one.folder] = one.state


def _cells(one: Status) -> tuple[str, ...]:
    steps = f"{min(one.frames, one.total):,}/{one.total:,}"  # the last batch may exceed the total
    speed = f"{one.speed:,.0f}" if one.state == "running" and one.speed else "-"
    score = "-" if one.normalised_return is None else f"{one.normalised_return:.3f}"
    remaining = "-" if one.remaining is None else duration(one.remaining)
    return one.state, steps, speed, score, remaining


def _count(statuses: Sequence[Status]) -> str:
    numbers = Counter(one.state for one in statuses)
    return ", ".join(f"{numbers[state]} {state}" for state in STYLES if numbers[state])


def _name(run: Path, folder: Path) -> str:
    return os.path.relpath(run, folder)


def _plan(run: Path) -> tuple[int, int]:
    """Return the environment steps of a run, and the number of episodes of its final evaluation."""
    config = run / CONFIG
    return _plan_in(config, config.stat().st_mtime_ns)


@cache
def _plan_in(path: Path, changed: int) -> tuple[int, int]:
    """Return the plan in a configuration, which is read again when the file has changed."""
    config = read_config(path)
    return int(config["training"]["total_frames"]), int(config.get("evaluation", {}).get("episodes", 0))


def _is_saved(run: Path, total: int) -> bool:
    """Return whether a run has its final checkpoint, which is written after the last row of metrics."""
    return any(run_folder.frames(path) >= total for path in run_folder.find_all(run))


def _last_row(path: Path) -> dict[str, float]:
    """Return the last complete row of a CSV file of numbers, or an empty row."""
    if not path.exists():
        return {}
    with path.open("rb") as file:
        names = file.readline().decode().strip()
        file.seek(max(file.tell(), path.stat().st_size - 2 * (len(names) + 2000)))
        lines = file.read().decode().splitlines(keepends=True)
    whole = [line for line in lines if line.endswith("\n") and line.count(",") == names.count(",")]
    if not whole:
        return {}
    row = next(csv.DictReader([names, whole[-1]]))
    return {name: float(value or "nan") for name, value in row.items()}
