"""Archives the runs of the guide's benchmark of Gymnasium's cheetah, and writes their table and learning curves.

    cd docs/guide && torchrl-mcp-train --config-dir own benchmark=cheetah run_root=../../runs/cheetah && cd ../..
    python benchmarks/cheetah.py runs/cheetah    # archives the complete runs, and writes the results
    python benchmarks/cheetah.py                 # writes the results again, from the archive

The script writes to ``results/cheetah``: ``table.md``, the learning curves of the new speeds, ``runs.csv`` with the
command, the commit and the machine of every run, and the archive ``runs.tar.xz``.
"""

from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from archive import EMPTY, archived, learning_curve, rows
from report import write

from torchrl_mcp.analysis.curves import draw_curves
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.report.cell import Cell
from torchrl_mcp.runs.tables import text_table

RESULTS = Path(__file__).resolve().parent / "results" / "cheetah"


def main() -> None:
    """Archive runs if a folder is given, and write the results of the archive."""
    with archived(__doc__, RESULTS) as (groups, output):
        table = text_table([line(cell, groups) for cell in groups if cell.stage == "transfer"], markdown=True)
        (output / "table.md").write_text(table + "\n")
        print(table)
        curves = [curve for cell in groups if cell.stage == "transfer" and (curve := learning_curve(cell))]
        figure = draw_curves(curves, ylabel="normalised return in training")
        figure.axes[0].set_xlim(0, min(float(curve.frames[-1]) for curve in curves))
        save_figure(figure, output / "new_speeds")
        write(output / "runs.csv", [row for cell in groups for run in cell.complete for row in rows(cell, run)])


def line(cell: Cell, groups: Sequence[Cell]) -> dict[str, Any]:
    """Return a row of the table: the returns of both stages of a method, and the error of the speed after transfer."""
    before = [other for other in groups if other.stage == "pretrain" and other.method == cell.method]
    return {
        "": cell.title,
        "steps": f"{cell.steps:,}",
        "at the seven speeds": mean_and_deviation(before[0]) if before else EMPTY,
        "at the new speeds": mean_and_deviation(cell),
        "exploring": f"{fmean(cell.returns('stochastic')):.3f}",
        "error of the speed": f"{cell.metrics['speed_error']:.2f} m/s",
        "seeds": len(cell.by_seed),
    }


def mean_and_deviation(cell: Cell) -> str:
    """Return the mean deterministic return of a cell and its standard deviation over seeds."""
    return f"{fmean(cell.returns()):.3f} ± {cell.deviation():.3f}"


if __name__ == "__main__":
    main()
