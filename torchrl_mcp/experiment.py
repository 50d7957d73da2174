"""From a configuration to objects. Beside the entry points, the only module that knows Hydra."""

import json
import math
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import torch
from hydra import compose, initialize_config_module
from hydra.core.global_hydra import GlobalHydra
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import Compose
from torchrl.record.loggers.common import Logger

from torchrl_mcp import checkpoint, origin
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
EVALUATION = "evaluation.json"


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
    """Train from the start in the run folder ``cfg.run_dir``, evaluate the policy, and return the folder.

    Raises:
        ValueError: If the folder holds a run already, or the configuration lacks the checkpoint to transfer from.
    """
    folder = Path(cfg.run_dir)
    if (folder / CONFIG).exists():
        raise ValueError(f"{folder} holds a run already: continue it with resume={folder}, or give another run_dir")
    trainer = _trainer(cfg, folder, _pretrained(cfg))
    folder.mkdir(parents=True, exist_ok=True)
    trainer.save()
    _write(origin.origin(cfg.device), folder / origin.FILE)
    # Last, because it is what says that there is a run to resume.
    OmegaConf.save(cfg, folder / CONFIG, resolve=True)
    _finish(trainer, cfg, folder)
    return folder


def resume(folder: Path) -> Path:
    """Continue the run in ``folder`` from its newest checkpoint, with the configuration it began with.

    A run that :func:`is_complete` is left as it is.

    Raises:
        ValueError: If the folder holds no run, or its checkpoint is damaged.
    """
    if is_complete(folder):
        return folder
    cfg, newest = configuration(folder), checkpoint.find(folder)
    if checkpoint.frames(newest):
        trainer = _trainer(cfg, folder)
        trainer.restore(newest)
    else:  # the environments have not been reset yet, so there is no state of theirs to return to
        trainer = _trainer(cfg, folder, _pretrained(cfg))
        trainer.record.rewind(0)
    (folder / EVALUATION).unlink(missing_ok=True)
    _finish(trainer, cfg, folder)
    return folder


def configuration(folder: Path) -> DictConfig:
    """Return the configuration of the run in ``folder``; what it has not of ``evaluation`` is as in a new run.

    Raises:
        ValueError: If the folder holds no run.
    """
    if not (folder / CONFIG).is_file():
        raise ValueError(f"{folder} holds no run: it has no {CONFIG}")
    cfg = cast("DictConfig", OmegaConf.load(folder / CONFIG))
    if "evaluation" not in cfg:
        cfg.evaluation = _usual_evaluation(cfg.task.name)
    return cfg


def is_complete(folder: Path) -> bool:
    """Tell whether the run in ``folder`` has taken all its steps and has been evaluated.

    Raises:
        ValueError: If the folder holds no run.
    """
    cfg = configuration(folder)
    trained = checkpoint.frames(checkpoint.find(folder)) >= cfg.training.total_frames
    return trained and (cfg.evaluation.episodes == 0 or (folder / EVALUATION).is_file())


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


def evaluation(path: Path, *, episodes: int, seed: int) -> dict[str, Any]:
    """Return what ``evaluation.json`` says of a run: :func:`evaluate_run` in the environments of its configuration.

    Args:
        path: Run folder, of which the newest checkpoint counts, or checkpoint file.
        episodes: Episodes, one per environment.
        seed: Seed of environments and sampling.

    Returns:
        ``episodes``, ``seed``, the arguments of the ``environment`` that replaced the run's own, ``deterministic`` and
        ``stochastic``.

    Raises:
        ValueError: If there is no checkpoint or it is damaged.
    """
    cfg = OmegaConf.create(dict(checkpoint.configuration(checkpoint.find(path))))
    settings: Any = OmegaConf.to_container(cfg.get("evaluation") or _usual_evaluation(cfg.task.name), resolve=True)
    environment = settings["environment"]
    numbers = evaluate_run(path, episodes=episodes, seed=seed, **environment)
    return {"episodes": episodes, "seed": seed, "environment": environment, **numbers}


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


def _finish(trainer: Trainer, cfg: DictConfig, folder: Path) -> None:
    """Train to the end and evaluate what came of it."""
    trainer.record.loggers = _loggers(cfg)
    trainer.run()
    if cfg.evaluation.episodes:
        numbers = evaluation(folder, episodes=cfg.evaluation.episodes, seed=cfg.evaluation.seed)
        _write(numbers, folder / EVALUATION)


def _usual_evaluation(task: str) -> DictConfig:
    """Return how a new run of a task is evaluated."""
    begun = GlobalHydra.instance().is_initialized()  # on the command line
    with nullcontext() if begun else initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        return compose("train", [f"task={task}"]).evaluation


def _write(content: dict[str, Any], path: Path) -> None:
    """Write a JSON file that is whole if it is there."""
    part = path.with_suffix(".part")
    part.write_text(json.dumps(content, indent=2) + "\n")
    part.replace(path)


def _loggers(cfg: DictConfig) -> list[Logger]:
    return [instantiate(cfg.logger)] if cfg.logger else []


def _pretrained(cfg: DictConfig) -> Path | None:
    """Return the checkpoint file to begin from, or None to begin from nothing."""
    transfers = cfg.stage.name == "transfer"
    if (transfers and not cfg.transfer.keep) or (not transfers and cfg.pretrained is None):
        return None
    if cfg.pretrained is None:
        raise ValueError(
            f"stage=transfer needs the pre-training of method={cfg.method.name}: run it with stage=pretrain first and "
            "give its run folder as pretrained=<folder>"
        )
    if cfg.pretrained == "builtin":
        return builtin(cfg.method.name, cfg.character.name)
    return checkpoint.find(Path(cfg.pretrained))
