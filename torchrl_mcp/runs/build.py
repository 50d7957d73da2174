"""Builds environments, agent and trainer from a configuration with Hydra's ``instantiate``."""

import os
import warnings
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
from torchrl_mcp.runs.arguments import applicable, require_arguments
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.imports import require_environment
from torchrl_mcp.runs.publish import load_kept
from torchrl_mcp.runs.requirements import require_files
from torchrl_mcp.runs.validation import require_values
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.collectors import TrajectorySource
from torchrl_mcp.training.metrics import begin_after
from torchrl_mcp.training.run_folder import WANDB
from torchrl_mcp.training.trainer import RunFolder, Trainer
from torchrl_mcp.training.transfer import FrozenParts, require_frozen_input, require_parts, widen_goal
from torchrl_mcp.training.update import Agent, Objective, PPOSettings


def make_run(cfg: DictConfig, folder: Path, initial: Path | None = None) -> Trainer:
    """Return the trainer of a run, after building its environments and its agent.

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
    placement: dict[str, Any] = {"pin_memory": torch.device(cfg.device).type == "cuda"}
    if cfg.physics.on_device:
        placement = {"device": cfg.device}
    factory = partial(make_env, cfg, physics=instantiate(cfg.physics.engine), **placement)
    return instantiate(cfg.collector)(factory, num_envs=cfg.training.num_envs, seed=cfg.seed)


def make_env(cfg: DictConfig, *, num_envs: int, seed: int, **kwargs: Any) -> Environments:
    """Return the environments of the configured task and stage, with the transforms that the method may need.

    Args:
        cfg: The configuration.
        num_envs: Number of environments.
        seed: Seed of the environments.
        **kwargs: Arguments of the environments that replace configured ones. A mapping replaces arguments of an object
            that the task builds, such as its reference motions.

    Raises:
        ValueError: As :func:`require_environment`, or if the environments do not take an argument or its value.
    """
    require_environment(cfg)
    task, further = _with_parts(cfg.task[cfg.stage.name], kwargs)
    arguments = applicable(task["_target_"], {"num_threads": cfg.num_threads, **further})
    require_arguments(task["_target_"], arguments)
    require_values(cfg.task[cfg.stage.name], kwargs)
    require_files(cfg, task)
    env = instantiate(task)(num_envs=num_envs, seed=seed, **arguments)
    require_contract(env)
    if not (transforms := instantiate(cfg.get("transforms", []))):
        return env
    return TransformedCharacterEnv(env, Compose(*transforms))


def make_agent(cfg: DictConfig, env: Environments, pretrained: Path | None = None) -> Agent:
    """Return the agent of the configured method.

    From the checkpoint file ``pretrained``, transfer loads the parts that it keeps, and pre-training loads all parts.

    Raises:
        ValueError: If transfer keeps or freezes unknown parts, or parts that do not go together, or if the networks of
            the file do not fit the configuration.
    """
    spec = env.observation_spec
    sizes = Sizes(spec["observation"].shape[-1], spec["goal"].shape[-1], env.action_spec.shape[-1])
    parts = instantiate(cfg.parts)(sizes)
    names: Sequence[str] = ()
    if cfg.stage.name == "transfer":
        require_parts(parts, cfg.transfer.keep, "transfer.keep")
        if pretrained is not None and cfg.transfer.keep:
            with _explained(cfg, pretrained):
                _load_kept(cfg, parts, sizes, env, pretrained)
            _warn_of_mixers(cfg, pretrained)
            if cfg.transfer.get("restart_noise"):
                restart_noise(parts, cfg.action_std)
        names = cfg.transfer.freeze
        require_frozen_input(parts, cfg.transfer.keep, names)
    frozen = FrozenParts(parts, names)
    actor = instantiate(cfg.actor)(parts, frozen=names)
    critic = instantiate(cfg.critic)(parts, sizes)
    if cfg.stage.name == "pretrain" and pretrained is not None:
        with _explained(cfg, pretrained):
            checkpoint.load_agent(parts, pretrained)
    parts.to(cfg.device)
    return Agent(parts, actor, critic, frozen)


@contextmanager
def _explained(cfg: DictConfig, pretrained: Path) -> Iterator[None]:
    """If networks do not fit, raise an error that names the settings in which their run differs from this run."""
    try:
        yield
    except ValueError as error:
        saved = OmegaConf.create(dict(checkpoint.saved_config(pretrained)))
        numbers = [name for name, number in cfg.method.standard.items() if isinstance(number, int)]
        paths = {"method": "method.name", "character": "character.name", **{name: name for name in numbers}}
        saved_values = {name: OmegaConf.select(saved, path) for name, path in paths.items()}
        values = {name: OmegaConf.select(cfg, path) for name, path in paths.items()}
        if saved_values == values:
            raise
        changed = [name for name in paths if saved_values[name] != values[name]]
        saved_words = " ".join(f"{name}={saved_values[name]}" for name in changed)
        words = " ".join(f"{name}={values[name]}" for name in changed)
        raise ValueError(
            f"{pretrained} has networks of {saved_words}, which do not fit {words}: change one of the two"
        ) from error


def _warn_of_mixers(cfg: DictConfig, pretrained: Path) -> None:
    """Warn if kept primitives were pre-trained with another mixer, because their networks fit all the same."""
    first_mixer = checkpoint.saved_config(pretrained).get("mixer", {}).get("name", cfg.mixer.name)
    if "primitives" in cfg.transfer.keep and first_mixer != cfg.mixer.name:
        warnings.warn(
            f"the primitives of {pretrained} were pre-trained with mixer={first_mixer}, and mixer={cfg.mixer.name} "
            "now composes them: to compare mixers, pre-train with each, as benchmark=mixer does",
            stacklevel=2,
        )


def _load_kept(cfg: DictConfig, parts: nn.ModuleDict, sizes: Sizes, env: Environments, pretrained: Path) -> None:
    """Load the parts that transfer keeps, whose pre-training may have had only one entry of the goal.

    Raises:
        ValueError: If ``transfer.goal_entry`` is not an entry of the goal, or no kept part reads the goal.
    """
    origin = partial(builtin, cfg.method.name, cfg.character.name)
    if (name := cfg.transfer.goal_entry) is None:
        load_kept(parts, cfg.transfer.keep, pretrained, origin)
        return
    entry = _goal_entry(env, name)
    narrow = instantiate(cfg.parts)(sizes._replace(goal=entry.stop - entry.start))
    load_kept(narrow, cfg.transfer.keep, pretrained, origin)
    reading_goal = [part for part in narrow if _shapes(parts[part]) != _shapes(narrow[part])]
    if not {*reading_goal} & {*cfg.transfer.keep}:
        raise ValueError(
            f"transfer.goal_entry={name} needs a kept network that reads this entry: add "
            f"{' or '.join(reading_goal)} to transfer.keep"
        )
    for part in cfg.transfer.keep:
        widen_goal(parts[part], narrow[part], entry)


def _goal_entry(env: Environments, name: str) -> slice:
    """Return the range of an entry in an environment's goal.

    Raises:
        ValueError: If the goal has no such entry.
    """
    layout = env.goal_layout
    if name not in layout or len(layout) == 1:
        remedy = f"use one of {', '.join(layout)}" if len(layout) > 1 else "omit it, because the goal has no parts"
        raise ValueError(f"transfer.goal_entry={name} is not an entry of the task's goal: {remedy}")
    return layout[name]


def _shapes(module: nn.Module) -> dict[str, torch.Size]:
    return {name: tensor.shape for name, tensor in module.state_dict().items()}


def make_trainer(cfg: DictConfig, agent: Agent, source: TrajectorySource, folder: Path) -> Trainer:
    """Return the trainer of an agent; ``cfg.autocast`` is true or false, as chosen by :func:`.precision.choose`.

    A method whose samples last for several steps, such as choices among options, sets ``batch_factor``. This factor
    multiplies ``training.frames_per_batch``.
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
    """Return the objective of an agent, without an optimiser for a frozen actor."""
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
    """Return the loggers of a run: the configured logger, and the recorder if ``record_interval`` is set."""
    # Only with this variable does MLflow 3 write to files, which need no server and stay in the run folder.
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
    """Return the arguments of a logger with which a resumed run continues the same run at W&B."""
    if logger.get("logger_type") != "wandb" or "id" in (logger.get("wandb_kwargs") or {}):
        return {}
    file = folder / WANDB
    if not file.exists():
        file.write_text(uuid4().hex[:8])
    return {"wandb_kwargs": {"id": file.read_text()}}


def _with_parts(task: DictConfig, arguments: Mapping[str, Any]) -> tuple[DictConfig, dict[str, Any]]:
    """Merge arguments of the objects that a task builds into its configuration; also return the other arguments."""
    parts = {
        name: value
        for name, value in arguments.items()
        if isinstance(value, Mapping) and OmegaConf.is_dict(task.get(name)) and "_target_" in task[name]
    }
    merged = cast("DictConfig", OmegaConf.merge(task, parts)) if parts else task
    return merged, {name: value for name, value in arguments.items() if name not in parts}
