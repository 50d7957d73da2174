"""Writes archives of runs, which are run folders without checkpoints, and tables and learning curves of these runs.

An archive contains the configuration, the evaluation and the provenance of each run, and the metrics of learning
curves. ``torchrl-mcp-report`` reads an unpacked archive.
"""

import argparse
import csv
import io
import shlex
import tarfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from tempfile import TemporaryDirectory
from typing import Any

from report import write

from torchrl_mcp.analysis.curves import Curve, draw_curves, learning_curves
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.report.cell import DEFAULT, Cell
from torchrl_mcp.report.comparison import cells
from torchrl_mcp.report.paper import PLACES
from torchrl_mcp.report.results import Run, find_runs
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.run_folder import (
    CONFIG,
    EVALUATION,
    METRICS,
    MODES,
    NORMALISED_RETURN,
    PROVENANCE,
    read_metrics,
    replacing,
)

ARCHIVE = "runs.tar.xz"
SUCCESS = "task/success"
"""Column of metrics with the share of training steps with a success, in tasks that define success."""

CURVE = (
    *("iteration", "frames", "seconds", "episode/count", NORMALISED_RETURN, "episode/length"),
    *(SUCCESS, "loss/kl", "policy/std"),
)
"""Columns of metrics in an archive, if a run has them: learning curves, wall times, and the size of updates."""

EMPTY = ""
"""Text of a table's cell without runs, or without a number in the paper."""


@contextmanager
def archived(description: str, results: Path) -> Iterator[tuple[list[Cell], Path]]:
    """Archive runs if the command line gives a folder of runs, and unpack the archive.

    Args:
        description: Description of the script.
        results: Folder of the archive, unless the command line gives another folder.

    Yields:
        The archived runs as cells, and the folder of the archive.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="?", help="run_root of runs to archive; default: read the archive")
    parser.add_argument("--output", type=Path, default=results, help="folder of the archive and of the results")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    archive = arguments.output / ARCHIVE
    if arguments.runs:
        pack(arguments.runs, archive)
    elif not archive.exists():
        parser.error(f"there is no {archive}: give the folder of the runs")
    with TemporaryDirectory() as folder:
        unpack(archive, Path(folder))
        yield cells(find_runs([Path(folder)])[0]), arguments.output


def unpack(archive: Path, folder: Path) -> None:
    """Unpack an archive, without files outside the folder where Python can refuse them (from 3.11.4 on)."""
    with tarfile.open(archive) as packed:
        packed.extraction_filter = getattr(tarfile, "data_filter", None)
        packed.extractall(folder)


def pack(root: Path, archive: Path) -> None:
    """Write the complete runs of a folder to an archive, without checkpoints and without paths of this machine.

    Raises:
        SystemExit: If the folder contains no complete run.
    """
    runs = [run for run in find_runs([root])[0] if run.state == "complete"]
    if not runs:
        raise SystemExit(f"{root} contains no complete run: give a folder of runs that are trained and evaluated")
    with replacing(archive) as partial, tarfile.open(partial, "w:xz", preset=9) as packed:
        for run in runs:
            files = (run.path / name for name in (CONFIG, EVALUATION, PROVENANCE))
            contents = {file.name: file.read_text() for file in files if file.exists()}  # older runs have no origin
            contents[METRICS] = curve(run.path / METRICS)
            for name, content in contents.items():
                data = content.replace(str(root.resolve()), "runs").replace(str(root.absolute()), "runs").encode()
                entry = tarfile.TarInfo(f"{run.path.relative_to(root)}/{name}")
                entry.size = len(data)
                packed.addfile(entry, io.BytesIO(data))


def curve(metrics: Path) -> str:
    """Return the metrics of a run with those columns of ``CURVE`` that the run has."""
    columns = io.StringIO()
    with metrics.open(newline="") as file:
        rows = csv.DictReader(file)
        known = [name for name in CURVE if name in (rows.fieldnames or ())]
        writer = csv.DictWriter(columns, known, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return columns.getvalue()


def write_tables(groups: Sequence[Cell], output: Path) -> None:
    """Write the table and the learning curves of each task, and the list of all runs.

    The table of a task contains all runs. The curves omit runs that have more steps than the shortest runs of their
    method, except for scratch. A picture ends at four times the steps of its shortest curve.
    """
    for place, stage in dict.fromkeys((cell.place, cell.stage) for cell in groups):
        of_task = [cell for cell in groups if (cell.place, cell.stage) == (place, stage)]
        twice = stage == "pretrain" and place in PLACES  # holdout is learned in both stages
        stem = output / "_".join([*place, stage] if twice else place)
        lines = [line(cell) | time for cell, time in zip(of_task, times(of_task), strict=True)]
        stem.with_suffix(".md").write_text(text_table(lines, markdown=True) + "\n")
        drawn = [cell for cell in of_task if stage == "pretrain" or cell.method == "scratch" or is_short(cell, of_task)]
        if curves := [curve for cell in drawn if (curve := learning_curve(cell))]:
            figure = draw_curves(curves, ylabel="normalised return in training")
            ends = [float(curve.frames[-1]) for curve in curves]
            figure.axes[0].set_xlim(0, min(4 * min(ends), max(ends)))
            save_figure(figure, stem)
    write(output / "runs.csv", [row for cell in groups for run in cell.complete for row in rows(cell, run)])


def is_short(cell: Cell, cells: Sequence[Cell]) -> bool:
    """Return whether no cell of the same method has fewer steps.

    A cell of scratch is compared with the cells of all other methods.
    """
    compared = [one for one in cells if one.method != "scratch" and cell.method in ("scratch", one.method)]
    steps = [one.complete[0].total_frames for one in compared]
    return cell.complete[0].total_frames <= min(steps, default=0)


def label(cell: Cell) -> str:
    """Return the name of a cell in the table of its task: the method, and the differences from its other cells.

    Settings with the method's standard value or with their default are omitted.
    """
    standard = cell.runs[0].standard
    settings = [
        f"pre-trained {value / 1e6:g} M" if name.startswith("budget.pretrain") else f"{name}={value}"
        for name, value in cell.settings.items()
        if name not in ("preset", "total_frames") and value != standard.get(name, DEFAULT)
    ]
    steps = [f"{cell.complete[0].frames / 1e6:.1f} M steps"] if "total_frames" in cell.settings else []
    return ", ".join([cell.title, *steps, *settings])


def line(cell: Cell) -> dict[str, Any]:
    """Return a row of the table of a task, without the columns of :func:`times`."""
    chosen = [run.evaluation["deterministic"] for run in cell.complete]
    deviation = f" ± {cell.deviation():.3f}" if len(cell.by_seed) > 1 else ""
    facts: dict[str, Any] = {
        "": label(cell),
        "seeds": len(cell.by_seed),
        "steps": f"{cell.complete[0].frames:,}",
        "deterministic": f"{fmean(cell.returns()):.3f}{deviation}",
        "stochastic": f"{fmean(cell.returns('stochastic')):.3f}",
    }
    ended = fmean([numbers["terminated"] for numbers in chosen])
    if cell.place[0] != "imitation":
        facts["terminated" if cell.place[0] == "holdout" else "fallen"] = f"{ended:.0%}"
    if "success" in cell.metrics:
        facts["success"] = f"{cell.metrics['success']:.0%}"
        if cell.success_return is not None:
            facts["success pays 1"] = f"{cell.success_return:.3f}"
    if cell.place[0] == "imitation":
        facts["completed"] = f"{1 - ended:.0%}"
        facts["tracking error"] = f"{cell.metrics['tracking_error']:.3f} m"
    else:
        facts["skill"] = f"{cell.reach['skill']:.2f}" if cell.reach else EMPTY
        facts["paper"] = f"{cell.reported.mean:.3f} ± {cell.reported.std:.3f}" if cell.reported else EMPTY
    return facts


def times(of_task: Sequence[Cell]) -> Iterator[dict[str, Any]]:
    """Yield the last columns of each row of the table of a task: minutes of training, speed of learning, commits.

    The speed is the time until a learning curve reaches 0.8 of the highest final return of the table. In tasks that
    define success, easy training episodes reach this return soon. The speed is then the time until the share of steps
    with a success is half of the highest final share; the column is omitted for archives without this share.
    """
    defines_success = any("success" in cell.metrics for cell in of_task)
    quantity = SUCCESS if defines_success else NORMALISED_RETURN
    share_of_best = 0.5 if defines_success else 0.8
    name = "to half" if defines_success else "to 0.8"
    curves = [learning_curve(cell, quantity) for cell in of_task]
    final = [float(curve.mean[-1]) for curve in curves if curve]
    for cell, curve in zip(of_task, curves, strict=True):
        taken = minutes_to(cell, curve, share_of_best * max(final)) if curve else None
        speed = {name: EMPTY if taken is None else f"{taken:.1f}"} if final or not defines_success else {}
        yield {"minutes": round(cell.seconds / 60)} | speed | {"commit": ", ".join(cell.commits)}


def minutes_to(cell: Cell, curve: Curve, goal: float) -> float | None:
    """Return the minutes of training until a cell's learning curve, a mean over seeds, reaches a goal, or None."""
    reached = [frames for frames, value in zip(curve.frames, curve.mean, strict=True) if value >= goal]
    return float(reached[0]) / cell.complete[0].frames * cell.seconds / 60 if reached else None


def learning_curve(cell: Cell, quantity: str = NORMALISED_RETURN) -> Curve | None:
    """Return the learning curve of a cell, from the first run of each seed, in bins of the cell's steps.

    Runs in which no episode of full length has ended, or whose metrics lack the quantity, are omitted. If no run
    remains, or the seeds have no steps in common, the result is None.
    """
    paths = [runs[0].path for runs in cell.by_seed.values() if runs[0].has_episodes]
    paths = [path for path in paths if quantity in read_metrics(path)[0]]
    curve = learning_curves({label(cell): paths}, quantity=quantity)[0] if paths else None
    return curve if curve and len(curve.frames) else None


def score(cell: Cell | None) -> str:
    """Return the text of a cell: the mean deterministic return, the share of successes, and the number of seeds."""
    if cell is None:
        return EMPTY
    success = f", {share(cell)}" if share(cell) else EMPTY
    return f"{fmean(cell.returns()):.3f}{success} ({len(cell.by_seed)})"


def share(cell: Cell) -> str:
    """Return the share of successful episodes, or an empty text for tasks that do not define success."""
    return f"{cell.metrics['success']:.0%}" if "success" in cell.metrics else EMPTY


def rows(cell: Cell, run: Run) -> Iterator[dict[str, Any]]:
    """Yield a row with a run's settings, results and provenance for each mode."""
    machine = run.provenance.get("machine", {})
    commands = [run.provenance.get("command", []), *(entry["command"] for entry in run.provenance.get("extended", []))]
    for mode in MODES:
        numbers = run.evaluation[mode]
        yield {
            **dict(zip(("task", "character"), cell.place, strict=True)),
            "method": label(cell),
            "stage": cell.stage,
            "seed": run.seed,
            "steps": run.frames,
            "mode": mode,
            **{key: numbers[key] for key in ("normalised_return", "interval", "return", "length", "terminated")},
            "success": numbers["metrics"].get("success", EMPTY),
            "skill": numbers.get("reach", {}).get("skill", EMPTY),
            "success_return": numbers.get("success_return", EMPTY),
            "episodes": numbers["episodes"],
            "seconds": round(run.seconds),
            "preset": run.preset,
            "commit": run.commit,
            **{key: machine.get(key, "") for key in ("processor", "cores", "torch", "mujoco")},
            "command": " && ".join(map(shlex.join, commands)),
        }
