"""The record of a run in its folder: its configuration and its origin, and whether another run is the same."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs import places
from torchrl_mcp.runs.identity import SAME_RUN, differences
from torchrl_mcp.runs.provenance import continuation, machine, provenance
from torchrl_mcp.runs.requirements import require_known
from torchrl_mcp.runs.trust import read_config, resuming
from torchrl_mcp.runs.validation import wrong_values
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.precision import Precision, choose, name
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, PROVENANCE, read_json, replacing, write_json


def run_config(folder: Path) -> DictConfig:
    """Return the configuration of the run in ``folder``.

    Raises:
        ValueError: If the folder holds no run, or one of another version of the library.
    """
    return located(_held(folder), folder)


def located(config: Mapping[str, Any], folder: Path) -> DictConfig:
    """Return the configuration of the run in ``folder`` from a stored one, as :func:`replanned` returns.

    Raises:
        ValueError: If it is of another version of the library.
    """
    require_known(config, folder / CONFIG)
    return OmegaConf.create(places.located(config, folder))


def is_complete(folder: Path, cfg: DictConfig | None = None) -> bool:
    """Return whether the run in ``folder`` has taken all its steps and has been evaluated.

    Args:
        folder: The run folder.
        cfg: Its configuration, or None to read it.

    Raises:
        ValueError: If the folder holds no run.
    """
    cfg = cfg or run_config(folder)
    trained = run_folder.frames(checkpoint.find(folder)) >= cfg.training.total_frames
    return trained and (cfg.evaluation.episodes == 0 or _is_evaluated(folder))


def changes(folder: Path, config: Mapping[str, Any]) -> list[str]:
    """Return the settings in which the run in ``folder`` differs from a configuration, so that it is another run.

    Files and folders outside the run folder are compared by their content, if both are known.

    Args:
        folder: The run folder.
        config: The configuration of a :class:`.configuration.Plan`.

    Raises:
        ValueError: If the folder holds no run, or one of another version of the library.
    """
    stored = places.stored(run_config(folder))
    inputs = _origin(folder).get("inputs", {})
    other = [name for name, mark in places.digests(config).items() if inputs.get(name, mark) != mark]
    return list(dict.fromkeys([*differences(stored, config), *other]))


def require_free(folder: Path, config: Mapping[str, Any]) -> None:
    """Check that a folder holds no run yet.

    Args:
        folder: The run folder.
        config: The configuration that is to run there.

    Raises:
        ValueError: If it holds one, with the settings in which that differs.
    """
    if (folder / CONFIG).exists():
        if not run_folder.find_all(folder):
            raise ValueError(f"{folder} holds a run without checkpoints: give another run_dir, or remove the folder")
        changed = changes(folder, config)
        other = f"a run that differs in {', '.join(changed)}: " if changed else ""
        remedy = "" if changed else f"this run already: continue it with {resuming(folder)}, or "
        raise ValueError(f"{folder} holds {other or remedy}give another run_dir")
    if any(run_folder.frames(path) for path in run_folder.find_all(folder)) or run_folder.read_metrics(folder):
        raise ValueError(
            f"{folder} holds metrics or checkpoints of a run whose {CONFIG} is missing: put that back to continue the "
            "run, or give another run_dir"
        )


def require_same_character(folder: Path, config: Mapping[str, Any]) -> None:
    """Check that a character of one's own is the one with which a run began.

    Args:
        folder: The run folder.
        config: The run's configuration.

    Raises:
        ValueError: If its file was changed.
    """
    now, began = (marks.get("character") for marks in (places.digests(config), _origin(folder).get("inputs", {})))
    if None not in (now, began) and now != began:
        name = config["character"]["name"]
        raise ValueError(
            f"the file of character={name} was changed since {folder} began: put the file back, or start a new run"
        )


def begin(folder: Path, config: Mapping[str, Any], precision: Precision) -> None:
    """Write the record of a new run, after its first checkpoint.

    Args:
        folder: The run folder.
        config: The configuration as it is stored.
        precision: Precision of the networks, and the reason for it.
    """
    write_json(provenance(config["device"], precision, places.digests(config)), folder / PROVENANCE)
    # Last, because the presence of this file means that there is a run to resume.
    _write_config(config, folder)


def replanned(folder: Path, total_frames: int | None, moves: Mapping[str, str]) -> dict[str, Any]:
    """Return the stored configuration of a run with another length, and other places of files outside its folder.

    Args:
        folder: The run folder.
        total_frames: Environment steps of the whole run, or None for as many as planned.
        moves: New places, by the names of their settings; names that the run lacks are ignored.

    Raises:
        ValueError: If the folder holds no run, or another length is no number of steps or less than the run has taken.
    """
    config = _held(folder)
    planned = config["training"]["total_frames"]
    total = planned if total_frames is None else total_frames
    if wrong := list(wrong_values({"training": {"total_frames": total}})):
        raise ValueError(wrong[0])
    if total != planned and total < (taken := run_folder.frames(checkpoint.find(folder))):
        raise ValueError(f"training.total_frames={total}: {folder} has taken {taken} steps; give as many or more")
    known = places.outside(config)
    new = {known[name]: str(Path(place).absolute()) for name, place in moves.items() if name in known}
    return {**places.moved(config, new), "training": {**config["training"], "total_frames": total}}


def store(folder: Path, config: Mapping[str, Any]) -> None:
    """Store a configuration of a run as :func:`replanned`, and its provenance."""
    stored = _held(folder)
    planned, total = (one["training"]["total_frames"] for one in (stored, config))
    if config != stored:
        _write_config(config, folder)
    if total != planned:
        frames = run_folder.frames(checkpoint.find(folder))
        write_json(continuation(_origin(folder), planned, total, frames), folder / PROVENANCE)


def require_same_run(cfg: DictConfig, path: Path) -> None:
    """Check that a checkpoint belongs to the run with the configuration ``cfg``, whose ``total_frames`` may differ.

    Raises:
        ValueError: If it belongs to another run.
    """
    saved, wanted = (
        {**config, "training": {**config["training"], "total_frames": None}}
        for config in (checkpoint.saved_config(path), places.stored(cfg))
    )
    if changed := differences(saved, wanted, SAME_RUN | {"pretrained", "evaluation", "budget"}):
        raise ValueError(
            f"{path} is not of this run: it differs from {CONFIG} in {', '.join(changed)}. Put this run's own "
            "checkpoint back, or remove the file to go on from the one before"
        )


def elsewhere(folder: Path, cfg: DictConfig) -> str:
    """Return a message if a run that is to be resumed began on another machine, empty if it did not."""
    precision = name(choose(cfg.autocast, cfg.device).autocast)
    began = _origin(folder).get("machine", {})
    now = machine(cfg.device)
    if all(began.get(part) in (None, now[part]) for part in ("processor", "device")):
        return ""
    return (
        f" on {now['processor']} ({now['device']}), after it began on {began['processor']} ({began['device']}), with "
        f"networks in {precision} as it began"
    )


def _held(folder: Path) -> dict[str, Any]:
    """Return the configuration in a run folder as it is stored."""
    if not (folder / CONFIG).is_file():
        raise ValueError(f"{folder} holds no run: it has no {CONFIG}")
    config = read_config(folder / CONFIG)
    if missing := [name for name in ("task", "stage", "training") if name not in config]:
        raise ValueError(
            f"{folder / CONFIG} is damaged, because it lacks {', '.join(missing)}: put it back from a copy, or give "
            "another run_dir"
        )
    return config


def _is_evaluated(folder: Path) -> bool:
    """Return whether a run folder has an evaluation that can be read; another is made anew."""
    try:
        return bool(read_json(folder / EVALUATION))
    except (OSError, ValueError):
        return False


def _origin(folder: Path) -> dict[str, Any]:
    """Return the provenance of the run in a folder, empty for older runs."""
    return read_json(folder / PROVENANCE) if (folder / PROVENANCE).is_file() else {}


def _write_config(config: Mapping[str, Any], folder: Path) -> None:
    with replacing(folder / CONFIG) as partial:
        OmegaConf.save(OmegaConf.create(dict(config)), partial)
