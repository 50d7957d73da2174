"""Showing a policy in a film, in a browser or in a window."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from hydra.errors import HydraException
from tensordict.nn import TensorDictModule, TensorDictModuleBase

from torchrl_mcp.adapters.adapter import Adapter
from torchrl_mcp.commands.suggestions import answer
from torchrl_mcp.commands.task_settings import task_settings
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.runs import build, configuration, policies
from torchrl_mcp.runs.build import Agent
from torchrl_mcp.runs.builtin import locate
from torchrl_mcp.runs.quoting import quoted
from torchrl_mcp.viewer.film import save_film
from torchrl_mcp.viewer.player import Player
from torchrl_mcp.viewer.watch import Watch


def play(arguments: argparse.Namespace) -> None:
    """Write a film, or open a viewer until it is closed."""
    torch.manual_seed(arguments.seed)
    if arguments.agent is not None:
        show(*_agent(arguments), 0, arguments)
        return
    agent, env = _restored(arguments)
    watch = Watch(Path(arguments.checkpoint), agent.parts) if arguments.watch else None
    show(agent.actor.policy, env, agent.actor.num_options, arguments, before_step=watch)


def show(
    policy: TensorDictModuleBase,
    env: CharacterEnv | TransformedCharacterEnv,
    options: int,
    arguments: argparse.Namespace,
    *,
    before_step: Callable[[], object] | None = None,
) -> None:
    """Write a film of a policy, or open a viewer until it is closed.

    Args:
        policy: From the environment's observations to ``action``.
        env: The environment.
        options: Number of options of the policy, 0 without options.
        arguments: The command line.
        before_step: Called by a viewer before each step.
    """
    look: dict[str, Any] = {
        "deterministic": not arguments.stochastic,
        "num_options": options,
        "aside": arguments.ghost_distance,
    }
    if arguments.viewer is not None and isinstance(env, Adapter):
        raise ValueError(f"{env.name} draws itself, in films alone: leave out --viewer {arguments.viewer}")
    match arguments.viewer:
        case None:
            size = {"width": arguments.width, "height": arguments.height}
            save_film(policy, env, arguments.output, seconds=arguments.seconds, **size, **look)
            print(arguments.output)
        case "web":
            try:
                from torchrl_mcp.viewer.web import play_in_browser  # slow to import, like the window
            except ImportError as error:
                raise RuntimeError(f"there is no MuJoCo Studio, install mujoco 3.17 or 4.0: {error}") from error
            play_in_browser(Player(policy, env, before_step=before_step, **look), port=arguments.port)
        case "window":
            from torchrl_mcp.viewer.window import play_in_window

            play_in_window(Player(policy, env, before_step=before_step, **look))


def _restored(arguments: argparse.Namespace) -> tuple[Agent, Any]:
    """Return the agent of a checkpoint, and an environment with some arguments of its task replaced."""
    settings = task_settings(arguments.task)
    _, agent, env = policies.restore(locate(arguments.checkpoint), num_envs=1, seed=arguments.seed, **settings)
    return agent, env


def _agent(arguments: argparse.Namespace) -> tuple[TensorDictModuleBase, Any]:
    """Return an untrained policy, and the environment of a configuration."""
    searchpath = (
        [f"hydra.searchpath=[{quoted(f'file://{arguments.config_dir.resolve()}')}]"] if arguments.config_dir else []
    )
    try:
        cfg = configuration.compose_run(*searchpath, *arguments.settings)
        if cfg.stage.name not in cfg.task:
            cfg = configuration.compose_run(*searchpath, *arguments.settings, "stage=transfer")
    except HydraException as error:
        raise ValueError(answer(error, arguments.settings)) from error
    env = build.make_env(cfg, num_envs=1, seed=arguments.seed, **task_settings(arguments.task))
    act = {"zero": env.action_spec.zero, "random": env.action_spec.rand}[arguments.agent]
    policy = TensorDictModule(lambda observation: act(), in_keys=["observation"], out_keys=["action"])
    return policy, env
