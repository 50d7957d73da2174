"""From a configuration to environments, an agent and its trainer."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import Compose

from torchrl_mcp.training import checkpoint
from torchrl_mcp.methods.actor import Actor
from torchrl_mcp.training.collectors import TrajectorySource
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.training.metrics import MetricsWriter
from torchrl_mcp.training.trainer import Trainer
from torchrl_mcp.training.transfer import FrozenParts, require_parts


@dataclass(frozen=True)
class Agent:
    """A method's networks for the sizes of an environment."""

    parts: nn.ModuleDict
    actor: Actor
    critic: TensorDictModuleBase
    frozen: FrozenParts


def make_env(cfg: DictConfig, *, num_envs: int, seed: int, **kwargs: Any) -> CharacterEnv | TransformedCharacterEnv:
    """Return the environments of the configured task and stage, with the transforms that the method needs, if any.

    Raises:
        ValueError: If the task has no such stage.
    """
    if cfg.stage.name not in cfg.task:
        raise ValueError(
            f"task={cfg.task.name} has no stage={cfg.stage.name}: pre-train with task=imitation, and transfer to "
            f"task={cfg.task.name} with stage=transfer and pretrained=<folder of the pre-training>"
        )
    settings = {"num_threads": cfg.num_threads, **kwargs}
    env = instantiate(cfg.task[cfg.stage.name])(num_envs=num_envs, seed=seed, **settings)
    if not (transforms := instantiate(cfg.get("transforms", []))):
        return env
    return TransformedCharacterEnv(env, Compose(*transforms))


def make_agent(cfg: DictConfig, env: CharacterEnv, pretrained: Path | None = None) -> Agent:
    """Return the agent of the configured method.

    If the checkpoint file ``pretrained`` is given, the parts that transfer keeps come from it, or in pre-training all
    that it holds.
    """
    sizes = {key: env.observation_spec[key].shape[-1] for key in ("observation", "goal")}
    parts = instantiate(cfg.parts)(sizes["observation"], sizes["goal"], env.action_spec.shape[-1])
    names: Sequence[str] = ()
    if cfg.stage.name == "transfer":
        require_parts(parts, cfg.transfer.keep, "transfer.keep")
        if pretrained is not None and cfg.transfer.keep:
            checkpoint.load_parts(parts, cfg.transfer.keep, pretrained)
        names = cfg.transfer.freeze
    frozen = FrozenParts(parts, names)
    actor = instantiate(cfg.actor)(parts, frozen=names)
    critic = instantiate(cfg.critic)(parts, sizes["observation"], sizes["goal"])
    if cfg.stage.name == "pretrain" and pretrained is not None:
        checkpoint.load_agent(parts, pretrained)
    parts.to(cfg.device)
    return Agent(parts, actor, critic, frozen)


def make_source(cfg: DictConfig) -> TrajectorySource:
    """Return where trajectories come from."""
    pin_memory = torch.device(cfg.device).type == "cuda"
    factory = partial(make_env, cfg, pin_memory=pin_memory)
    return instantiate(cfg.collector)(factory, num_envs=cfg.training.num_envs, seed=cfg.seed)


def make_trainer(cfg: DictConfig, agent: Agent, source: TrajectorySource, folder: Path) -> Trainer:
    """Return the trainer of an agent; ``cfg.autocast`` is true or false, as :mod:`~torchrl_mcp.training.precision` chose.

    A method whose samples last for several steps, such as choices, names a ``batch_factor`` by which its batches are
    larger than ``training.frames_per_batch``.
    """
    assert isinstance(cfg.autocast, bool)
    trainable = {
        "actor": [p for p in agent.actor.trained.parameters() if p.requires_grad],
        "critic": list(agent.parts["critic"].parameters()),
    }
    optimizers = {name: instantiate(cfg.optimizer[name])(p) for name, p in trainable.items() if p}
    loss = instantiate(cfg.objective.loss)(agent.actor.trained, agent.critic)
    loss.set_keys(action=agent.actor.sampled, sample_log_prob=agent.actor.log_prob)
    training = {key: value for key, value in cfg.training.items() if key != "num_envs"}
    training["frames_per_batch"] *= cfg.get("batch_factor", 1)
    return Trainer(
        source=source,
        parts=agent.parts,
        actor=agent.actor,
        critic=agent.critic,
        loss=loss,
        advantages=instantiate(cfg.objective.advantages)(agent.critic),
        optimizers=optimizers,
        frozen=agent.frozen,
        metrics_writer=MetricsWriter(folder),
        checkpoints=checkpoint.rotation(folder, cfg.keep_checkpoints),
        config=cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True)),
        max_grad_norm=cfg.objective.max_grad_norm,
        step_size_schedule=instantiate(cfg.optimizer.schedule),
        autocast=cfg.autocast,
        device=cfg.device,
        checkpoint_interval=cfg.checkpoint_interval,
        progress_bar=cfg.progress_bar,
        **training,
    )
