"""Table 2: the runs of the seven methods, archived, with their tables and learning curves.

    torchrl-mcp-train benchmark=table2 preset=comparison benchmark.pretrain_seed=0 seed=0,1 run_root=runs/table2
    python benchmarks/table2.py runs/table2    # archives the complete runs, and writes the results
    python benchmarks/table2.py                # writes the results again, from the archive

Everything lands in ``results/table2``. ``runs.tar.xz`` has the run folders without checkpoints, and of their metrics
only the columns of learning curves; ``torchrl-mcp-report`` reads it unpacked. ``table.md`` is Table 2 with our results.
Each row has a table, ``TASK_CHARACTER.md``, and learning curves; ``imitation_CHARACTER`` and ``holdout_ant_pretrain``
have those of pre-training. ``runs.csv`` has the command, the commit and the machine of every run.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from archive import EMPTY, archived, average, is_short, score, write_tables

from torchrl_mcp.report.comparison import Cell
from torchrl_mcp.report.paper import CHARACTERS, METHODS, PLACES, TABLE_2
from torchrl_mcp.runs.tables import text_table

RESULTS = Path(__file__).resolve().parent / "results" / "table2"


def title(method: str) -> str:
    """Return the heading of a method's column."""
    return {"mcp": "MCP", "moe": "MOE"}.get(method, method.replace("_", " ").capitalize())


SHORT = "Scratch, short"
COLUMNS = ("Scratch", SHORT, *map(title, METHODS[1:]))
"""Columns of Table 2."""


def main() -> None:
    """Archive runs if a folder is given, and write the results of the archive."""
    with archived(__doc__, RESULTS) as (found, output):
        table = text_table(table_2(found), markdown=True)
        (output / "table.md").write_text(table + "\n")
        print(table)
        write_tables(found, output)


def table_2(found: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return the rows of Table 2: ours with the number of seeds, and the paper's below.

    Methods are compared after as many steps as the shortest of their runs; longer ones are left to the table of the
    task. Scratch has two columns: with more steps than the other methods, and with as many. Of several cells of a
    method, such as two kinds of exploration, the best is in the table.
    """
    table = []
    for place in PLACES:
        here = [cell for cell in found if cell.place == place and cell.stage == "transfer" and cell.is_standard]
        best: dict[str, Cell] = {}
        for cell in here:
            column = title(cell.method)
            if cell.method == "scratch":
                column = SHORT if is_short(cell, here) else column
            elif not is_short(cell, here):
                continue
            best[column] = max(best.get(column, cell), cell, key=lambda cell: average(cell.returns()))
        paper = {title(name): TABLE_2[*place, name].mean for name in METHODS if (*place, name) in TABLE_2}
        table.append({"": f"{place[0]}, {CHARACTERS[place[1]]}"} | {name: score(best.get(name)) for name in COLUMNS})
        table.append({"": "*paper*"} | {name: f"*{paper[name]:.3f}*" if name in paper else EMPTY for name in COLUMNS})
    return table


if __name__ == "__main__":
    main()
