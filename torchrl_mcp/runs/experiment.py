"""The life of a run: trained in a folder of its own, resumed, restored, evaluated and published."""

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf
from torch import nn

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.evaluation.clips import ClipResult, follow_each
from torchrl_mcp.evaluation.diagnostics import diagnosed, diagnostics
from torchrl_mcp.evaluation.rollout import episode_statistics, evaluate
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.runs import build, lock
from torchrl_mcp.runs.build import Agent, make_agent, make_env, make_source, make_trainer
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.identity import CONDUCT, PLACES, differences
from torchrl_mcp.runs.machine import machine
from torchrl_mcp.runs.provenance import provenance
from torchrl_mcp.runs.publish import fingerprints, publish, take_shared
from torchrl_mcp.runs.trust import read_config, trusting
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.metrics import begin_after
from torchrl_mcp.training.precision import choose, name
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, PROVENANCE, remove_leftovers, replacing, write_json
from torchrl_mcp.training.trainer import Trainer


def train(cfg: DictConfig) -> Path:
    """Train from the start in the run folder ``cfg.run_dir``, evaluate the policy, and return the folder.

    The folder's configuration holds the precision that was chosen, where ``cfg.autocast`` leaves it to the machine.

    Raises:
        ValueError: If the folder holds a run already, another process is at work on it, there is no environment for the
            configured task and character, or the configuration lacks the checkpoint to transfer from.
    """
    _require(cfg)
    with _held(Path(cfg.run_dir)), trusting(build.named(cfg)):
        return _train(cfg)


def resume(folder: Path) -> Path:
    """Continue the run in ``folder`` from its newest checkpoint, with the configuration it began with.

    A run that :func:`is_complete` is left as it is. On another machine it keeps the precision that it began with.

    Raises:
        ValueError: If the folder holds no run, another process is at work on it, or its checkpoint is damaged.
    """
    if is_complete(folder):
        return folder
    with _held(folder):
        return _resume(folder)


def train_or_resume(cfg: DictConfig, *, wait: bool = False) -> Path:
    """Train as configured, or go on where training stopped; return the folder.

    Args:
        cfg: The configuration. A run that has begun goes on with its own.
        wait: If another process is at work on the run, wait for that.

    Raises:
        ValueError: As :func:`train` and :func:`resume`.
    """
    folder = Path(cfg.run_dir)
    _require(cfg)
    with _held(folder, wait=wait), trusting(build.named(cfg)):
        return _resume(folder) if (folder / CONFIG).exists() else _train(cfg)


def run_config(folder: Path) -> DictConfig:
    """Return the configuration of the run in ``folder``.

    Raises:
        ValueError: If the folder holds no run, or one of another version of the library.
    """
    if not (folder / CONFIG).is_file():
        raise ValueError(f"{folder} holds no run: it has no {CONFIG}")
    config = read_config(folder / CONFIG)
    build.require_known(config, folder / CONFIG)
    return OmegaConf.create(config)


def policy_config(path: Path) -> DictConfig:
    """Return the configuration with which a policy was trained.

    Args:
        path: Run folder, of which the newest checkpoint counts, or checkpoint file.

    Raises:
        ValueError: If there is no checkpoint, it is damaged, or of another version of the library.
    """
    file = checkpoint.find(path)
    config = checkpoint.saved_config(file)
    build.require_known(config, file)
    return OmegaConf.create(dict(config))


def is_complete(folder: Path) -> bool:
    """Tell whether the run in ``folder`` has taken all its steps and has been evaluated.

    Raises:
        ValueError: If the folder holds no run.
    """
    cfg = run_config(folder)
    trained = run_folder.frames(checkpoint.find(folder)) >= cfg.training.total_frames
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
        ValueError: If there is no checkpoint, it is damaged, or it names classes that cannot be imported.
    """
    file = checkpoint.find(path)
    cfg = policy_config(file)
    cfg.device = device
    env = make_env(cfg, num_envs=num_envs, seed=seed, **kwargs)
    agent = make_agent(cfg, env)
    if checkpoint.shared(file):
        take_shared(agent.parts, file, builtin(cfg.method.name, cfg.character.name))
    checkpoint.load_agent(agent.parts, file)
    return cfg, agent, env


def publish_run(path: Path, output: Path) -> None:
    """Write the policy of a run as a checkpoint file of its own, as small as those that come with the library.

    Of a run that transferred from the networks that come with the library, it leaves out what training froze of them.

    Args:
        path: Run folder, of which the newest checkpoint counts, or checkpoint file.
        output: The file to write.

    Raises:
        ValueError: If there is no checkpoint, it is damaged, or the library's networks are not what was frozen.
    """
    cfg, agent, _ = restore(path, num_envs=1, seed=0)
    cfg.run_dir = cfg.run_root = "runs"  # where it lay is of no use to others
    parts = nn.ModuleDict({name: part for name, part in agent.parts.items() if name != "critic"})
    shared: dict[str, str] = {}
    if cfg.stage.name == "transfer" and cfg.pretrained == "builtin":
        shared = fingerprints(parts, cfg.transfer.freeze, builtin(cfg.method.name, cfg.character.name))
    publish(parts, cast("dict[str, Any]", OmegaConf.to_container(cfg)), output, shared=shared)


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
    settings: Any = OmegaConf.to_container(policy_config(path).evaluation, resolve=True)
    environment = settings["environment"]
    numbers = evaluate_run(path, episodes=episodes, seed=seed, **environment)
    return {"episodes": episodes, "seed": seed, "environment": environment, **numbers}


def evaluate_run(path: Path, *, episodes: int, seed: int, **kwargs: Any) -> dict[str, dict]:
    """Return how a run's policy did, ``deterministic`` and ``stochastic``.

    Each is the :func:`~torchrl_mcp.evaluation.rollout.episode_statistics` of the episodes, with the
    :func:`~torchrl_mcp.evaluation.diagnostics.diagnostics` of gates and options as ``diagnostics``.

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
        results[mode] = episode_statistics(outcome, env.normalised_return)
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


def _require(cfg: DictConfig) -> None:
    """Check a configuration before a folder exists."""
    build.require_valid(cfg)
    build.require_environment(cfg)
    build.require_equipment(cfg)


@contextmanager
def _held(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold a run folder alone, without what killed processes left in it."""
    with lock.held(folder, wait=wait):
        remove_leftovers(folder)
        yield


def _train(cfg: DictConfig) -> Path:
    folder = Path(cfg.run_dir)
    if (folder / CONFIG).exists():
        raise ValueError(f"{folder} holds a run already: continue it with resume={folder}, or give another run_dir")
    pretrained, precision = _pretrained(cfg), choose(cfg.autocast, cfg.device)
    print(f"{folder}: {precision}", flush=True)
    cfg = cast("DictConfig", OmegaConf.merge(cfg, {"autocast": precision.autocast}))
    trainer = _trainer(cfg, folder, pretrained)
    trainer.save()
    write_json(provenance(cfg.device, *build.launched(), precision), folder / PROVENANCE)
    # Last, because it is what says that there is a run to resume.
    with replacing(folder / CONFIG) as partial:
        OmegaConf.save(cfg, partial, resolve=True)
    _finish(trainer, cfg, folder)
    return folder


def _resume(folder: Path) -> Path:
    if is_complete(folder):
        return folder
    cfg = run_config(folder)
    print(f"{folder}: {_precision_kept(cfg, folder)}", flush=True)
    trainer = _restored(cfg, folder)
    (folder / EVALUATION).unlink(missing_ok=True)
    _finish(trainer, cfg, folder)
    return folder


def _restored(cfg: DictConfig, folder: Path) -> Trainer:
    """Return the trainer of a run at its newest checkpoint that is not damaged; say so if that is not the newest."""
    saved = run_folder.find_all(folder) or [checkpoint.find(folder)]
    path = next((path for path in saved if checkpoint.is_intact(path)), saved[0])
    _require_same_run(cfg, path)
    if run_folder.frames(path):
        trainer = _trainer(cfg, folder)
        trainer.restore(path)
    else:  # the environments have not been reset yet, so there is no state of theirs to return to
        trainer = _trainer(cfg, folder, _pretrained(cfg))
        trainer.metrics_writer.rewind(0)
    for damaged in saved[: saved.index(path)]:
        print(f"{damaged} is damaged: the run goes on from {path.name}, the newest that is intact", flush=True)
        checkpoint.set_aside(damaged)
    return trainer


def _require_same_run(cfg: DictConfig, path: Path) -> None:
    """Check that a checkpoint is of the run with the configuration ``cfg``, which may have become longer since.

    Raises:
        ValueError: If it is not.
    """
    wanted = cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))
    held, wanted = (
        {**config, "training": {**config["training"], "total_frames": None}}
        for config in (checkpoint.saved_config(path), wanted)
    )
    if changed := differences(held, wanted, CONDUCT | PLACES | {"evaluation", "budget"}):
        raise ValueError(
            f"{path} is not of this run: it differs from {CONFIG} in {', '.join(changed)}. Put this run's own "
            "checkpoint back, or remove the file to go on from the one before"
        )


def _trainer(cfg: DictConfig, folder: Path, pretrained: Path | None = None) -> Trainer:
    if cfg.torch_threads:
        torch.set_num_threads(cfg.torch_threads)
    torch.manual_seed(cfg.seed)
    source = make_source(cfg)
    agent = make_agent(cfg, source.env, pretrained)
    return make_trainer(cfg, agent, source, folder)


def _precision_kept(cfg: DictConfig, folder: Path) -> str:
    """Return in which precision a run goes on, and whether it began on another machine."""
    precision = name(choose(cfg.autocast, cfg.device).autocast)
    began = json.loads((folder / PROVENANCE).read_text())["machine"] if (folder / PROVENANCE).is_file() else {}
    now = machine(cfg.device)
    if all(began.get(part) in (None, now[part]) for part in ("processor", "device")):
        return f"goes on with networks in {precision}"
    return (
        f"began on {began['processor']} ({began['device']}) and goes on on {now['processor']} ({now['device']}), with "
        f"networks in {precision} as it began"
    )


def _finish(trainer: Trainer, cfg: DictConfig, folder: Path) -> None:
    """Train to the end and evaluate what came of it."""
    loggers = build.make_loggers(cfg)
    for logger in loggers:
        begin_after(logger, trainer.progress.frames)
    trainer.metrics_writer.loggers = [*loggers, *build.make_recorders(cfg, trainer.actor, folder, loggers)]
    trainer.run()
    if not (folder / CONFIG).is_file():
        raise FileNotFoundError(f"{folder} was removed while the run was at work: what it has learnt is lost")
    if cfg.evaluation.episodes:
        numbers = evaluation(folder, episodes=cfg.evaluation.episodes, seed=cfg.evaluation.seed)
        write_json(numbers, folder / EVALUATION)


def _builtin_alternative(cfg: DictConfig) -> str:
    """Return what else could be given, if networks of the method and the character come with the library."""
    try:
        builtin(cfg.method.name, cfg.character.name)
    except ValueError:
        return ""
    return ", or take the networks that come with the library: pretrained=builtin"


def _pretrained(cfg: DictConfig) -> Path | None:
    """Return the checkpoint file to begin from, or None to begin from nothing."""
    transfers = cfg.stage.name == "transfer"
    if (transfers and not cfg.transfer.keep) or (not transfers and cfg.pretrained is None):
        return None
    if cfg.pretrained is None:
        raise ValueError(
            f"stage=transfer needs the pre-training of method={cfg.method.name}: run it with stage=pretrain first and "
            f"give its run folder as pretrained=<folder>{_builtin_alternative(cfg)}"
        )
    if cfg.pretrained == "builtin":
        return builtin(cfg.method.name, cfg.character.name)
    return checkpoint.find(Path(cfg.pretrained))
