"""``torchrl-mcp-figures``: the paper's Figures 5, 6 and 7 from trained networks, as PNG and SVG, their data as CSV."""

import argparse
from pathlib import Path

from torchrl_mcp.cli.parsing import add_trust, count, explained, new_parser, seconds, seed
from torchrl_mcp.commands import announce
from torchrl_mcp.runs.builtin import PREFIX, locate

PROGRAM = "torchrl-mcp-figures"

EXAMPLES = f"""\
A CHECKPOINT is a run folder (its newest checkpoint), a checkpoint file, or {PREFIX}CHARACTER, a network that comes with
the library.

examples:
  {PROGRAM} curves runs/first runs/second                       # learning curves in one figure
  {PROGRAM} holdout runs/holdout/*                              # Figure 5
  {PROGRAM} exploration {PREFIX}humanoid runs/latent-humanoid   # Figure 6
  {PROGRAM} primitives {PREFIX}biped {PREFIX}humanoid          # Figure 7
"""


@explained(PROGRAM)
def main() -> None:
    """Run the command."""
    arguments = parser().parse_args()
    arguments.checkpoints = [locate(name) for name in arguments.checkpoints]
    announce(PROGRAM)
    from torchrl_mcp.commands import figures
    from torchrl_mcp.runs.trust import trusting

    with trusting(arguments.trust):
        getattr(figures, arguments.draw)(arguments)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    description = (
        "Draw the paper's Figures 5, 6 and 7 from trained networks, as PNG and SVG, and write their data as CSV."
    )
    parser = new_parser(PROGRAM, description, EXAMPLES)
    commands = parser.add_subparsers(required=True, metavar="command")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument(
        "checkpoints", nargs="+", metavar="CHECKPOINT", help="run folder, checkpoint file or builtin:CHARACTER"
    )
    shared.add_argument("--output", type=Path, default=Path("figures"), help="folder to write to (default %(default)s)")
    add_trust(shared)
    shared.add_argument("--seed", type=seed, default=0, help="seed of random numbers (default %(default)s)")

    command = commands.add_parser("curves", parents=[shared], help="draw learning curves of several runs in one figure")
    command.set_defaults(draw="curves")
    command = commands.add_parser(
        "holdout", parents=[shared], help="draw Figure 5: learning curves and trajectories of the ant"
    )
    command.set_defaults(draw="holdout")
    command = commands.add_parser("exploration", parents=[shared], help="draw Figure 6: paths of random exploration")
    command.add_argument(
        "--trajectories", type=count, default=48, metavar="N", help="number of paths (default %(default)s)"
    )
    command.add_argument("--seconds", type=seconds, default=10.0, help="duration of each path (default %(default)s)")
    command.set_defaults(draw="explore")
    command = commands.add_parser(
        "primitives", parents=[shared], help="draw Figure 7: weights over the walk cycle, and actions"
    )
    command.add_argument(
        "--clip", help="generated motion to follow, such as left_sharp (default: a walk straight ahead)"
    )
    command.add_argument(
        "--walkers", type=count, default=8, metavar="N", help="number of simulations (default %(default)s)"
    )
    command.add_argument("--seconds", type=seconds, default=10.0, help="duration of each walk (default %(default)s)")
    command.set_defaults(draw="analyse")
    return parser


if __name__ == "__main__":
    main()
