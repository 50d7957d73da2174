"""A policy in a film, in a browser or in a window."""

import argparse
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import OmegaConf

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.methods.options import OptionActor
from torchrl_mcp.runs import build, experiment
from torchrl_mcp.viewer.film import save_film
from torchrl_mcp.viewer.player import Player


def play(path: Path, arguments: argparse.Namespace) -> None:
    """Write a film, or open a viewer until it is closed."""
    torch.manual_seed(arguments.seed)
    agent, env = _restored(path, arguments.seed, arguments.task)
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
