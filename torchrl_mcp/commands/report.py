"""``torchrl-mcp-report``: the results of many runs beside the paper's results, as a web page and as Markdown."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from torchrl_mcp.commands.parsing import announce, entry_point, new_parser

PROGRAM = "torchrl-mcp-report"


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Read run folders and write the report."""
    arguments = parser().parse_args(words)
    if missing := [str(path) for path in arguments.runs if not path.exists()]:
        sys.exit(f"{PROGRAM}: there is no folder {' and no folder '.join(missing)}")
    announce(PROGRAM)
    print(write_report(arguments.runs, arguments.output))


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(
        PROGRAM, "Write the results of many runs beside the paper's results, as a web page and as Markdown."
    )
    parser.add_argument("runs", type=Path, nargs="+", help="run folders, or folders with run folders at any depth")
    parser.add_argument("--output", type=Path, default=Path("report"), help="folder to write to (default %(default)s)")
    return parser


def write_report(folders: Sequence[Path], output: Path) -> str:
    """Write a report on all runs in folders, and return a line about it.

    Args:
        folders: Run folders, or folders with run folders at any depth.
        output: The folder to write to.
    """
    from torchrl_mcp.analysis.figures import save_figure
    from torchrl_mcp.report.comparison import cells
    from torchrl_mcp.report.page import report, states
    from torchrl_mcp.report.results import find_runs
    from torchrl_mcp.report.table_2 import draw_table_2
    from torchrl_mcp.training.run_folder import replacing

    runs, damaged = find_runs(folders)
    pages = report(runs, damaged, moment=datetime.now(UTC))
    for name, text in pages.items():
        with replacing(output / name) as partial:
            partial.write_text(text, encoding="utf-8")
    if picture := draw_table_2(cells(runs)):
        save_figure(picture, output / "table_2")
    counts = ", ".join(f"{number} {state}" for state, number in states(runs, damaged).items() if number)
    number = len(runs) + len(damaged)
    paths = shlex.join(str(output / name) for name in pages)
    return f"{number} run{'s' if number > 1 else ''}, {counts}: {paths}"


if __name__ == "__main__":
    main()
