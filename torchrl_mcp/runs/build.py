"""Builds environments, agent and trainer from a configuration, with Hydra's ``instantiate``."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, cast
from uuid import uuid4

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from torch import nn
from torchrl.envs import Compose

from torchrl_mcp.adapters.check import require_contract
from torchrl_mcp.adapters.contract import Environments
from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.modules.gaussian import restart_noise
from torchrl_mcp.runs import places
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.publish import load_kept
from torchrl_mcp.runs.requirements import (
    applicable,
    require_arguments,
    require_entry,
    require_environment,
    require_files,
)
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.collectors import TrajectorySource
from torchrl_mcp.training.metrics import begin_after
from torchrl_mcp.training.run_folder import WANDB
from torchrl_mcp.training.trainer import RunFolder, Trainer
from torchrl_mcp.training.transfer import FrozenParts, require_frozen_input, require_parts, widen_goal
from torchrl_mcp.training.update import Agent, Objective, PPOSettings


def make_run(cfg: DictConfig, folder: Path, initial: Path | None = None) -> Trainer:
    """Return the trainer of a run, with all that it needs.

    Args:
        cfg: The configuration.
        folder: The run folder.
        initial: Checkpoint file of the initial networks, or None for untrained networks.
    """
    if cfg.torch_threads:
        torch.set_num_threads(cfg.torch_threads)
    torch.manual_seed(cfg.seed)
    source = make_source(cfg)
    agent = make_agent(cfg, source.env, initial)
    return make_trainer(cfg, agent, source, folder)


def make_source(cfg: DictConfig) -> TrajectorySource:
    """Return the configured source of trajectories."""
    place: dict[str, Any] = {"pin_memory": torch.device(cfg.device).type == "cuda"}
    if cfg.physics.on_device:
        place = {"device": cfg.device}
    factory = partial(make_env, cfg, physics=instantiate(cfg.physics.engine), **place)
    return instantiate(cfg.collector)(factory, num_envs=cfg.training.num_envs, seed=cfg.seed)


def make_env(cfg: DictConfig, *, num_envs: int, seed: int, **kwargs: Any) -> Environments:
    """Return the environments of the configured task and stage, with the transforms that the method needs, if any.

    Raises:
        ValueError: As :func:`require_environment`.
    """
    require_environment(cfg)
    task, others = _with_parts(cfg.task[cfg.stage.name], kwargs)
    arguments = applicable(task["_target_"], {"num_threads": cfg.num_threads, **others})
    require_arguments(task["_target_"], arguments)
    require_files(cfg, task)
    env = instantiate(task)(num_envs=num_envs, seed=seed, **arguments)
    require_contract(env)
    if not (transforms := instantiate(cfg.get("transforms", []))):
        return env
    return TransformedCharacterEnv(env, Compose(*transforms))


def make_agent(cfg: DictConfig, env: Environments, pretrained: Path | None = None) -> Agent:
    """Return the agent of the configured method.

    If the checkpoint file ``pretrained`` is given, the parts that transfer keeps are loaded from it; in pre-training,
    all parts in the file are.

    Raises:
        ValueError: If the parts that transfer keeps or freezes are unknown or do not go together, or the file does not
            fit.
    """
    seen = env.observation_spec
    sizes = Sizes(seen["observation"].shape[-1], seen["goal"].shape[-1], env.action_spec.shape[-1])
    parts = instantiate(cfg.parts)(sizes)
    names: Sequence[str] = ()
    if cfg.stage.name == "transfer":
        require_parts(parts, cfg.transfer.keep, "transfer.keep")
        if pretrained is not None and cfg.transfer.keep:
            with _origin_named(cfg, pretrained):
                _load_kept(cfg, parts, sizes, env, pretrained)
            if cfg.transfer.get("restart_noise"):
                restart_noise(parts, cfg.action_std)
        names = cfg.transfer.freeze
        require_frozen_input(parts, cfg.transfer.keep, names)
    frozen = FrozenParts(parts, names)
    actor = instantiate(cfg.actor)(parts, frozen=names)
    critic = instantiate(cfg.critic)(parts, sizes)
    if cfg.stage.name == "pretrain" and pretrained is not None:
        with _origin_named(cfg, pretrained):
            checkpoint.load_agent(parts, pretrained)
    parts.to(cfg.device)
    return Agent(parts, actor, critic, frozen)


@contextmanager
def _origin_named(cfg: DictConfig, pretrained: Path) -> Iterator[None]:
    """Say, if networks do not fit, in what the run that they come from differs from this one."""
    try:
        yield
    except ValueError as error:
        saved = OmegaConf.create(dict(checkpoint.saved_config(pretrained)))
        numbers = [name for name, number in cfg.method.standard.items() if isinstance(number, int)]
        names = {"method": "method.name", "character": "character.name", **{name: name for name in numbers}}
        saved_values, values = (
            {name: OmegaConf.select(one, path) for name, path in names.items()} for one in (saved, cfg)
        )
        if saved_values == values:
            raise
        other = [name for name in names if saved_values[name] != values[name]]
        saved_words, words = (" ".join(f"{name}={one[name]}" for name in other) for one in (saved_values, values))
        raise ValueError(
            f"{pretrained} has networks of {saved_words}, which do not fit {words}: change either"
        ) from error


def _load_kept(cfg: DictConfig, parts: nn.ModuleDict, sizes: Sizes, env: Environments, pretrained: Path) -> None:
    """Load the parts that transfer keeps, which may have seen an entry of the goal alone."""
    origin = partial(builtin, cfg.method.name, cfg.character.name)
    if (name := cfg.transfer.goal_entry) is None:
        load_kept(parts, cfg.transfer.keep, pretrained, origin)
        return
    entry = require_entry(env, name)
    narrow = instantiate(cfg.parts)(sizes._replace(goal=entry.stop - entry.start))
    load_kept(narrow, cfg.transfer.keep, pretrained, origin)
    seeing = [part for part in narrow if _shapes(parts[part]) != _shapes(narrow[part])]
    if not {*seeing} & {*cfg.transfer.keep}:
        raise ValueError(
            f"transfer.goal_entry={name} needs kept networks that saw it: add {' or '.join(seeing)} to transfer.keep"
        )
    for kept in cfg.transfer.keep:
        widen_goal(parts[kept], narrow[kept], entry)


def _shapes(module: nn.Module) -> dict[str, torch.Size]:
    return {name: tensor.shape for name, tensor in module.state_dict().items()}


def make_trainer(cfg: DictConfig, agent: Agent, source: TrajectorySource, folder: Path) -> Trainer:
    """Return the trainer of an agent; ``cfg.autocast`` is true or false, as chosen by :func:`.precision.choose`.

    A method whose samples last for several steps, such as choices, sets ``batch_factor``: its batches are larger than
    ``training.frames_per_batch`` by this factor.
    """
    assert isinstance(cfg.autocast, bool)
    numbers = dict(cfg.training)
    numbers["frames_per_batch"] *= cfg.get("batch_factor", 1)
    settings = PPOSettings(
        **numbers,
        max_grad_norm=cfg.objective.max_grad_norm,
        checkpoint_interval=cfg.checkpoint_interval,
        autocast=cfg.autocast,
    )
    objective = make_objective(cfg, agent, source.env)
    run_folder = RunFolder(folder, places.stored(cfg), keep_checkpoints=cfg.keep_checkpoints)
    return Trainer(source, agent, objective, settings, run_folder, progress_bar=cfg.progress_bar)


def make_objective(cfg: DictConfig, agent: Agent, env: Environments) -> Objective:
    """Return what the agent optimises, and its optimisers; of a frozen actor there is none."""
    actor_loss = instantiate(cfg.objective.loss)(agent.actor.trained)
    actor_loss.set_keys(action=agent.actor.sampled, sample_log_prob=agent.actor.log_prob)
    advantages = instantiate(cfg.objective.advantages)(agent.critic)
    if symmetry := instantiate(cfg.get("symmetry")):
        mirrors = nn.ModuleDict(env.mirrors()).to(cfg.device)
        if "advantages" in symmetry:
            advantages = symmetry["advantages"](advantages, agent.actor, mirrors)
        if "loss" in symmetry:
            actor_loss = symmetry["loss"](actor_loss, agent.actor, mirrors)
    losses = {"actor": actor_loss, "critic": instantiate(cfg.objective.value_loss)(agent.critic)}
    trainable = {
        "actor": [p for p in agent.actor.trained.parameters() if p.requires_grad],
        "critic": list(agent.parts["critic"].parameters()),
    }
    optimizers = {name: instantiate(cfg.optimizer[name])(p) for name, p in trainable.items() if p}
    schedule = instantiate(cfg.optimizer.schedule)
    return Objective(
        advantages, losses, optimizers, schedule(optimizers["actor"]) if schedule and "actor" in optimizers else None
    )


def make_loggers(cfg: DictConfig, trainer: Trainer, folder: Path) -> list[Any]:
    """Return the configured logger, if any, and the recorder of films, weights and learning curves, if one is."""
    # MLflow 3 writes to files, which need no server and stay in the run folder, only if this is set.
    os.environ.setdefault("MLFLOW_ALLOW_FILE_STORE", "true")
    loggers = [instantiate(cfg.logger, **_identity(cfg.logger, folder))] if cfg.logger else []
    for logger in loggers:
        begin_after(logger, trainer.progress.frames)
    if cfg.get("record_interval") is None:
        return loggers
    actor = trainer.agent.actor
    make_film_env = partial(make_env, cfg, num_envs=1, seed=cfg.evaluation.seed)
    recorder = instantiate(cfg.recorder)(folder, actor.policy, make_film_env, loggers, num_options=actor.num_options)
    return [*loggers, recorder]


def _identity(logger: DictConfig, folder: Path) -> dict[str, Any]:
    """Return the arguments of a logger by which a resumed run goes on with the same run at W&B."""
    if logger.get("logger_type") != "wandb" or "id" in (logger.get("wandb_kwargs") or {}):
        return {}
    file = folder / WANDB
    if not file.exists():
        file.write_text(uuid4().hex[:8])
    return {"wandb_kwargs": {"id": file.read_text()}}


def _with_parts(task: DictConfig, arguments: Mapping[str, Any]) -> tuple[DictConfig, dict[str, Any]]:
    """Return a task's configuration and its other arguments, after setting arguments of the objects that it builds."""
    parts = {
        name: value
        for name, value in arguments.items()
        if isinstance(value, Mapping) and OmegaConf.is_dict(task.get(name)) and "_target_" in task[name]
    }
    merged = cast("DictConfig", OmegaConf.merge(task, parts)) if parts else task
    return merged, {name: value for name, value in arguments.items() if name not in parts}
