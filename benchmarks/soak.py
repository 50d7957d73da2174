"""Tests the library with deliberate faults: kills and full disks in training, damaged checkpoints, invalid actions.

    python benchmarks/soak.py training    # 50 minutes, writes results/soak_training.csv
    python benchmarks/soak.py flips       # a minute, writes results/soak_flips.csv
    python benchmarks/soak.py steps       # half an hour, writes results/soak_steps.csv

``--quick`` takes fewer steps, and writes a file only with ``--output``.

*training*: Runs use a file system of 16 MB in memory, which is full for 5 to 15 seconds after every 90 to 180 seconds.
If this user is not permitted to mount one, files cannot grow at these times (``RLIMIT_FSIZE``). The main process
receives SIGKILL after one to three minutes, its workers do not. A run that has ended is resumed until it is complete.
Then another run begins, until the time is over. Columns:

- ``slowest_end_s``: seconds until the last process of a killed run had ended
- ``wrong``: rows with a wrong step or a loss that is not finite, and steps that the csv logger lacks or has twice
- ``changed``: rows before a checkpoint that changed when the run was resumed
- ``differing``: rows, and members of the last checkpoint, that differ in any bit from an undisturbed run. Only
  ``collector=local`` has a number, because workers begin new episodes

*flips*: One random bit of a checkpoint is inverted. ``harmless`` counts files that were accepted with unchanged
contents.

*steps*: A third of the simulations receive targets drawn uniformly within their bounds, a third also receive magnitudes
up to 1e12 and infinity, and a third also receive NaN. ``unfit`` counts actions that are not finite or beyond MuJoCo's
limit. These must end their episode with reward 0; ``missed`` counts those that do not. ``diverged`` counts divergences
after all other actions, and ``not_finite`` counts outputs that are not finite.
"""

import argparse
import csv
import math
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import count, zip_longest
from pathlib import Path
from typing import Any

from report import about, table, write
from soak_disk import Disk, small_disk
from soak_inputs import SMALL, TASKS, contents, flips, steps

from torchrl_mcp.training import checkpoint, run_folder

RESULTS = Path(__file__).resolve().parent / "results"
BATCH = 512
TRAIN = [sys.executable, "-m", "torchrl_mcp.commands.train"]
SETTINGS = (
    *SMALL,
    *("logger=csv", "progress_bar=false", "num_threads=1", "torch_threads=1", "checkpoint_interval=5"),
    *("training.num_envs=16", f"training.frames_per_batch={BATCH}", "training.minibatch_size=128"),
)
KILL = (60.0, 180.0)
"""Minimum and maximum seconds after which a run is killed."""


def attempt(settings: list[str], disk: Disk, log: Path, due: Callable[[], bool]) -> tuple[str, float]:
    """Run training until it ends or ``due`` returns True, and then kill it.

    Returns:
        How the training ended: ``killed``, ``done``, ``disk_full`` or its last line of output. The seconds until its
        last process had ended.
    """
    with log.open("wb") as file:
        process = subprocess.Popen([*TRAIN, *settings], stdout=file, stderr=file, start_new_session=True)
    while process.poll() is None and not due():
        disk.pass_time(process)
        time.sleep(0.1)
    killed = process.poll() is None
    process.kill()
    process.wait()
    began = time.monotonic()
    while any(_group(stat) == process.pid for stat in Path("/proc").glob("[0-9]*/stat")):
        time.sleep(0.05)
    last_line = log.read_text(errors="replace").strip().rpartition("\n")[2]
    full = any(text in last_line for text in ("No space left", "File too large"))
    end = "killed" if killed else "done" if not process.returncode else "disk_full" if full else last_line
    return end, time.monotonic() - began


def _group(stat: Path) -> int:
    """Return the process group of a living process, or 0 for an ended one."""
    with suppress(OSError):
        state, _, group = stat.read_text().rpartition(")")[2].split()[:3]
        return 0 if state == "Z" else int(group)
    return 0


def _past(deadline: float) -> bool:
    return time.monotonic() >= deadline


def _saved(folder: Path) -> bool:
    return bool(run_folder.find_all(folder))


def disturbed(folder: Path, settings: list[str], disk: Disk, log: Path, quick: bool) -> dict[str, Any]:
    """Train, and resume after each interruption, until the run is complete; return the columns of a row."""
    ends: Counter[str] = Counter()
    slowest = 0.0
    changed = 0
    before: list[dict[str, str]] = []
    began = time.monotonic()
    while not ends["done"]:
        begun = (folder / run_folder.CONFIG).exists()
        if quick:  # kill the run only once, after its first checkpoint
            due = (lambda: False) if ends["killed"] else partial(_saved, folder)
        else:
            due = partial(_past, time.monotonic() + random.uniform(*KILL))
        end, seconds = attempt([f"resume={folder}"] if begun else settings, disk, log, due)
        if end not in ("killed", "disk_full", "done"):
            print(log.read_text(errors="replace")[-3000:], flush=True)
        ends[end] += 1
        slowest = max(slowest, seconds)
        now = rows(folder)
        changed += sum(old != new for old, new in zip(before, now, strict=False)) + max(len(before) - len(now), 0)
        saved = max((run_folder.frames(path) for path in run_folder.find_all(folder)), default=0)
        before = [row for row in now if row["frames"] and int(row["frames"]) <= saved]
    expected = {end: ends.pop(end, 0) for end in ("killed", "disk_full", "done")}
    minutes = round((time.monotonic() - began) / 60, 1)
    return {
        "minutes": minutes,
        **expected,
        "other_ends": ends.total(),
        "slowest_end_s": round(slowest, 1),
        "changed": changed,
    }


def rows(folder: Path) -> list[dict[str, str]]:
    """Return the complete rows of a run's metrics, without times."""
    path = folder / run_folder.METRICS
    if not path.exists():
        return []
    text = path.read_text()
    whole = csv.DictReader(text[: text.rfind("\n") + 1].splitlines())
    return [{key: row[key] for key in row if not key.startswith(("seconds", "time/"))} for row in whole]


def wrong(folder: Path, total: int) -> int:
    """Count wrong steps in metrics and log, and losses that are not finite."""
    expected = [str(frames) for frames in range(BATCH, total + 1, BATCH)]
    metrics = rows(folder)
    logged = [line.partition(",")[0] for line in (folder / "csv/scalars/reward.csv").read_text().splitlines()]
    recorded = ([row["frames"] for row in metrics], logged)
    misplaced = sum(step != frames for steps in recorded for step, frames in zip_longest(expected, steps))
    losses = (float(value) for row in metrics for name, value in row.items() if name.startswith("loss/"))
    return misplaced + sum(not math.isfinite(loss) for loss in losses)


def differing(first: Path, second: Path) -> int:
    """Count the rows of metrics and the members of the last checkpoint in which two runs differ."""
    states = [contents(checkpoint.find(folder)) for folder in (first, second)]
    names = states[0].keys() | states[1].keys()
    return sum(a != b for a, b in zip_longest(rows(first), rows(second))) + sum(
        states[0].get(name) != states[1].get(name) for name in names
    )


def training(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Kill runs and fill their disk."""
    total = 20 * BATCH if args.quick else args.frames
    end = time.monotonic() + 60 * args.minutes
    for seed in count():
        common = [*SETTINGS, f"seed={seed}", f"training.total_frames={total}"]
        with small_disk(0.1 if args.quick else 1.0) as (folder, disk), tempfile.TemporaryDirectory() as calm:
            undisturbed = Path(calm) / "whole"
            log = Path(calm) / "log"
            if "local" in args.collectors:
                subprocess.run([*TRAIN, *common, f"run_dir={undisturbed}"], check=True, stdout=subprocess.DEVNULL)
            for collector in args.collectors:
                run = folder / collector
                settings = [*common, f"collector={collector}", f"run_dir={run}"]
                row = {"collector": collector, "seed": seed, "frames": total, "disk": disk.kind}
                row |= disturbed(run, settings, disk, log, args.quick)
                row |= {"rows": len(rows(run)), "wrong": wrong(run, total)}
                yield row | {"differing": differing(undisturbed, run) if collector == "local" else ""}
                shutil.rmtree(run)
        if args.quick or time.monotonic() > end:
            return


def main() -> None:
    """Run the chosen test, print and write its rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("test", choices=["training", "flips", "steps"])
    parser.add_argument("--minutes", type=float, default=50.0, help="minutes of training (default 50)")
    parser.add_argument("--frames", type=int, default=200 * BATCH, help=f"steps of each run (default {200 * BATCH:,})")
    parser.add_argument("--flips", type=int, default=1000, help="number of inverted bits (default 1000)")
    parser.add_argument("--steps", type=int, default=10_000_000, help="control steps (default 10,000,000)")
    sources = ["local", "processes"]
    parser.add_argument(
        "--collectors", nargs="+", choices=sources, default=sources, help="collectors of training (default both)"
    )
    tasks = sorted({task for task, _ in TASKS})
    parser.add_argument("--tasks", nargs="+", choices=tasks, default=tasks, help="tasks of steps (default all)")
    parser.add_argument("--threads", type=int, default=2, help="physics threads of steps (default 2)")
    parser.add_argument("--quick", action="store_true", help="do less")
    parser.add_argument("--output", type=Path, help="CSV file; without --quick there is a default")
    args = parser.parse_args()
    output = args.output or (None if args.quick else RESULTS / f"soak_{args.test}.csv")
    output = output and output.resolve()
    random.seed(0)
    conditions = {"command": " ".join(["python", *sys.argv]), **about()}
    measured = []
    for row in {"training": training, "flips": flips, "steps": steps}[args.test](args):
        print(table([row]), flush=True)
        measured.append({**row, **conditions})
        if output:  # after each row, so that an interruption loses no rows
            write(output, measured)


if __name__ == "__main__":
    main()
