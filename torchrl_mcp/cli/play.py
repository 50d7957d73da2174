"""``torchrl-mcp-play``: watch a trained policy."""

import argparse
import sys
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import OmegaConf

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.methods.options import OptionActor
from torchrl_mcp.runs import build, experiment
from torchrl_mcp.runs.builtin import locate
from torchrl_mcp.viewer.film import save_film
from torchrl_mcp.viewer.player import Player

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
    arguments = _parser().parse_args()
    try:
        play(arguments)
    except (RuntimeError, ValueError) as error:
        sys.exit(f"{PROGRAM}: {error}")
    except KeyboardInterrupt:
        sys.exit()


def play(arguments: argparse.Namespace) -> None:
    """Write a film, or open a viewer until it is closed."""
    torch.manual_seed(arguments.seed)
    agent, env = _restored(locate(arguments.checkpoint), arguments.seed, arguments.task)
    num_options = agent.actor.num_options if isinstance(agent.actor, OptionActor) else 0
    look: dict[str, Any] = {
        "deterministic": not arguments.stochastic,
        "num_options": num_options,
        "aside": arguments.ghost_distance,
    }
    policy = agent.actor.policy
    match arguments.viewer:
        case None:
            size = {"width": arguments.width, "height": arguments.height}
            save_film(policy, env, arguments.output, seconds=arguments.seconds, **size, **look)
            print(arguments.output)
        case "web":
            try:
                from torchrl_mcp.viewer.web import play_in_browser  # slow to load, as is the window
            except ImportError as error:
                raise RuntimeError(f"Studio is not where mujoco 3.17 has it, install that: {error}") from error
            play_in_browser(Player(policy, env, **look), port=arguments.port)
        case "window":
            from torchrl_mcp.viewer.window import play_in_window

            play_in_window(Player(policy, env, **look))


def _restored(path: Path, seed: int, overrides: list[str]) -> tuple[build.Agent, CharacterEnv]:
    """Return the agent of a checkpoint, and an environment with some arguments of its task replaced."""
    arguments = cast("dict[str, Any]", OmegaConf.to_container(OmegaConf.from_dotlist(overrides)))
    try:
        _, agent, env = experiment.restore(path, num_envs=1, seed=seed, **arguments)
    except TypeError as error:
        raise ValueError(f"--task {' '.join(overrides)}: {error}") from error
    return agent, env


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Watch a trained policy: in a film, in a browser or in a window.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
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
