"""``torchrl-mcp-report``: the results of many runs beside the paper's results, as a web page and as Markdown."""

import argparse
import shlex
import sys
from datetime import UTC, datetime
from pathlib import Path

from torchrl_mcp.cli.parsing import explained, new_parser
from torchrl_mcp.commands import announce

PROGRAM = "torchrl-mcp-report"


@explained(PROGRAM)
def main() -> None:
    """Read run folders and write the report."""
    arguments = parser().parse_args()
    if missing := [str(path) for path in arguments.runs if not path.exists()]:
        sys.exit(f"{PROGRAM}: there is no folder {' and no folder '.join(missing)}")
    announce(PROGRAM)
    from torchrl_mcp.analysis.figures import save_figure
    from torchrl_mcp.report.comparison import cells
    from torchrl_mcp.report.page import report, states
    from torchrl_mcp.report.results import find_runs
    from torchrl_mcp.report.table_2 import draw_table_2
    from torchrl_mcp.training.run_folder import replacing

    runs, damaged = find_runs(arguments.runs)
    pages = report(runs, damaged, moment=datetime.now(UTC))
    for name, text in pages.items():
        with replacing(arguments.output / name) as partial:
            partial.write_text(text, encoding="utf-8")
    if picture := draw_table_2(cells(runs)):
        save_figure(picture, arguments.output / "table_2")
    counts = ", ".join(f"{number} {state}" for state, number in states(runs, damaged).items() if number)
    number = len(runs) + len(damaged)
    places = shlex.join(str(arguments.output / name) for name in pages)
    print(f"{number} run{'s' if number > 1 else ''}, {counts}: {places}")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(
        PROGRAM, "Write the results of many runs beside the paper's results, as a web page and as Markdown."
    )
    parser.add_argument("runs", type=Path, nargs="+", help="run folders, or folders with run folders at any depth")
    parser.add_argument("--output", type=Path, default=Path("report"), help="folder to write to (default %(default)s)")
    return parser


if __name__ == "__main__":
    main()
