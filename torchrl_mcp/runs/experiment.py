"""Runs: training in a run folder, resuming, and evaluation at the end."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs import build, lock
from torchrl_mcp.runs.build import make_agent, make_source, make_trainer
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.earlier import require_resumable, translated
from torchrl_mcp.runs.identity import CONDUCT, PLACES, differences
from torchrl_mcp.runs.machine import machine
from torchrl_mcp.runs.policies import evaluation
from torchrl_mcp.runs.provenance import provenance
from torchrl_mcp.runs.trust import read_config, trusting
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.metrics import begin_after
from torchrl_mcp.training.precision import choose, name
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, PROVENANCE, remove_leftovers, replacing, write_json
from torchrl_mcp.training.trainer import Trainer


def train(cfg: DictConfig) -> Path:
    """Train from the start in the run folder ``cfg.run_dir``, evaluate the policy, and return the folder.

    If ``cfg.autocast`` is ``auto``, the folder's configuration holds the precision chosen for this machine.

    Raises:
        ValueError: If the folder holds a run already, another process uses it, there is no environment for the
            configured task and character, or the configuration lacks the checkpoint to transfer from.
    """
    _require(cfg)
    with _held(Path(cfg.run_dir)), trusting(build.named(cfg)):
        return _train(cfg)


def resume(folder: Path, *, device: str | None = None) -> Path:
    """Continue the run in ``folder`` from its newest checkpoint, with its own configuration.

    A run that :func:`is_complete` is not changed. On another machine a run keeps its precision.

    Args:
        folder: The run folder.
        device: Device to go on with, or None for the run's own.

    Raises:
        ValueError: If the folder holds no run, another process uses it, its checkpoint is damaged, or this machine
            lacks the device or the logger.
    """
    if is_complete(folder):
        return folder
    with _held(folder):
        return _resume(folder, device)


def train_or_resume(cfg: DictConfig, *, wait: bool = False) -> Path:
    """Train as configured, or resume the run if it has begun; return the folder.

    Args:
        cfg: The configuration. A resumed run keeps its own, except for the device.
        wait: If another process uses the run folder, wait for it.

    Raises:
        ValueError: As :func:`train` and :func:`resume`.
    """
    folder = Path(cfg.run_dir)
    _require(cfg)
    with _held(folder, wait=wait), trusting(build.named(cfg)):
        return _resume(folder, cfg.device) if (folder / CONFIG).exists() else _train(cfg)


def settled(cfg: DictConfig) -> DictConfig:
    """Return the configuration with the widths of loaded networks: of those that transfer keeps, else of all.

    Raises:
        ValueError: If there is no such pre-training.
    """
    path = _pretrained(cfg) if cfg.pretrained else None
    if path is None:
        return cfg
    saved = checkpoint.saved_config(path)
    width = saved.get("width", 1.0)  # older networks have the paper's
    widths = {"width": width, "kept_width": saved.get("kept_width", width)}
    if cfg.stage.name == "transfer":
        del widths["width"]
    return cast("DictConfig", OmegaConf.merge(cfg, widths))


def run_config(folder: Path) -> DictConfig:
    """Return the configuration of the run in ``folder``.

    Raises:
        ValueError: If the folder holds no run, or one of another version of the library.
    """
    if not (folder / CONFIG).is_file():
        raise ValueError(f"{folder} holds no run: it has no {CONFIG}")
    config = read_config(folder / CONFIG)
    build.require_known(config, folder / CONFIG)
    return OmegaConf.create(translated(config))


def is_complete(folder: Path) -> bool:
    """Return whether the run in ``folder`` has taken all its steps and has been evaluated.

    Raises:
        ValueError: If the folder holds no run.
    """
    cfg = run_config(folder)
    trained = run_folder.frames(checkpoint.find(folder)) >= cfg.training.total_frames
    return trained and (cfg.evaluation.episodes == 0 or (folder / EVALUATION).is_file())


def _require(cfg: DictConfig) -> None:
    """Check a configuration before its folder is made."""
    build.require_valid(cfg)
    build.require_environment(cfg)
    build.require_equipment(cfg)


@contextmanager
def _held(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a run folder for this process, and remove partial files of killed processes."""
    with lock.held(folder, wait=wait):
        remove_leftovers(folder)
        yield


def _train(cfg: DictConfig) -> Path:
    folder = Path(cfg.run_dir)
    if (folder / CONFIG).exists():
        raise ValueError(f"{folder} holds a run already: continue it with resume={folder}, or give another run_dir")
    if any(run_folder.frames(path) for path in run_folder.find_all(folder)) or run_folder.read_metrics(folder):
        raise ValueError(
            f"{folder} holds metrics or checkpoints of a run whose {CONFIG} is missing: put that back to continue the "
            "run, or give another run_dir"
        )
    pretrained, precision = _pretrained(cfg), choose(cfg.autocast, cfg.device)
    print(f"{folder}: {precision}", flush=True)
    cfg = cast("DictConfig", OmegaConf.merge(settled(cfg), {"autocast": precision.autocast}))
    trainer = _trainer(cfg, folder, pretrained)
    trainer.save()
    write_json(provenance(cfg.device, *build.launched(), precision), folder / PROVENANCE)
    # Last, because the presence of this file means that there is a run to resume.
    with replacing(folder / CONFIG) as partial:
        OmegaConf.save(cfg, partial, resolve=True)
    _finish(trainer, cfg, folder)
    return folder


def _resume(folder: Path, device: str | None = None) -> Path:
    if is_complete(folder):
        return folder
    require_resumable(read_config(folder / CONFIG))
    cfg = run_config(folder)
    cfg.device = device or cfg.device
    build.require_equipment(cfg)
    print(f"{folder}: {_precision_kept(cfg, folder)}", flush=True)
    trainer = _restored(cfg, folder)
    (folder / EVALUATION).unlink(missing_ok=True)
    _finish(trainer, cfg, folder)
    return folder


def _restored(cfg: DictConfig, folder: Path) -> Trainer:
    """Return the trainer of a run at its newest intact checkpoint, and print the names of damaged newer ones."""
    saved = run_folder.find_all(folder) or [checkpoint.find(folder)]
    path = next((path for path in saved if checkpoint.is_intact(path)), saved[0])
    _require_same_run(cfg, path)
    if run_folder.frames(path):
        trainer = _trainer(cfg, folder)
        trainer.restore(path)
    else:  # the environments had not been reset yet, so the checkpoint has no state of them
        trainer = _trainer(cfg, folder, _pretrained(cfg))
        trainer.metrics_writer.rewind(0)
    for damaged in saved[: saved.index(path)]:
        print(f"{damaged} is damaged: the run goes on from {path.name}, the newest that is intact", flush=True)
        checkpoint.set_aside(damaged)
    return trainer


def _require_same_run(cfg: DictConfig, path: Path) -> None:
    """Check that a checkpoint belongs to the run with the configuration ``cfg``, whose ``total_frames`` may differ.

    Raises:
        ValueError: If it belongs to another run.
    """
    wanted = cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))
    held, wanted = (
        {**config, "training": {**config["training"], "total_frames": None}}
        for config in (translated(checkpoint.saved_config(path)), wanted)
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
    """Return a message about the precision of a resumed run, and about its first machine if that was another one."""
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
    """Train to the end and evaluate the policy."""
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
    """Return a hint at ``pretrained=builtin``, if the library has networks of the method and the character."""
    try:
        builtin(cfg.method.name, cfg.character.name)
    except ValueError:
        return ""
    return ", or take the networks that come with the library: pretrained=builtin"


def _pretrained(cfg: DictConfig) -> Path | None:
    """Return the checkpoint file of the initial networks, or None for untrained networks."""
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
