"""``torchrl-mcp-play``: watch a trained policy."""

import argparse
import sys
from pathlib import Path

from torchrl_mcp.cli.parsing import add_task, add_trust, explained, find_own_modules, new_parser, port, seconds, seed
from torchrl_mcp.commands import announce
from torchrl_mcp.evaluation.formats import require_format
from torchrl_mcp.runs.builtin import locate

PROGRAM = "torchrl-mcp-play"

EXAMPLES = f"""\
examples:
  {PROGRAM} builtin:humanoid                              # a film of the networks that come with the library
  {PROGRAM} builtin:humanoid-location --viewer web        # steer in a browser: clicks, gates, pushes
  {PROGRAM} runs/my-run --output walk.mp4 --seconds 20 --width 1280 --height 720
  {PROGRAM} --watch runs/my-run --viewer web              # a run in training: loads each new checkpoint
  {PROGRAM} --agent random task=carry character=humanoid  # look at an environment before training
  {PROGRAM} runs/my-imitation --task switch_interval=.inf --task clip_end=switch
"""


@explained(PROGRAM, RuntimeError)
def main() -> None:
    """Run the command."""
    arguments = parse(sys.argv[1:])
    try:
        if arguments.agent is None:
            locate(arguments.checkpoint)
        elif arguments.config_dir and not arguments.config_dir.is_dir():
            raise ValueError(f"there is no folder {arguments.config_dir}: correct --config-dir")
        elif arguments.config_dir:
            find_own_modules()
        if arguments.viewer is None:
            require_format(arguments.output)
        announce(PROGRAM)
        from torchrl_mcp.commands.play import play
        from torchrl_mcp.runs.trust import trusting

        with trusting(arguments.trust):
            play(arguments)
    except KeyboardInterrupt:
        sys.exit()


def parse(words: list[str]) -> argparse.Namespace:
    """Return the arguments; for an untrained ``agent``, ``checkpoint`` is None and ``settings`` configure it."""
    options = parser()
    arguments = options.parse_args(words)
    arguments.settings = arguments.checkpoint
    arguments.checkpoint = None
    if arguments.agent is None:
        if len(arguments.settings) != 1:
            options.error(f"pass one CHECKPOINT, not {len(arguments.settings)}; or --agent with task=... character=...")
        arguments.checkpoint = arguments.settings[0]
    if arguments.watch and (arguments.agent or not arguments.viewer or not Path(arguments.checkpoint).is_dir()):
        options.error("--watch needs a run folder, and --viewer web or --viewer window")
    return arguments


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Watch a trained policy: in a film, in a browser or in a window.", EXAMPLES)
    parser.add_argument(
        "checkpoint",
        nargs="*",
        metavar="CHECKPOINT",
        help="run folder (its newest checkpoint), checkpoint file, builtin:CHARACTER or builtin:CHARACTER-TASK; with "
        "--agent, settings of an environment instead, as for torchrl-mcp-train",
    )
    add_trust(parser)
    parser.add_argument("--agent", choices=["zero", "random"], help="play zero or random actions instead of a policy")
    parser.add_argument(
        "-cd", "--config-dir", type=Path, metavar="FOLDER", help="with --agent: folder of your own settings"
    )
    parser.add_argument("--seed", type=seed, default=0, help="seed of environment and sampling (default %(default)s)")
    parser.add_argument(
        "--stochastic", action="store_true", help="sample actions (default: play deterministic actions)"
    )
    add_task(parser)
    parser.add_argument(
        "--ghost-distance",
        type=float,
        default=1.0,
        metavar="D",
        help="distance of the ghost from its true place, in extents of the character (default %(default)s)",
    )
    film = parser.add_argument_group("film")
    film.add_argument("--output", type=Path, default=Path("film.gif"), help=".gif or .mp4 (default %(default)s)")
    film.add_argument("--seconds", type=seconds, default=10.0, help="duration of the film (default %(default)s)")
    film.add_argument("--width", type=int, default=480, help="width in pixels (default %(default)s)")
    film.add_argument("--height", type=int, default=360, help="height in pixels (default %(default)s)")
    viewer = parser.add_argument_group("viewer")
    viewer.add_argument(
        "--viewer",
        choices=["web", "window"],
        help="play live instead of writing a film: in a browser on this machine, or in a window",
    )
    viewer.add_argument("--watch", action="store_true", help="play each new checkpoint of a run in training")
    viewer.add_argument("--port", type=port, default=0, help="port of the page (default: the first free one from 8080)")
    return parser


if __name__ == "__main__":
    main()
