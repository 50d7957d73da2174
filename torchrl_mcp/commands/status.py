"""``torchrl-mcp-status``: the progress of all runs of a folder."""

import argparse
import sys
import threading
from pathlib import Path

from torchrl_mcp.commands.parsing import entry_point, new_parser

PROGRAM = "torchrl-mcp-status"


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Show the runs of a folder."""
    arguments = parser().parse_args(words)
    if not arguments.folder.is_dir():
        sys.exit(f"{PROGRAM}: there is no folder {arguments.folder}")
    from rich.console import Console

    from torchrl_mcp.runs.status import look, overview, table
    from torchrl_mcp.runs.tables import as_text

    if not arguments.follow:
        runs = table(look(arguments.folder), arguments.folder)
        Console().print(runs) if sys.stdout.isatty() else print(as_text(runs))
        return
    try:
        with overview(arguments.folder):
            threading.Event().wait()
    except KeyboardInterrupt:
        return


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Show the progress of all runs of a folder.")
    parser.add_argument(
        "folder", type=Path, nargs="?", default=Path("runs"), help="folder of the runs (default %(default)s)"
    )
    parser.add_argument("--follow", action="store_true", help="keep updating until interrupted")
    return parser


if __name__ == "__main__":
    main()
