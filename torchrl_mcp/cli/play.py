"""``torchrl-mcp-play``: watch a trained policy."""

import argparse
import sys
from pathlib import Path

from torchrl_mcp.cli.parsing import announce, new_parser
from torchrl_mcp.runs.builtin import locate

PROGRAM = "torchrl-mcp-play"

EXAMPLES = f"""\
examples:
  {PROGRAM} builtin:humanoid                              # a film of the networks that come with the library
  {PROGRAM} runs/my-run --output walk.mp4 --seconds 20 --width 1280 --height 720
  {PROGRAM} runs/my-run --viewer web                      # in a browser, with MuJoCo Studio
  {PROGRAM} runs/my-imitation --task switch_interval=.inf --task clip_end=switch
"""


def main() -> None:
    """Do what the command line says."""
    arguments = parser().parse_args()
    try:
        path = locate(arguments.checkpoint)
        announce(PROGRAM)
        from torchrl_mcp.cli.playing import play

        play(path, arguments)
    except (RuntimeError, ValueError) as error:
        sys.exit(f"{PROGRAM}: {error}")
    except KeyboardInterrupt:
        sys.exit()


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Watch a trained policy: in a film, in a browser or in a window.", EXAMPLES)
    parser.add_argument(
        "checkpoint",
        metavar="CHECKPOINT",
        help="run folder, of which the newest checkpoint counts, checkpoint file, or builtin:CHARACTER",
    )
    parser.add_argument("--seed", type=int, default=0, help="of environment and sampling (default 0)")
    parser.add_argument("--stochastic", action="store_true", help="sample actions instead of taking the likeliest")
    parser.add_argument(
        "--task", action="append", default=[], metavar="KEY=VALUE", help="another argument of the task; repeatable"
    )
    parser.add_argument(
        "--ghost-distance",
        type=float,
        default=1.0,
        metavar="D",
        help="distance of the ghost from the character, in extents of the character; 0 is where it is (default 1)",
    )
    film = parser.add_argument_group("film")
    film.add_argument("--output", type=Path, default=Path("film.gif"), help=".gif or .mp4 (default film.gif)")
    film.add_argument("--seconds", type=float, default=10.0, help="length (default 10)")
    film.add_argument("--width", type=int, default=480, help="pixels (default 480)")
    film.add_argument("--height", type=int, default=360, help="pixels (default 360)")
    viewer = parser.add_argument_group("viewer")
    viewer.add_argument(
        "--viewer",
        choices=["web", "window"],
        help="show it live instead: in a browser (anyone who can reach the port can watch), or in a window",
    )
    viewer.add_argument("--port", type=int, default=0, help="of the page (default: the first free one from 8080)")
    return parser


if __name__ == "__main__":
    main()
