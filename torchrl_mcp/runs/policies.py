"""Trained policies: restored from a run folder or checkpoint file, evaluated and published."""

import math
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf
from torch import nn

from torchrl_mcp.envs import Imitation
from torchrl_mcp.evaluation.clips import ClipResult, follow_each
from torchrl_mcp.evaluation.diagnostics import diagnosed, diagnostics
from torchrl_mcp.evaluation.rollout import episode_statistics, evaluate
from torchrl_mcp.runs import places, requirements
from torchrl_mcp.runs.build import Agent, make_agent, make_env
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.publish import fingerprints, publish, take_shared
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.run_folder import MODES


def policy_config(path: Path) -> DictConfig:
    """Return the configuration with which a policy was trained.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.

    Raises:
        ValueError: If there is no checkpoint, or it is damaged or from another version of the library.
    """
    file = checkpoint.find(path)
    config = checkpoint.saved_config(file)
    requirements.require_known(config, file)
    return OmegaConf.create(dict(config))


def restore(
    path: Path | str, *, num_envs: int, seed: int, device: str = "cpu", **kwargs: Any
) -> tuple[DictConfig, Agent, Any]:
    """Return configuration, trained agent and new environments from a run folder or checkpoint file.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file. Published files have no critic that does
            not act; it is then untrained.
        num_envs: Number of environments.
        seed: Seed of the environments.
        device: Device of the networks.
        **kwargs: Arguments of the environments that replace the run's own.

    Raises:
        ValueError: If there is no checkpoint, it is damaged, or it names classes that cannot be imported.
    """
    file = checkpoint.find(Path(path))
    cfg = policy_config(file)
    cfg.device = device
    env = make_env(cfg, num_envs=num_envs, seed=seed, **kwargs)
    agent = make_agent(cfg, env)
    if shared := checkpoint.shared(file):
        take_shared(agent.parts, shared, file, builtin(cfg.method.name, cfg.character.name))
    checkpoint.load_agent(agent.parts, file, optional=agent.spare_parts)
    return cfg, agent, env


def publish_run(path: Path, output: Path) -> None:
    """Write the policy of a run as a separate checkpoint file, as small as the built-in networks.

    The file leaves out the frozen parts if a built-in network has the same in bfloat16, bit for bit.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        output: The file to write.

    Raises:
        ValueError: If there is no checkpoint, it is damaged, or the frozen parts differ from the built-in network.
    """
    cfg, agent, _ = restore(path, num_envs=1, seed=0)
    cfg.run_dir = cfg.run_root = "."  # older runs have the folder where they began, which is of no use to others
    parts = nn.ModuleDict({name: part for name, part in agent.parts.items() if name not in agent.spare_parts})
    shared: dict[str, str] = {}
    if cfg.stage.name == "transfer":
        try:
            shared = fingerprints(parts, cfg.transfer.freeze, builtin(cfg.method.name, cfg.character.name))
        except ValueError:  # other networks, which the file then holds
            if cfg.pretrained == "builtin":
                raise
    config = cast("dict[str, Any]", OmegaConf.to_container(cfg))
    names = {value: Path(value).name for value in places.outside(config).values()}  # without folders of this machine
    publish(parts, places.moved(config, names), output, shared=shared)


def evaluation(path: Path, *, episodes: int, seed: int, **kwargs: Any) -> dict[str, Any]:
    """Evaluate a run's policy, and return the content of ``evaluation.json``.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        episodes: Episodes, one per environment.
        seed: Seed of environments and sampling.
        **kwargs: Arguments of the environments, beside those that the run's configuration has for evaluations.

    Returns:
        ``episodes``, ``seed``, the arguments of the ``environment`` that replaced the run's own, and for the policy
        ``deterministic`` and ``stochastic``, the :func:`~torchrl_mcp.evaluation.rollout.episode_statistics`, with the
        :func:`~torchrl_mcp.evaluation.diagnostics.diagnostics` of gates and options as ``diagnostics``.

    Raises:
        ValueError: If there is no checkpoint or it is damaged.
    """
    settings: Any = OmegaConf.to_container(policy_config(path).evaluation, resolve=True)
    environment = {**settings["environment"], **kwargs}
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


def evaluate_clips(path: Path, *, episodes: int, seed: int, **kwargs: Any) -> list[ClipResult]:
    """Return results of a run's deterministic policy on each of its reference motions.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        episodes: Number of episodes per clip.
        seed: Seed of the environments.
        **kwargs: Arguments of the environments that replace the run's own.

    Raises:
        ValueError: If there is no checkpoint, it is damaged, or the task is not imitation.
    """
    agent, env = restore_for_clips(path, episodes=episodes, seed=seed, **kwargs)
    return follow_each(agent.actor.policy, env)


def restore_for_clips(path: Path, *, episodes: int, seed: int, **kwargs: Any) -> tuple[Agent, Imitation]:
    """Return a run's agent and new environments, in each of which an episode follows one clip and ends with it.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        episodes: Number of environments per clip.
        seed: Seed of the environments.
        **kwargs: Arguments of the environments that replace the run's own.

    Raises:
        ValueError: If there is no checkpoint, it is damaged, or the task is not imitation.
    """
    _, _, env = restore(path, num_envs=1, seed=seed, **kwargs)
    if not hasattr(env, "library"):
        raise ValueError(f"{path} follows no motions: only runs of task=imitation can be evaluated clip by clip")
    alone = {**kwargs, "switch_interval": math.inf, "clip_end": "truncate"}
    _, agent, env = restore(path, num_envs=episodes * len(env.library), seed=seed, **alone)
    return agent, cast("Imitation", env)
