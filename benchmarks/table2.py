"""Archives the runs of Table 2, and writes tables, pictures and learning curves of the seven methods.

    torchrl-mcp-train benchmark=table2 preset=comparison autocast=false run_root=runs/table2
    python benchmarks/table2.py runs/table2    # archives the complete runs, and writes the results
    python benchmarks/table2.py                # writes the results again, from the archive

The script writes to ``results/table2``:

- ``runs.tar.xz``: the run folders without checkpoints, and with the metrics of learning curves only. After unpacking,
  ``torchrl-mcp-report`` can read them
- ``table.md``: Table 2 with our results
- ``summary.md``: a short form of this table for the README
- ``table_2.png``: the picture of the report
- ``over_rows.png``: interquartile means over the rows, and the probability that MCP is ahead
- ``TASK_CHARACTER.md`` and pictures of the same name: a table and learning curves for each row. The files
  ``imitation_CHARACTER`` and ``holdout_ant_pretrain`` show pre-training
- ``runs.csv``: the command, the commit and the machine of every run
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from archive import EMPTY, archived, is_short, score, share, write_tables

from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.report.cell import Cell
from torchrl_mcp.report.paper import CHARACTERS, PLACES, TABLE_2, TITLES
from torchrl_mcp.report.table_2 import average, compared, draw_over_rows, draw_table_2
from torchrl_mcp.runs.tables import text_table

RESULTS = Path(__file__).resolve().parent / "results" / "table2"
SHORT = "Scratch, short"


def main() -> None:
    """Archive runs if a folder is given, and write the results of the archive."""
    with archived(__doc__, RESULTS) as (groups, output):
        for name, rows in (("table", list(table_2(groups))), ("summary", list(summary(groups)))):
            table = text_table(rows, markdown=True)
            (output / f"{name}.md").write_text(table + "\n")
            print(table, end="\n\n")
        for name, picture in (("table_2", draw_table_2(groups)), ("over_rows", draw_over_rows(groups))):
            if picture:
                save_figure(picture, output / name)
        write_tables(groups, output)


def table_2(groups: Sequence[Cell]) -> Iterator[dict[str, Any]]:
    """Yield the rows of Table 2: our returns with the number of seeds, and the paper's returns below them.

    Scratch has two columns: its longest runs, and its runs with as many steps as the other methods.
    """
    for place in PLACES:
        chosen = {TITLES[name]: cell for name, cell in compared(groups, place).items() if name in TITLES}
        of_task = [cell for cell in groups if cell.place == place and cell.stage == "transfer"]
        short = [cell for cell in of_task if cell.method == "scratch" and is_short(cell, of_task)]
        columns = {"Scratch": chosen.pop("Scratch", None), SHORT: next(iter(short), None)}
        columns |= {title: chosen.get(title) for title in list(TITLES.values())[1:]}
        paper = {title: TABLE_2[*place, name].mean for name, title in TITLES.items() if (*place, name) in TABLE_2}
        yield {"": row_title(place)} | {title: score(cell) for title, cell in columns.items()}
        yield {"": "*paper*"} | {title: f"*{paper[title]:.3f}*" if title in paper else EMPTY for title in columns}


def summary(groups: Sequence[Cell]) -> Iterator[dict[str, Any]]:
    """Yield the rows of the README's table: MCP, the best other method that pre-trains, scratch, the paper's MCP."""
    for place in PLACES:
        chosen = compared(groups, place)
        mcp = chosen.pop("mcp", None)
        scratch = chosen.pop("scratch", None)
        rival = max(chosen.values(), key=average, default=None)
        title = f"{TITLES.get(rival.method, rival.title)} " if rival else EMPTY
        cells = (mcp, rival, scratch)
        yield {
            "": row_title(place),
            "MCP": brief(mcp),
            "best other that pre-trains": f"{title}{brief(rival)}",
            "scratch, all steps": brief(scratch),
            "paper's MCP": f"{TABLE_2[*place, 'mcp'].mean:.3f}",
            "seeds": ", ".join(str(len(cell.by_seed)) if cell else "0" for cell in cells) if mcp else EMPTY,
        }


def brief(cell: Cell | None) -> str:
    """Return the mean deterministic return, after the share of successes and the skill if the task defines success."""
    if cell is None:
        return EMPTY
    return f"{successes(cell)} ({average(cell):.3f})" if share(cell) else f"{average(cell):.3f}"


def successes(cell: Cell) -> str:
    """Return the share of successful episodes and the skill: 0 for standing still, 1 for an ideal player."""
    return f"{share(cell)}, skill {cell.reach['skill']:.2f}"


def row_title(place: tuple[str, str]) -> str:
    """Return ``dribble, T-Rex`` for ``("dribble", "trex")``."""
    return f"{place[0]}, {CHARACTERS[place[1]]}"


if __name__ == "__main__":
    main()
