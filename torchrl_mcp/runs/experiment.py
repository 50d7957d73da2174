"""Runs: training in a run folder, resuming, and evaluation at the end."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs import build, lock, places
from torchrl_mcp.runs.build import make_agent, make_source, make_trainer
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.earlier import require_resumable, translated
from torchrl_mcp.runs.identity import CONDUCT, PLACES, differences
from torchrl_mcp.runs.machine import machine
from torchrl_mcp.runs.policies import evaluation
from torchrl_mcp.runs.provenance import continuation, provenance
from torchrl_mcp.runs.trust import read_config, resuming, trusting
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.metrics import begin_after
from torchrl_mcp.training.precision import choose, name
from torchrl_mcp.training.run_folder import (
    CONFIG,
    EVALUATION,
    PROVENANCE,
    read_json,
    remove_leftovers,
    replacing,
    write_json,
)
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


def resume(
    folder: Path, *, device: str | None = None, total_frames: int | None = None, moves: Mapping[str, str] | None = None
) -> Path:
    """Continue the run in ``folder`` from its newest checkpoint, with its own configuration.

    A run that :func:`is_complete` is not changed. On another machine a run keeps its precision.

    Args:
        folder: The run folder.
        device: Device to go on with, or None for the run's own.
        total_frames: Environment steps of the whole run, more than it has taken, or None for the run's own.
        moves: New places of files and folders outside the run folder, by the names of their settings.

    Raises:
        ValueError: If the folder holds no run, another process uses it, its checkpoint is damaged, it is longer than
            ``total_frames``, or this machine lacks the device, the logger or a file.
    """
    if is_complete(folder) and not total_frames and not moves:
        return folder
    known = places.outside(read_config(folder / CONFIG))
    if unknown := sorted(set(moves or {}) - set(known)):
        raise ValueError(f"{folder} has no files by {' and '.join(unknown)}, only by {list(known)}: leave them out")
    with _held(folder):
        _change(folder, total_frames, moves or {})
        return _resume(folder, device)


def train_or_resume(cfg: DictConfig, *, wait: bool = False) -> Path:
    """Train as configured, or resume the run if it has begun; return the folder.

    Args:
        cfg: The configuration. A resumed run keeps its own, except for the device and the places of files.
        wait: If another process uses the run folder, wait for it.

    Raises:
        ValueError: As :func:`train` and :func:`resume`, or if the folder holds a run with other settings.
    """
    folder = Path(cfg.run_dir)
    _require(cfg)
    with _held(folder, wait=wait), trusting(build.named(cfg)):
        if not (folder / CONFIG).exists():
            return _train(cfg)
        config = build.stored(settled(cfg))
        if changed := changes(folder, config):
            raise ValueError(f"{folder} holds a run that differs in {', '.join(changed)}: give another run_root")
        if is_complete(folder):
            print(f"{folder} is complete: nothing is left to do", flush=True)
        _change(folder, None, {name: place for name, place in places.outside(config).items() if Path(place).exists()})
        return _resume(folder, cfg.device)


def changes(folder: Path, config: Mapping[str, Any]) -> list[str]:
    """Return the settings in which the run in ``folder`` differs from a configuration, so that it is another run.

    Files and folders outside the run folder are compared by their content, if both are known.

    Args:
        folder: The run folder.
        config: The configuration, resolved and :func:`settled`.

    Raises:
        ValueError: If the folder holds no run, or one of another version of the library.
    """
    held = build.stored(run_config(folder))
    inputs = _origin(folder).get("inputs", {})
    other = [name for name, mark in places.digests(config).items() if inputs.get(name, mark) != mark]
    return list(dict.fromkeys([*differences(held, config), *other]))


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
    return OmegaConf.create(places.located(translated(config), folder))


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
    build.require_files(cfg, cfg.task[cfg.stage.name])
    build.require_equipment(cfg)


@contextmanager
def _held(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Lock a run folder for this process, and remove partial files of killed processes."""
    with lock.held(folder, wait=wait):
        remove_leftovers(folder)
        yield


def _train(cfg: DictConfig) -> Path:
    folder = Path(cfg.run_dir)
    _require_free(folder, cfg)
    pretrained, precision = _pretrained(cfg), choose(cfg.autocast, cfg.device)
    print(f"run folder: {folder}{f', {precision}' if precision.autocast else ''}", flush=True)
    cfg = cast("DictConfig", OmegaConf.merge(settled(cfg), {"autocast": precision.autocast}))
    trainer = _trainer(cfg, folder, pretrained)
    trainer.save()
    inputs = places.digests(trainer.config)
    write_json(provenance(cfg.device, *build.launched(), precision, inputs), folder / PROVENANCE)
    # Last, because the presence of this file means that there is a run to resume.
    _write_config(trainer.config, folder)
    _finish(trainer, cfg, folder)
    return folder


def _require_free(folder: Path, cfg: DictConfig) -> None:
    """Check that a folder holds no run yet."""
    if (folder / CONFIG).exists():
        changed = changes(folder, build.stored(settled(cfg)))
        held = f"a run that differs in {', '.join(changed)}: " if changed else ""
        remedy = "" if changed else f"this run already: continue it with {resuming(folder)}, or "
        raise ValueError(f"{folder} holds {held or remedy}give another run_dir")
    if any(run_folder.frames(path) for path in run_folder.find_all(folder)) or run_folder.read_metrics(folder):
        raise ValueError(
            f"{folder} holds metrics or checkpoints of a run whose {CONFIG} is missing: put that back to continue the "
            "run, or give another run_dir"
        )


def _write_config(config: Mapping[str, Any], folder: Path) -> None:
    with replacing(folder / CONFIG) as partial:
        OmegaConf.save(OmegaConf.create(dict(config)), partial)


def _change(folder: Path, total_frames: int | None, moves: Mapping[str, str]) -> None:
    """Change the length of a run, and the places of files outside its folder, in its configuration.

    Raises:
        ValueError: If the run is planned to be longer.
    """
    held = read_config(folder / CONFIG)
    planned = held["training"]["total_frames"]
    if (total := total_frames or planned) < planned:
        raise ValueError(f"training.total_frames={total}: {folder} is planned for {planned} steps; give more, or none")
    known = places.outside(held)
    new = {known[name]: str(Path(place).absolute()) for name, place in moves.items() if name in known}
    config = {**places.moved(held, new), "training": {**held["training"], "total_frames": total}}
    if config != held:
        _write_config(config, folder)
    if total > planned:
        frames = run_folder.frames(checkpoint.find(folder))
        write_json(continuation(_origin(folder), build.launched()[0], planned, total, frames), folder / PROVENANCE)


def _resume(folder: Path, device: str | None = None) -> Path:
    if is_complete(folder):
        return folder
    require_resumable(read_config(folder / CONFIG))
    cfg = run_config(folder)
    cfg.device = device or cfg.device
    build.require_equipment(cfg)
    build.require_files(cfg, cfg.task[cfg.stage.name])
    print(f"{folder} goes on{_elsewhere(cfg, folder)}", flush=True)
    trainer = _restored(cfg, folder)
    (folder / EVALUATION).unlink(missing_ok=True)
    _finish(trainer, cfg, folder)
    return folder


def _origin(folder: Path) -> dict[str, Any]:
    """Return the provenance of the run in a folder, empty for older runs."""
    return read_json(folder / PROVENANCE) if (folder / PROVENANCE).is_file() else {}


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
    held, wanted = (
        {**config, "training": {**config["training"], "total_frames": None}}
        for config in (translated(checkpoint.saved_config(path)), build.stored(cfg))
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


def _elsewhere(cfg: DictConfig, folder: Path) -> str:
    """Return a message if a resumed run began on another machine, empty if it did not."""
    precision = name(choose(cfg.autocast, cfg.device).autocast)
    began, now = _origin(folder).get("machine", {}), machine(cfg.device)
    if all(began.get(part) in (None, now[part]) for part in ("processor", "device")):
        return ""
    return (
        f" on {now['processor']} ({now['device']}), after it began on {began['processor']} ({began['device']}), with "
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
