"""Table 2: the runs of the seven methods, archived, with their tables and learning curves.

    torchrl-mcp-train benchmark=table2 preset=comparison benchmark.pretrain_seed=0 seed=0,1 run_root=runs/table2
    python benchmarks/table2.py runs/table2    # archives the complete runs, and writes the results
    python benchmarks/table2.py                # writes the results again, from the archive

Everything lands in ``results/table2``. ``runs.tar.xz`` has the run folders without checkpoints, and of their metrics
only the columns of learning curves; ``torchrl-mcp-report`` reads it unpacked. ``table.md`` is Table 2 with our results.
Each row has a table, ``TASK_CHARACTER.md``, and learning curves; ``imitation_CHARACTER`` and ``holdout_ant_pretrain``
have those of pre-training. ``runs.csv`` has the command, the commit and the machine of every run.
"""

import argparse
import csv
import io
import shlex
import tarfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from report import write

from torchrl_mcp.analysis.curves import draw_curves, learning_curves
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.report.comparison import Cell, cells
from torchrl_mcp.report.paper import CHARACTERS, METHODS, PLACES, TABLE_2
from torchrl_mcp.report.results import MODES, Run, find_runs
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, METRICS, NORMALISED_RETURN, PROVENANCE

RESULTS = Path(__file__).resolve().parent / "results" / "table2"
ARCHIVE = "runs.tar.xz"
CURVE = ("iteration", "frames", "seconds", "episode/count", NORMALISED_RETURN)
"""Columns of metrics in the archive: those of learning curves and wall times."""

EMPTY = ""
"""A cell of Table 2 without runs, or without a number in the paper."""


def title(method: str) -> str:
    """Return the heading of a method's column."""
    return {"mcp": "MCP", "moe": "MOE"}.get(method, method.replace("_", " ").capitalize())


SHORT = "Scratch, short"
COLUMNS = ("Scratch", SHORT, *map(title, METHODS[1:]))
"""Columns of Table 2."""


def main() -> None:
    """Archive runs if a folder is given, and write the results of the archive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="?", help="the benchmark's run_root; default: the archive")
    parser.add_argument("--output", type=Path, default=RESULTS, help="folder to write to, with the archive")
    arguments = parser.parse_args()
    arguments.output.mkdir(parents=True, exist_ok=True)
    archive = arguments.output / ARCHIVE
    if arguments.runs:
        pack(arguments.runs, archive)
    elif not archive.exists():
        parser.error(f"there is no {archive}: give the folder of the runs")
    with TemporaryDirectory() as folder:
        with tarfile.open(archive) as packed:
            packed.extractall(folder, filter="data")
        found = cells(find_runs([Path(folder)])[0])
        write_results(found, arguments.output)


def pack(root: Path, archive: Path) -> None:
    """Write the complete runs of a folder, without checkpoints and without names of folders of this machine."""
    runs = [run for run in find_runs([root])[0] if run.state == "complete"]
    with tarfile.open(archive, "w:xz", preset=9) as packed:
        for run in runs:
            contents = {name: (run.path / name).read_text() for name in (CONFIG, EVALUATION, PROVENANCE)}
            contents[METRICS] = curve(run.path / METRICS)
            for name, content in contents.items():
                data = content.replace(str(root.resolve()), "runs").replace(str(root), "runs").encode()
                entry = tarfile.TarInfo(f"{run.path.resolve().relative_to(root.resolve())}/{name}")
                entry.size = len(data)
                packed.addfile(entry, io.BytesIO(data))


def curve(metrics: Path) -> str:
    """Return the metrics of a run with the columns of ``CURVE`` alone."""
    kept = io.StringIO()
    with metrics.open(newline="") as file:
        writer = csv.DictWriter(kept, CURVE, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(csv.DictReader(file))
    return kept.getvalue()


def write_results(found: Sequence[Cell], output: Path) -> None:
    """Write all tables and figures of the cells, and print Table 2."""
    table = text_table(table_2(found), markdown=True)
    (output / "table.md").write_text(table + "\n")
    print(table)
    for place, stage in dict.fromkeys((cell.place, cell.stage) for cell in found):
        here = [cell for cell in found if (cell.place, cell.stage) == (place, stage)]
        twice = stage == "pretrain" and place in PLACES  # holdout is learned in both stages
        stem = output / "_".join([*place, stage] if twice else place)
        stem.with_suffix(".md").write_text(text_table([line(cell) for cell in here], markdown=True) + "\n")
        curves = learning_curves({label(cell): [run.path for run in cell.complete] for cell in here})
        save_figure(draw_curves(curves), stem)
    write(output / "runs.csv", [row for cell in found for run in cell.complete for row in rows(cell, run)])


def table_2(found: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return the rows of Table 2: ours with the number of seeds, and the paper's below.

    Scratch has two columns: with more steps than the other methods' transfer, and with as many. Of several cells of a
    method, such as two kinds of exploration, the best is in the table.
    """
    table = []
    for place in PLACES:
        here = [cell for cell in found if cell.place == place and cell.stage == "transfer" and cell.is_standard]
        transfer = max((cell.complete[0].frames for cell in here if cell.method != "scratch"), default=0)
        best: dict[str, Cell] = {}
        for cell in here:
            column = title(cell.method)
            if cell.method == "scratch" and cell.complete[0].frames <= transfer:
                column = SHORT
            best[column] = max(best.get(column, cell), cell, key=lambda cell: average(cell.returns()))
        paper = {title(name): TABLE_2[*place, name].mean for name in METHODS if (*place, name) in TABLE_2}
        table.append({"": f"{place[0]}, {CHARACTERS[place[1]]}"} | {name: score(best.get(name)) for name in COLUMNS})
        table.append({"": "*paper*"} | {name: f"*{paper[name]:.3f}*" if name in paper else EMPTY for name in COLUMNS})
    return table


def score(cell: Cell | None) -> str:
    """Return a cell of Table 2: the mean deterministic return, the share of successes, and the number of seeds."""
    if cell is None:
        return EMPTY
    success = f", {cell.metrics['success']:.0%}" if "success" in cell.metrics else ""
    return f"{average(cell.returns()):.3f}{success} ({len(cell.complete)})"


def label(cell: Cell) -> str:
    """Return the name of a cell in the table of its task: the method, and how it differs from others of the method."""
    others = [f"{name}={value}" for name, value in cell.settings.items() if name not in ("preset", "total_frames")]
    steps = [f"{cell.complete[0].frames / 1e6:.1f} M steps"] if "total_frames" in cell.settings else []
    return ", ".join([cell.title, *steps, *others])


def line(cell: Cell) -> dict[str, Any]:
    """Return a row of the table of a task."""
    chosen = [run.evaluation["deterministic"] for run in cell.complete]
    deviation = f" ± {cell.deviation():.3f}" if len(chosen) > 1 else ""
    facts: dict[str, Any] = {
        "": label(cell),
        "seeds": len(chosen),
        "steps": f"{cell.complete[0].frames:,}",
        "deterministic": f"{average(cell.returns()):.3f}{deviation}",
        "stochastic": f"{average(cell.returns('stochastic')):.3f}",
        "fallen": f"{average([numbers['terminated'] for numbers in chosen]):.0%}",
    }
    if "success" in cell.metrics:
        facts["success"] = f"{cell.metrics['success']:.0%}"
    if cell.place[0] == "imitation":
        facts["completed"] = f"{1 - average([numbers['terminated'] for numbers in chosen]):.0%}"
        facts["tracking error"] = f"{cell.metrics['tracking_error']:.3f} m"
        del facts["fallen"]
    else:
        facts["place"] = f"{cell.reach['place']:.2f}" if cell.reach else EMPTY
        facts["paper"] = f"{cell.reported.mean:.3f} ± {cell.reported.std:.3f}" if cell.reported else EMPTY
    return facts | {"minutes": round(cell.seconds / 60), "commit": ", ".join(cell.commits)}


def average(values: Sequence[float]) -> float:
    """Return the mean."""
    return sum(values) / len(values)


def rows(cell: Cell, run: Run) -> Iterator[dict[str, Any]]:
    """Yield the facts about a run with its results, for each mode."""
    machine, command = run.provenance.get("machine", {}), run.provenance.get("command", [])
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
            "place": numbers.get("reach", {}).get("place", EMPTY),
            "episodes": numbers["episodes"],
            "seconds": round(run.seconds),
            "preset": run.preset,
            "commit": run.commit,
            **{key: machine.get(key, "") for key in ("processor", "cores", "torch", "mujoco")},
            "command": shlex.join(command),
        }


if __name__ == "__main__":
    main()
