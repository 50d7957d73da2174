"""``torchrl-mcp-status``: the progress of all runs of a folder."""

import argparse
import sys
import threading
from pathlib import Path

from rich.console import Console

from torchrl_mcp.runs.status import look, overview, table


def main() -> None:
    """Show the runs of a folder."""
    parser = argparse.ArgumentParser(prog="torchrl-mcp-status", description=__doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("runs"), help="of run folders (default runs)")
    parser.add_argument("--follow", action="store_true", help="go on until interrupted")
    arguments = parser.parse_args()
    if not arguments.folder.is_dir():
        sys.exit(f"torchrl-mcp-status: there is no folder {arguments.folder}")
    if not arguments.follow:
        Console().print(table(look(arguments.folder), arguments.folder))
        return
    try:
        with overview(arguments.folder):
            threading.Event().wait()
    except KeyboardInterrupt:
        return


if __name__ == "__main__":
    main()
