"""Archives the runs of Table 4, Figure 8, and MCP with other mixers and exploration, and writes tables and curves.

    # repeat this command with benchmark=mixer, exploration and freeze, and with task=heading
    torchrl-mcp-train benchmark=num_primitives preset=comparison character=biped run_root=runs/ablations
    python benchmarks/ablations.py runs/ablations    # archives the complete runs, and writes the results
    python benchmarks/ablations.py                   # writes the results again, from the archive

The script writes to ``results/ablations``, with the same files as in ``results/table2``. ``table.md`` has a row for
each variant of MCP.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from archive import EMPTY, archived, label, score, write_tables

from torchrl_mcp.report.cell import Cell
from torchrl_mcp.runs.tables import text_table

RESULTS = Path(__file__).resolve().parent / "results" / "ablations"
VARIED = ("num_primitives", "mixer", "exploration", "trained")
"""Choices that are ablated; the first two also affect pre-training."""


def main() -> None:
    """Archive runs if a folder is given, and write the results of the archive."""
    with archived(__doc__, RESULTS) as (groups, output):
        table = text_table(variants(groups), markdown=True)
        (output / "table.md").write_text(table + "\n")
        print(table)
        write_tables(groups, output)


def variants(groups: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return a row for each variant: its settings, the result of its pre-training, and its score in each task.

    Columns name the character if there are several. Methods that lack one of the settings are omitted.

    Raises:
        SystemExit: If two cells of a variant differ in other settings.
    """
    transfers = [cell for cell in groups if cell.stage == "transfer" and None not in chosen(cell)]
    pretrainings = [cell for cell in groups if cell.stage == "pretrain"]
    imitated = _unique(pretrainings, lambda cell: (chosen(cell, 2), cell.place[1]))
    scores = _unique(transfers, lambda cell: (chosen(cell), cell.place))
    places = dict.fromkeys(cell.place for cell in transfers)
    characters = dict.fromkeys(character for _, character in places)
    ends = {character: f", {character}" if len(characters) > 1 else "" for character in characters}
    return [
        dict(zip(VARIED, variant, strict=True))
        | {f"imitation, completed{end}": completed(imitated.get((variant[:2], name))) for name, end in ends.items()}
        | {f"{task}{ends[name]}": score(scores.get((variant, (task, name)))) for task, name in places}
        for variant in sorted({chosen(cell) for cell in transfers}, key=order)
    ]


def _unique(cells: Iterable[Cell], key: Callable[[Cell], Any]) -> dict[Any, Cell]:
    """Return cells by key, each of which must be unique."""
    unique: dict[Any, Cell] = {}
    for cell in cells:
        first = unique.setdefault(key(cell), cell)
        if first is not cell:
            raise SystemExit(f"{label(first)} and {label(cell)} are one row of the table: archive only one of them")
    return unique


def chosen(cell: Cell, count: int = len(VARIED)) -> tuple[Any, ...]:
    """Return the first ``count`` choices that are ablated."""
    return tuple(cell.choices.get(name) for name in VARIED[:count])


def order(variant: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the sort key of a row: fewer primitives come first, then MCP's standard settings."""
    num_primitives, mixer, exploration, trained = variant
    return num_primitives, mixer == "additive", exploration == "action", trained != "gate"


def completed(cell: Cell | None) -> str:
    """Return the share of episodes of imitation in which the character follows its references to the end."""
    if cell is None:
        return EMPTY
    return f"{1 - fmean([run.evaluation['deterministic']['terminated'] for run in cell.complete]):.0%}"


if __name__ == "__main__":
    main()
