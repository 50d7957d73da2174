"""Runs from beginning to end: check, plan, lock the folder, build, record, train, evaluate."""

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.adapters.check import require_specs
from torchrl_mcp.evaluation.rollout import episode_statistics, evaluate
from torchrl_mcp.runs import build, lock, places, records
from torchrl_mcp.runs.configuration import Plan, planned
from torchrl_mcp.runs.policies import evaluation
from torchrl_mcp.runs.records import is_complete
from torchrl_mcp.runs.requirements import require_all, require_executable
from torchrl_mcp.runs.trust import read_config, targets, trusting
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.precision import choose
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, write_json
from torchrl_mcp.training.trainer import Trainer


def train(cfg: DictConfig) -> Path:
    """Train from the start in the run folder ``cfg.run_dir``, evaluate the policy, and return the folder.

    If ``cfg.autocast`` is ``auto``, the configuration in the folder has the precision chosen for this machine.

    Raises:
        ValueError: If the folder already holds a run, another process uses the folder, no environment has the
            configured task and character, or the configuration lacks the pre-training that transfer needs.
    """
    require_all(cfg)
    plan = planned(cfg)
    with lock.hold(plan.folder), trusting(targets(plan.config)):
        return _train(plan)


def resume(
    folder: Path | str,
    *,
    device: str | None = None,
    total_frames: int | None = None,
    moves: Mapping[str, str] | None = None,
) -> Path:
    """Continue the run in ``folder`` from its newest checkpoint, with the configuration in the folder.

    A run that :func:`~torchrl_mcp.runs.records.is_complete` stays as it is. On another machine, a run keeps its
    precision.

    Args:
        folder: The run folder.
        device: Device with which the run continues, or None for the run's previous device.
        total_frames: Environment steps of the whole run, at least as many as it has taken, or None for the planned
            number.
        moves: New places of files and folders outside the run folder, by the names of their settings.

    Raises:
        ValueError: If the folder is not a run folder, another process uses the folder, the checkpoint is damaged,
            ``total_frames`` is not a number of steps or less than the run has taken, ``moves`` names a setting without
            a file, or this machine lacks the device, the logger or a file. The run is unchanged in all these cases.
    """
    folder = Path(folder)
    if is_complete(folder) and total_frames is None and not moves:
        return folder
    files = places.outside(read_config(folder / CONFIG))
    if unknown := sorted(set(moves or {}) - set(files)):
        raise ValueError(
            f"{' and '.join(unknown)} must be settings of {folder} that name a file or folder, which are {list(files)}"
        )
    with lock.hold(folder):
        return _resume(folder, device, total_frames, moves or {})


def train_or_resume(cfg: DictConfig, *, wait: bool = False) -> Path:
    """Train as configured, or resume the run if it has begun, and return the folder.

    Args:
        cfg: The configuration. A resumed run takes only the device and the places of files from it.
        wait: Whether to wait while another process uses the run folder.

    Raises:
        ValueError: As :func:`train` and :func:`resume`, or if the folder holds a run with other settings.
    """
    # Lock the folder first, so that torchrl-mcp-status shows the run as running from the beginning.
    with lock.hold(Path(cfg.run_dir), wait=wait):
        require_all(cfg)
        plan = planned(cfg)
        with trusting(targets(plan.config)):
            return _train_or_resume(plan, cfg.device)


def _train_or_resume(plan: Plan, device: str) -> Path:
    folder = plan.folder
    if not (folder / CONFIG).exists():
        return _train(plan)
    if changed := records.changes(folder, plan.config):
        raise ValueError(f"{folder} holds a run that differs in {', '.join(changed)}: give another run_root")
    moves = {name: place for name, place in places.outside(plan.config).items() if Path(place).exists()}
    return _resume(folder, device, None, moves)


def _train(plan: Plan) -> Path:
    records.require_free(plan.folder, plan.config)
    precision = choose(plan.cfg.autocast, plan.cfg.device)
    print(f"run folder: {plan.folder}{f', {precision}' if precision.autocast else ''}", flush=True)
    cfg = cast("DictConfig", OmegaConf.merge(plan.cfg, {"autocast": precision.autocast}))
    trainer = build.make_run(cfg, plan.folder, plan.initial)
    _rehearse(trainer, cfg)
    trainer.save()
    records.begin(plan.folder, trainer.folder.config, precision)
    return _finish(trainer, cfg, plan.folder)


def _rehearse(trainer: Trainer, cfg: DictConfig) -> None:
    """Take one step of the final evaluation before training, so that an error in it is noticed before the training.

    Raises:
        ValueError: As :func:`~torchrl_mcp.adapters.check.require_specs`.
    """
    if not cfg.evaluation.episodes:
        return
    env = build.make_env(cfg, num_envs=1, seed=cfg.evaluation.seed, **cfg.evaluation.environment)
    require_specs(env)
    device = trainer.agent.device
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        outcome = evaluate(trainer.agent.actor.policy, env, max_steps=1, device=device)
    episode_statistics(outcome, env.normalised_return)
    env.close()


def _resume(folder: Path, device: str | None, total_frames: int | None, moves: Mapping[str, str]) -> Path:
    """Continue a run, and change its record only after its state has been restored."""
    config = records.replanned(folder, total_frames, moves)
    cfg = records.located(config, folder)
    if is_complete(folder) and is_complete(folder, cfg):
        print(f"{folder} is complete: nothing remains to be done", flush=True)
        records.store(folder, config)
        return folder
    records.require_same_inputs(folder, config)
    cfg.device = device or cfg.device
    require_executable(cfg)
    print(f"{folder} continues{records.elsewhere(folder, cfg)}", flush=True)
    trainer = _restored(cfg, folder)
    records.store(folder, config)
    (folder / EVALUATION).unlink(missing_ok=True)
    return _finish(trainer, cfg, folder)


def _restored(cfg: DictConfig, folder: Path) -> Trainer:
    """Return the trainer of a run at its newest intact checkpoint, and print the names of damaged newer ones."""
    saved = run_folder.find_all(folder) or [checkpoint.find(folder)]
    path = next((path for path in saved if checkpoint.is_intact(path)), saved[0])
    records.require_same_run(cfg, path)
    trainer = build.make_run(cfg, folder)
    trainer.restore(path)
    if run_folder.frames(path) and not trainer.source.resumes_episodes:
        print("the run begins new episodes, because checkpoints lack the state of its environments", flush=True)
    for damaged in saved[: saved.index(path)]:
        print(f"{damaged} is damaged: the run continues from {path.name}, the newest intact checkpoint", flush=True)
        checkpoint.set_aside(damaged)
    return trainer


def _finish(trainer: Trainer, cfg: DictConfig, folder: Path) -> Path:
    """Train to the end, evaluate the policy, and return the folder."""
    trainer.folder.metrics.loggers = build.make_loggers(cfg, trainer, folder)
    trainer.run()
    if not (folder / CONFIG).is_file():
        raise FileNotFoundError(f"{folder} was removed during the run, and its results with it")
    if cfg.evaluation.episodes:
        numbers = evaluation(folder, episodes=cfg.evaluation.episodes, seed=cfg.evaluation.seed)
        write_json(numbers, folder / EVALUATION)
    return folder
