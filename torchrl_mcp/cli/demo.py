"""``torchrl-mcp-demo``: train a new gate over MCP's primitives and a network from scratch, with equal steps."""

import argparse
import sys
from pathlib import Path

from torchrl_mcp.cli.parsing import explained, new_parser
from torchrl_mcp.commands import announce

PROGRAM = "torchrl-mcp-demo"


@explained(PROGRAM)
def main() -> None:
    """Run or continue the demonstration."""
    arguments = parser().parse_args()
    announce(PROGRAM)
    from hydra.errors import HydraException

    from torchrl_mcp.commands.demo import run
    from torchrl_mcp.commands.suggestions import answer

    preset = "demo_smoke" if arguments.smoke else "demo"
    output = arguments.output or Path("runs", "demo-pretrain" if arguments.pretrain else "demo")
    try:
        run(output, arguments.overrides, preset=preset, pretrain=arguments.pretrain)
    except HydraException as error:
        sys.exit(f"{PROGRAM}: {answer(error, arguments.overrides)}")
    except KeyboardInterrupt:
        sys.exit(f"\n{PROGRAM}: interrupted; repeat the command to continue")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(
        PROGRAM, "Train a new gate that steers a humanoid, and a network from scratch with the same number of steps."
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="SETTING=VALUE",
        help="settings of all runs, as for torchrl-mcp-train, such as seed=1",
    )
    parser.add_argument("--output", type=Path, help="folder (default runs/demo, or runs/demo-pretrain)")
    parser.add_argument("--pretrain", action="store_true", help="also train the primitives, which takes longer")
    parser.add_argument("--smoke", action="store_true", help="only test whether the demonstration runs, in seconds")
    return parser


if __name__ == "__main__":
    main()
