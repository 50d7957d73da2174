"""``torchrl-mcp-demo``: pre-train primitives, transfer them to unseen directions, and compare with scratch."""

import argparse
import sys
from pathlib import Path

from torchrl_mcp.cli.parsing import announce, new_parser

PROGRAM = "torchrl-mcp-demo"


def main() -> None:
    """Run or continue the demonstration."""
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
        sys.exit(f"\n{PROGRAM}: interrupted; repeat the command to continue")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Pre-train primitives, transfer them to directions never seen, compare with scratch.")
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="SETTING=VALUE",
        help="settings of all runs, as for torchrl-mcp-train: seed=1",
    )
    parser.add_argument("--output", type=Path, default=Path("runs/demo"), help="folder (default runs/demo)")
    parser.add_argument("--smoke", action="store_true", help="only test that the demonstration runs, in seconds")
    return parser


if __name__ == "__main__":
    main()
