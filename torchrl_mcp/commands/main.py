"""``torchrl-mcp``: all commands by one name. ``torchrl-mcp train`` is ``torchrl-mcp-train``."""

import argparse
import difflib
import sys
from importlib import import_module

from torchrl_mcp.commands.parsing import entry_point, new_parser

PROGRAM = "torchrl-mcp"

COMMANDS = {
    "demo": "train a new gate and a network from scratch side by side, in minutes",
    "train": "train a method on a task: a run, a sweep or a benchmark",
    "status": "show the progress of all runs of a folder",
    "evaluate": "play episodes with a trained policy, and print returns and diagnostics",
    "play": "watch a trained policy in a film, in a browser or in a window",
    "report": "write the results of many runs beside the paper's",
    "figures": "draw the paper's Figures 5, 6 and 7",
    "export": "write a trained policy as ONNX, as a program of torch or as a web page",
    "publish": "write a trained policy as a small file with a model card",
    "motions": "import and inspect motion capture",
    "character": "check or convert an MJCF file of a body of your own",
}
"""What each command does, in the order in which a new user meets them."""


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Run the command that the first word names, with the other words."""
    name, *arguments = words or ["--help"]
    if name.startswith("-"):
        parser().parse_args([name])
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, n=1)
        nearest = f"the nearest is {near[0]}" if near else f"choose from {', '.join(COMMANDS)}"
        sys.exit(f"{PROGRAM}: there is no command {name}: {nearest}")
    import_module(f"torchrl_mcp.commands.{name}").main(arguments)


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``--help`` and ``--version``, which lists the commands."""
    listed = [f"  {PROGRAM} {name:11}{meaning}" for name, meaning in COMMANDS.items()]
    epilog = "\n".join(["commands, each with its own --help:", *listed])
    parser = new_parser(PROGRAM, "Multiplicative compositional policies: train, watch and compare.", epilog)
    parser.add_argument("command", choices=COMMANDS, metavar="COMMAND", help="see below")
    return parser


if __name__ == "__main__":
    main()
