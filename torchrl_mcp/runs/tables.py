"""Formats tables of commands and benchmarks as text."""

import csv
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path

from rich.box import MARKDOWN
from rich.console import Console
from rich.table import Table
from rich.text import Text

WIDEST = 10_000
"""Characters per line, so many that tables in files and pipes are never folded."""


def text_table(rows: Sequence[Mapping[str, object]], *, markdown: bool = False) -> str:
    """Return rows as text with aligned columns, in which numbers are aligned to the right.

    Args:
        rows: Cells by column name, with the same names in every row. Floats are printed with three decimals; an empty
            text stands for a missing value.
        markdown: Draw the lines of a Markdown table.
    """
    table = Table(box=MARKDOWN) if markdown else plain_table()
    for name in rows[0]:
        numeric = all(isinstance(row[name], int | float) or row[name] == "" for row in rows)
        table.add_column(Text(name), justify="right" if numeric else "left", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(_cell(value)) for value in row.values()))
    return as_text(table)


def write_csv(rows: Sequence[Mapping[str, object]], path: Path, *, digits: int | None = None) -> None:
    """Write rows with the same names as CSV.

    Args:
        rows: Cells by column name.
        path: The file, whose folder is made.
        digits: Significant digits of floats, None for all.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow(row if digits is None else {name: _rounded(cell, digits) for name, cell in row.items()})


def as_text(table: Table) -> str:
    """Return a table as text without folded lines and colours."""
    console = Console(file=StringIO(), width=WIDEST, color_system=None)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines()).strip("\n")


def plain_table(caption: str | None = None) -> Table:
    """Return an empty table without rules, with a caption below."""
    return Table(caption=caption, caption_justify="left", box=None, padding=(0, 2, 0, 0))


def _rounded(value: object, digits: int) -> object:
    return f"{value:.{digits}g}" if isinstance(value, float) else value


def _cell(value: object) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)
