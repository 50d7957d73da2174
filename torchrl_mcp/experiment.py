"""From a configuration to objects. Beside the entry points, the only module that knows Hydra."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import Compose
from torchrl.record.loggers.common import Logger

from torchrl_mcp import checkpoint
from torchrl_mcp.actors import Actor
from torchrl_mcp.analysis.imitation import ClipResult, follow_each
from torchrl_mcp.builtin import builtin, publish
from torchrl_mcp.diagnostics import diagnosed, diagnostics
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.evaluation import evaluate, summary
from torchrl_mcp.memory import TransformedCharacterEnv
from torchrl_mcp.record import Record
from torchrl_mcp.training import Trainer
from torchrl_mcp.transfer import FrozenParts, require_parts

CONFIG = "config.yaml"


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
    env = instantiate(cfg.task[cfg.stage.name])(num_envs=num_envs, seed=seed, num_threads=cfg.num_threads, **kwargs)
    if not (transforms := instantiate(cfg.get("transforms", []))):
        return env
    return TransformedCharacterEnv(env, Compose(*transforms))


def make_agent(cfg: DictConfig, env: CharacterEnv, pretrained: Path | None = None) -> Agent:
    """Return the agent of the configured method, its kept parts from the checkpoint file ``pretrained`` if given."""
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
    parts.to(cfg.device)
    return Agent(parts, actor, critic, frozen)


def make_trainer(cfg: DictConfig, agent: Agent, env: CharacterEnv | TransformedCharacterEnv, folder: Path) -> Trainer:
    """Return the trainer of an agent.

    A method whose samples last for several steps, such as choices, names a ``batch_factor`` by which its batches are
    larger than ``training.frames_per_batch``.
    """
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
        env=env,
        parts=agent.parts,
        actor=agent.actor,
        critic=agent.critic,
        loss=loss,
        advantages=instantiate(cfg.objective.advantages)(agent.critic),
        optimizers=optimizers,
        frozen=agent.frozen,
        record=Record(folder),
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


def train(cfg: DictConfig) -> Path:
    """Train from the start in the run folder ``cfg.run_dir``, and return it.

    Raises:
        ValueError: If the folder holds a run already, or the configuration lacks the checkpoint to transfer from.
    """
    folder = Path(cfg.run_dir)
    if (folder / CONFIG).exists():
        raise ValueError(f"{folder} holds a run already: continue it with resume={folder}, or give another run_dir")
    trainer = _trainer(cfg, folder, _pretrained(cfg))
    folder.mkdir(parents=True, exist_ok=True)
    trainer.save()
    # Last, because it is what says that there is a run to resume.
    OmegaConf.save(cfg, folder / CONFIG, resolve=True)
    trainer.record.loggers = _loggers(cfg)
    trainer.run()
    return folder


def resume(folder: Path) -> Path:
    """Continue the run in ``folder`` from its newest checkpoint, with the configuration it began with.

    Raises:
        ValueError: If the folder holds no run, or its checkpoint is damaged.
    """
    if not (folder / CONFIG).is_file():
        raise ValueError(f"{folder} holds no run: it has no {CONFIG}")
    cfg = cast("DictConfig", OmegaConf.load(folder / CONFIG))
    trainer = _trainer(cfg, folder)
    trainer.restore(checkpoint.find(folder))
    trainer.record.loggers = _loggers(cfg)
    trainer.run()
    return folder


def restore(
    path: Path, *, num_envs: int, seed: int, device: str = "cpu", **kwargs: Any
) -> tuple[DictConfig, Agent, CharacterEnv | TransformedCharacterEnv]:
    """Return configuration, trained agent and fresh environments from a run folder or checkpoint file.

    Args:
        path: Run folder, of which the newest checkpoint counts, or checkpoint file. What is published holds no critic,
            which is then as it was initialised.
        num_envs: Number of environments.
        seed: Their seed.
        device: Where to put the networks.
        **kwargs: Arguments of the environments that replace the run's own.

    Raises:
        ValueError: If there is no checkpoint or it is damaged.
    """
    file = checkpoint.find(path)
    cfg = OmegaConf.create(dict(checkpoint.configuration(file)))
    cfg.device = device
    env = make_env(cfg, num_envs=num_envs, seed=seed, **kwargs)
    agent = make_agent(cfg, env)
    checkpoint.load_agent(agent.parts, file)
    return cfg, agent, env


def publish_run(path: Path, output: Path) -> None:
    """Write the policy of a run as a checkpoint file of its own, as small as those that come with the library.

    Args:
        path: Run folder, of which the newest checkpoint counts, or checkpoint file.
        output: The file to write.

    Raises:
        ValueError: If there is no checkpoint or it is damaged.
    """
    cfg, agent, _ = restore(path, num_envs=1, seed=0)
    cfg.run_dir = cfg.run_root = "runs"  # where it lay is of no use to others
    parts = nn.ModuleDict({name: part for name, part in agent.parts.items() if name != "critic"})
    publish(parts, cast("dict[str, Any]", OmegaConf.to_container(cfg)), output)


def evaluate_run(path: Path, *, episodes: int, seed: int, **kwargs: Any) -> dict[str, dict]:
    """Return the :func:`~torchrl_mcp.evaluation.summary` of a run's policy, ``deterministic`` and ``stochastic``.

    Each has the :func:`~torchrl_mcp.diagnostics.diagnostics` of gates and options as ``diagnostics``.

    Args:
        path: Run folder, of which the newest checkpoint counts, or checkpoint file.
        episodes: Episodes, one per environment.
        seed: Seed of environments and sampling.
        **kwargs: Arguments of the environments that replace the run's own.

    Raises:
        ValueError: If there is no checkpoint or it is damaged.
    """
    results = {}
    for mode in ("deterministic", "stochastic"):
        _, agent, env = restore(path, num_envs=episodes, seed=seed, **kwargs)
        torch.manual_seed(seed)
        record = diagnosed(agent.actor)
        outcome = evaluate(agent.actor.policy, env, deterministic=mode == "deterministic", record=record)
        results[mode] = summary(outcome, env.normalised_return)
        results[mode]["diagnostics"] = diagnostics(agent.actor, outcome.decisions)
    return results


def evaluate_clips(path: Path, *, episodes: int, seed: int) -> list[ClipResult]:
    """Return how well a run's policy follows each of its reference motions, when it plays deterministic actions.

    Args:
        path: Run folder, of which the newest checkpoint counts, or checkpoint file.
        episodes: Episodes per clip.
        seed: Seed of environments.

    Raises:
        ValueError: If there is no checkpoint, it is damaged, or the task is not imitation.
    """
    _, _, env = restore(path, num_envs=1, seed=seed)
    if not hasattr(env, "library"):
        raise ValueError(f"{path} follows no motions: only runs of task=imitation can be evaluated clip by clip")
    _, agent, env = restore(path, num_envs=episodes * len(env.library), seed=seed, switch_interval=math.inf)
    return follow_each(agent.actor.policy, env)


def _trainer(cfg: DictConfig, folder: Path, pretrained: Path | None = None) -> Trainer:
    if cfg.torch_threads:
        torch.set_num_threads(cfg.torch_threads)
    torch.manual_seed(cfg.seed)
    on_gpu = torch.device(cfg.device).type == "cuda"
    env = make_env(cfg, num_envs=cfg.training.num_envs, seed=cfg.seed, pin_memory=on_gpu)
    agent = make_agent(cfg, env, pretrained)
    return make_trainer(cfg, agent, env, folder)


def _loggers(cfg: DictConfig) -> list[Logger]:
    return [instantiate(cfg.logger)] if cfg.logger else []


def _pretrained(cfg: DictConfig) -> Path | None:
    """Return the checkpoint file to transfer from, or None where nothing is transferred."""
    if cfg.stage.name != "transfer" or not cfg.transfer.keep:
        return None
    if cfg.pretrained is None:
        raise ValueError(
            f"stage=transfer needs the pre-training of method={cfg.method.name}: run it with stage=pretrain first and "
            "give its run folder as pretrained=<folder>"
        )
    if cfg.pretrained == "builtin":
        return builtin(cfg.method.name, cfg.character.name)
    return checkpoint.find(Path(cfg.pretrained))
