"""``torchrl-mcp-demo``: pre-train primitives, transfer them to directions never seen, and compare with scratch."""

import argparse
import sys
from pathlib import Path

from torchrl_mcp.cli.parsing import announce, new_parser

PROGRAM = "torchrl-mcp-demo"


def main() -> None:
    """Run the demonstration, or what is left of it."""
    arguments = parser().parse_args()
    announce(PROGRAM)
    from hydra.errors import HydraException

    from torchrl_mcp.cli.demonstration import run

    preset = "demo_smoke" if arguments.smoke else "demo"
    try:
        run(arguments.output, [f"preset={preset}", *arguments.overrides])
    except (HydraException, ValueError) as error:
        sys.exit(f"{PROGRAM}: {error}")
    except KeyboardInterrupt:
        sys.exit(f"\n{PROGRAM}: interrupted; call it again to go on from here")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Pre-train primitives, transfer them to directions never seen, compare with scratch.")
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="SETTING=VALUE",
        help="settings of all runs, as torchrl-mcp-train takes them: seed=1",
    )
    parser.add_argument("--output", type=Path, default=Path("runs/demo"), help="folder (default runs/demo)")
    parser.add_argument("--smoke", action="store_true", help="a test of the demonstration, which takes seconds")
    return parser


if __name__ == "__main__":
    main()
