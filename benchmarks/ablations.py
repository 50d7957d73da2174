"""Table 4, Figure 8, and MCP with other mixers and other exploration: the runs, archived, with their tables and curves.

    # likewise benchmark=mixer, exploration and freeze, and task=heading
    torchrl-mcp-train benchmark=num_primitives preset=comparison character=biped run_root=runs/ablations
    python benchmarks/ablations.py runs/ablations    # archives the complete runs, and writes the results
    python benchmarks/ablations.py                   # writes the results again, from the archive

Everything lands in ``results/ablations``, as in ``results/table2``. ``table.md`` has a row for each variant of MCP.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from archive import EMPTY, archived, average, label, score, write_tables

from torchrl_mcp.report.cell import Cell
from torchrl_mcp.runs.tables import text_table

RESULTS = Path(__file__).resolve().parent / "results" / "ablations"
VARIED = ("num_primitives", "mixer", "exploration", "trained")
"""Choices of transfer that are ablated; those of pre-training are the first two."""


def main() -> None:
    """Archive runs if a folder is given, and write the results of the archive."""
    with archived(__doc__, RESULTS) as (found, output):
        table = text_table(variants(found), markdown=True)
        (output / "table.md").write_text(table + "\n")
        print(table)
        write_tables(found, output)


def variants(found: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return a row for each variant: its settings, the imitation that it begins with, and its score in each task.

    Columns name the character if there are several. Methods that lack one of the settings are left out.

    Raises:
        SystemExit: If two cells of a variant differ in other settings.
    """
    transfers = [cell for cell in found if cell.stage == "transfer" and None not in chosen(cell)]
    imitated = {(chosen(cell, 2), cell.place[1]): completed(cell) for cell in found if cell.stage == "pretrain"}
    scores: dict[Any, Cell] = {}
    for cell in transfers:
        if (other := scores.setdefault((chosen(cell), cell.place), cell)) is not cell:
            raise SystemExit(f"{label(other)} and {label(cell)} are one row of the table: archive one of them alone")
    places = dict.fromkeys(cell.place for cell in transfers)
    characters = dict.fromkeys(character for _, character in places)
    ends = {character: f", {character}" if len(characters) > 1 else "" for character in characters}
    return [
        dict(zip(VARIED, variant, strict=True))
        | {f"imitation, completed{end}": imitated.get((variant[:2], name), EMPTY) for name, end in ends.items()}
        | {f"{task}{ends[name]}": score(scores.get((variant, (task, name)))) for task, name in places}
        for variant in sorted({chosen(cell) for cell in transfers}, key=order)
    ]


def chosen(cell: Cell, count: int = len(VARIED)) -> tuple[Any, ...]:
    """Return the first ``count`` choices that are ablated."""
    return tuple(cell.choices.get(name) for name in VARIED[:count])


def order(variant: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the key of a row: fewer primitives first, and of as many, MCP's own settings first."""
    num_primitives, mixer, exploration, trained = variant
    return num_primitives, mixer == "additive", exploration == "action", trained != "gate"


def completed(cell: Cell) -> str:
    """Return the share of episodes of imitation in which the character keeps up with its references to the end."""
    return f"{1 - average([run.evaluation['deterministic']['terminated'] for run in cell.complete]):.0%}"


if __name__ == "__main__":
    main()
