"""Restores, evaluates and publishes trained policies."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf
from torch import nn

from torchrl_mcp.envs import Imitation
from torchrl_mcp.evaluation.clips import ClipResult, follow_each
from torchrl_mcp.evaluation.diagnostics import diagnosed, diagnostics
from torchrl_mcp.evaluation.rollout import episode_statistics, evaluate
from torchrl_mcp.runs import places
from torchrl_mcp.runs.build import Agent, make_agent, make_env
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.imports import require_known
from torchrl_mcp.runs.publish import fingerprints, publish, take_shared
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.run_folder import MODES


def policy_config(path: Path | str) -> DictConfig:
    """Return the configuration with which a policy was trained.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.

    Raises:
        ValueError: If there is no checkpoint, or the checkpoint is damaged or from another version of the library.
    """
    file = checkpoint.find(path)
    config = checkpoint.saved_config(file)
    require_known(config, file)
    return OmegaConf.create(dict(config))


def restore(
    path: Path | str, *, num_envs: int, seed: int, device: str = "cpu", **kwargs: Any
) -> tuple[DictConfig, Agent, Any]:
    """Return configuration, trained agent and new environments from a run folder or checkpoint file.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file. Published files lack the critic unless it
            chooses the option; the critic is then untrained.
        num_envs: Number of environments.
        seed: Seed of the environments.
        device: Device of the networks.
        **kwargs: Arguments of the environments that replace the run's arguments.

    Raises:
        ValueError: If there is no checkpoint, or the checkpoint is damaged or names classes that cannot be imported.
    """
    file = checkpoint.find(path)
    cfg = policy_config(file)
    cfg.device = device
    env = make_env(cfg, num_envs=num_envs, seed=seed, **kwargs)
    agent = make_agent(cfg, env)
    if shared := checkpoint.shared(file):
        take_shared(agent.parts, shared, file, builtin(cfg.method.name, cfg.character.name))
    checkpoint.load_agent(agent.parts, file, optional=agent.spare_parts)
    return cfg, agent, env


def publish_run(path: Path | str, output: Path | str) -> None:
    """Write the policy of a run as a separate checkpoint file, as small as the built-in networks.

    The file omits the frozen parts if a built-in network has the same parts in bfloat16, bit for bit.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        output: The file to write.

    Raises:
        ValueError: If there is no checkpoint, the checkpoint is damaged, or the run transferred from a built-in network
            whose frozen parts have changed since.
    """
    cfg, agent, _ = restore(path, num_envs=1, seed=0)
    cfg.run_dir = cfg.run_root = "."  # older runs store the folder in which they began, which means nothing elsewhere
    parts = nn.ModuleDict({name: part for name, part in agent.parts.items() if name not in agent.spare_parts})
    shared: dict[str, str] = {}
    if cfg.stage.name == "transfer":
        try:
            shared = fingerprints(parts, cfg.transfer.freeze, builtin(cfg.method.name, cfg.character.name))
        except ValueError:  # the frozen parts are not built in, so the file contains them
            if str(cfg.pretrained).partition(":")[0] == places.BUILTIN:
                raise
    config = cast("dict[str, Any]", OmegaConf.to_container(cfg))
    names = {value: Path(value).name for value in places.outside(config).values()}  # without folders of this machine
    publish(parts, places.moved(config, names), Path(output), shared=shared)


def evaluation(path: Path | str, *, episodes: int, seed: int, **kwargs: Any) -> dict[str, Any]:
    """Evaluate a run's policy, and return the content of ``evaluation.json``.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        episodes: Number of episodes, one per environment.
        seed: Seed of environments and sampling.
        **kwargs: Arguments of the environments, in addition to the run's settings for evaluations.

    Returns:
        ``episodes``; ``seed``; ``environment``, the arguments that replaced the run's arguments; and, both for the
        ``deterministic`` and the ``stochastic`` policy, the
        :func:`~torchrl_mcp.evaluation.rollout.episode_statistics`, with the
        :func:`~torchrl_mcp.evaluation.diagnostics.diagnostics` of gates and options as ``diagnostics``.

    Raises:
        ValueError: If there is no checkpoint, or the checkpoint is damaged.
    """
    environment = _evaluation_environment(path, kwargs)
    results: dict[str, Any] = {"episodes": episodes, "seed": seed, "environment": environment}
    for mode in MODES:
        _, agent, env = restore(path, num_envs=episodes, seed=seed, **environment)
        torch.manual_seed(seed)
        record = diagnosed(agent.actor)
        outcome = evaluate(agent.actor.policy, env, deterministic=mode == "deterministic", record=record)
        results[mode] = episode_statistics(outcome, env.normalised_return)
        results[mode]["diagnostics"] = diagnostics(agent.actor, outcome.decisions)
        env.close()
    return results


def evaluate_clips(path: Path | str, *, episodes: int, seed: int, **kwargs: Any) -> list[ClipResult]:
    """Return results of a run's deterministic policy on each of its reference motions.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        episodes: Number of episodes per clip.
        seed: Seed of the environments.
        **kwargs: Arguments of the environments, in addition to the run's settings for evaluations.

    Raises:
        ValueError: If there is no checkpoint, the checkpoint is damaged, or the task is not imitation.
    """
    environment = _evaluation_environment(path, kwargs)
    agent, env = restore_for_clips(path, episodes=episodes, seed=seed, **environment)
    return follow_each(agent.actor.policy, env)


def _evaluation_environment(path: Path | str, further: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arguments of environments in evaluations of a run, and further arguments, which replace them."""
    settings: Any = OmegaConf.to_container(policy_config(path).evaluation, resolve=True)
    return {**settings["environment"], **further}


def restore_for_clips(path: Path | str, *, episodes: int, seed: int, **kwargs: Any) -> tuple[Agent, Imitation]:
    """Return a run's agent and new environments, in which every episode follows a single clip and ends with it.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        episodes: Number of environments per clip.
        seed: Seed of the environments.
        **kwargs: Arguments of the environments that replace the run's arguments.

    Raises:
        ValueError: If there is no checkpoint, the checkpoint is damaged, or the task is not imitation.
    """
    _, _, env = restore(path, num_envs=1, seed=seed, **kwargs)
    if not hasattr(env, "library"):
        raise ValueError(f"{path} must be a run of task=imitation: other tasks have no clips to evaluate")
    single_clip = {**kwargs, "switch_interval": math.inf, "clip_end": "truncate"}
    _, agent, env = restore(path, num_envs=episodes * len(env.library), seed=seed, **single_clip)
    return agent, cast("Imitation", env)
