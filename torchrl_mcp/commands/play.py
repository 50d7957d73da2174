"""``torchrl-mcp-play``: watch a trained policy."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_mcp.commands.parsing import (
    CHECKPOINT,
    add_task,
    add_trust,
    announce,
    entry_point,
    new_parser,
    own_settings,
    port,
    seconds,
    seed,
    task_settings,
)
from torchrl_mcp.evaluation.formats import require_format
from torchrl_mcp.runs.builtin import locate

if TYPE_CHECKING:
    from torchrl_mcp.viewer.player import Player

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


@entry_point(PROGRAM, RuntimeError, FloatingPointError)
def main(words: list[str]) -> None:
    """Write a film, or open a viewer until it is closed."""
    arguments = parse(words)
    try:
        path = None if arguments.agent else locate(arguments.words[0])
        settings = [*own_settings(arguments.config_dir), *arguments.words] if arguments.agent else []
        if arguments.viewer is None:
            require_format(arguments.output)
        announce(PROGRAM)
        import torch

        from torchrl_mcp.runs.trust import trusting

        torch.manual_seed(arguments.seed)
        with trusting(arguments.trust):
            show(trained(path, arguments) if path else untrained(settings, arguments), arguments)
    except KeyboardInterrupt:
        sys.exit()


def parse(words: list[str]) -> argparse.Namespace:
    """Return the arguments; ``words`` are one checkpoint, or for an ``agent`` the settings of an environment."""
    options = parser()
    arguments = options.parse_args(words)
    if arguments.agent is None and len(arguments.words) != 1:
        options.error(f"pass one CHECKPOINT, not {len(arguments.words)}; or --agent with task=... character=...")
    if arguments.watch and (arguments.agent or not arguments.viewer or not Path(arguments.words[0]).is_dir()):
        options.error("--watch needs a run folder, and --viewer web or --viewer window")
    return arguments


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(PROGRAM, "Watch a trained policy: in a film, in a browser or in a window.", EXAMPLES)
    parser.add_argument(
        "words",
        nargs="*",
        metavar="CHECKPOINT",
        help=f"{CHECKPOINT}; with --agent, settings of an environment instead, as for torchrl-mcp-train",
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


def trained(path: Path, arguments: argparse.Namespace) -> "Player":
    """Return a player of the policy in a run folder or checkpoint file, in its environment with changes."""
    from torchrl_mcp.runs import policies
    from torchrl_mcp.viewer.player import Player
    from torchrl_mcp.viewer.watch import Watch

    _, agent, env = policies.restore(path, num_envs=1, seed=arguments.seed, **task_settings(arguments.task))
    return Player(
        agent.actor.policy,
        env,
        deterministic=not arguments.stochastic,
        num_options=agent.actor.num_options,
        aside=arguments.ghost_distance,
        before_step=Watch(path, agent.parts) if arguments.watch else None,
    )


def untrained(settings: list[str], arguments: argparse.Namespace) -> "Player":
    """Return a player of zero or random actions, in the environment that the settings configure."""
    from hydra.errors import HydraException
    from tensordict.nn import TensorDictModule

    from torchrl_mcp.commands.suggestions import answer
    from torchrl_mcp.runs import build, configuration
    from torchrl_mcp.viewer.player import Player

    try:
        cfg = configuration.compose_run(*settings)
        if cfg.stage.name not in cfg.task:
            cfg = configuration.compose_run(*settings, "stage=transfer")
    except HydraException as error:
        raise ValueError(answer(error, arguments.words)) from error
    env: Any = build.make_env(cfg, num_envs=1, seed=arguments.seed, **task_settings(arguments.task))
    act = {"zero": env.action_spec.zero, "random": env.action_spec.rand}[arguments.agent]
    policy = TensorDictModule(lambda observation: act(), in_keys=["observation"], out_keys=["action"])
    return Player(policy, env, deterministic=not arguments.stochastic, aside=arguments.ghost_distance)


def show(player: "Player", arguments: argparse.Namespace) -> None:
    """Write a film, or open a viewer until it is closed."""
    if arguments.viewer is None:
        from torchrl_mcp.viewer.film import save_films

        size = {"width": arguments.width, "height": arguments.height}
        save_films({"": player}, arguments.output, seconds=arguments.seconds, **size)
        print(arguments.output)
    elif not player.simulated:
        raise ValueError(f"{player.env.name} draws itself, in films alone: leave out --viewer {arguments.viewer}")
    elif arguments.viewer == "window":
        from torchrl_mcp.viewer.window import play_in_window

        play_in_window(player)
    else:
        try:
            from torchrl_mcp.viewer.web import play_in_browser
        except ImportError as error:
            raise RuntimeError(f"there is no MuJoCo Studio, install mujoco 3.17 or 4.0: {error}") from error
        play_in_browser(player, port=arguments.port)


if __name__ == "__main__":
    main()
