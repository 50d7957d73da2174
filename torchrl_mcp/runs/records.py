"""Reads and writes the record of a run, its configuration and its provenance, and compares it with other runs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs import places
from torchrl_mcp.runs.identity import SAME_RUN, differences
from torchrl_mcp.runs.imports import require_known
from torchrl_mcp.runs.provenance import continuation, machine, provenance
from torchrl_mcp.runs.schema import RunSettings
from torchrl_mcp.runs.trust import read_config, resuming
from torchrl_mcp.runs.validation import wrong_values
from torchrl_mcp.training import checkpoint, run_folder
from torchrl_mcp.training.precision import Precision, choose, name
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, PROVENANCE, read_json, replacing, write_json
from torchrl_mcp.values import types_of


def run_config(folder: Path) -> DictConfig:
    """Return the configuration of the run in ``folder``.

    Raises:
        ValueError: If the folder is not a run folder, or a run of another version of the library.
    """
    return located(_stored_config(folder), folder)


def located(config: Mapping[str, Any], folder: Path) -> DictConfig:
    """Return the configuration of the run in ``folder`` from its stored form, which :func:`replanned` returns.

    Raises:
        ValueError: If the run is of another version of the library.
    """
    require_known(config, folder / CONFIG)
    return OmegaConf.create(places.located(config, folder))


def is_complete(folder: Path, cfg: DictConfig | None = None) -> bool:
    """Return whether the run in ``folder`` has taken all its steps and has been evaluated.

    Args:
        folder: The run folder.
        cfg: Configuration of the run, or None to read it from the folder.

    Raises:
        ValueError: If the folder is not a run folder.
    """
    cfg = cfg or run_config(folder)
    trained = run_folder.frames(checkpoint.find(folder)) >= cfg.training.total_frames
    return trained and (cfg.evaluation.episodes == 0 or _is_evaluated(folder))


def changes(folder: Path, config: Mapping[str, Any]) -> list[str]:
    """Return the settings which make the run in ``folder`` a different run from the run of a configuration.

    Files and folders outside the run folder are compared by their content, if the content of both is known.

    Args:
        folder: The run folder.
        config: The configuration of a :class:`.configuration.Plan`.

    Raises:
        ValueError: If the folder is not a run folder, or a run of another version of the library.
    """
    stored = places.stored(run_config(folder))
    inputs = _origin(folder).get("inputs", {})
    changed_files = [name for name, mark in places.digests(config).items() if inputs.get(name, mark) != mark]
    return list(dict.fromkeys([*differences(stored, config), *changed_files]))


def require_free(folder: Path, config: Mapping[str, Any]) -> None:
    """Check that a folder contains no run yet.

    Args:
        folder: The run folder.
        config: The configuration of the run that will use the folder.

    Raises:
        ValueError: If the folder holds a run; the message names the settings in which the two runs differ.
    """
    if (folder / CONFIG).exists():
        if not run_folder.find_all(folder):
            raise ValueError(f"{folder} holds a run without checkpoints: give another run_dir, or remove the folder")
        if changed := changes(folder, config):
            raise ValueError(f"{folder} holds a run that differs in {', '.join(changed)}: give another run_dir")
        raise ValueError(
            f"{folder} already holds this run: continue it with {resuming(folder)}, or give another run_dir"
        )
    if any(run_folder.frames(path) for path in run_folder.find_all(folder)) or run_folder.read_metrics(folder):
        raise ValueError(
            f"{folder} holds metrics or checkpoints of a run whose {CONFIG} is missing: restore {CONFIG} to continue "
            "the run, or give another run_dir"
        )


def require_same_inputs(folder: Path, config: Mapping[str, Any]) -> None:
    """Check that the files that a run reads again, such as motions or a character, have not changed since it began.

    Pre-trained networks may change, because the checkpoints of the run contain them.

    Args:
        folder: The run folder.
        config: The run's configuration.

    Raises:
        ValueError: If a file has changed.
    """
    recorded = _origin(folder).get("inputs", {})
    for setting, mark in places.digests(config).items():
        if setting.rpartition(".")[2] != places.PRETRAINED and recorded.get(setting, mark) != mark:
            value = config["character"]["name"] if setting == "character" else places.outside(config)[setting]
            raise ValueError(
                f"the content of {setting}={value} has changed since {folder} began: restore the content, or start a "
                "new run"
            )


def begin(folder: Path, config: Mapping[str, Any], precision: Precision) -> None:
    """Write the record of a new run, after its first checkpoint.

    Args:
        folder: The run folder.
        config: The configuration in its stored form.
        precision: Precision of the networks, and the reason for it.
    """
    write_json(provenance(config["device"], precision, places.digests(config)), folder / PROVENANCE)
    # This file is written last, because its presence means that the run can be resumed.
    _write_config(config, folder)


def replanned(folder: Path, total_frames: int | None, moves: Mapping[str, str]) -> dict[str, Any]:
    """Return the stored configuration of a run, with a new length and new places of files outside its folder.

    Args:
        folder: The run folder.
        total_frames: Environment steps of the whole run, or None for the planned number.
        moves: New places, by the names of their settings; names that the run lacks are ignored.

    Raises:
        ValueError: If the folder is not a run folder, or ``total_frames`` is not a number of steps, or is less than the
            run has taken.
    """
    config = _stored_config(folder)
    planned = config["training"]["total_frames"]
    total = planned if total_frames is None else total_frames
    if wrong := list(wrong_values({"training": {"total_frames": total}}, types_of(RunSettings))):
        raise ValueError(wrong[0])
    if total != planned and total < (taken := run_folder.frames(checkpoint.find(folder))):
        raise ValueError(f"training.total_frames={total} must be at least {taken}, the steps that {folder} has taken")
    files = places.outside(config)
    new_places = {files[name]: str(Path(place).absolute()) for name, place in moves.items() if name in files}
    return {**places.moved(config, new_places), "training": {**config["training"], "total_frames": total}}


def store(folder: Path, config: Mapping[str, Any]) -> None:
    """Store a configuration from :func:`replanned` in a run folder, and add a change of length to the provenance."""
    stored = _stored_config(folder)
    planned = stored["training"]["total_frames"]
    total = config["training"]["total_frames"]
    if config != stored:
        _write_config(config, folder)
    if total != planned:
        frames = run_folder.frames(checkpoint.find(folder))
        write_json(continuation(_origin(folder), planned, total, frames), folder / PROVENANCE)


def require_same_run(cfg: DictConfig, path: Path) -> None:
    """Check that a checkpoint belongs to the run with the configuration ``cfg``, whose ``total_frames`` may differ.

    Raises:
        ValueError: If the checkpoint belongs to another run.
    """
    saved = _without_length(checkpoint.saved_config(path))
    wanted = _without_length(places.stored(cfg))
    if changed := differences(saved, wanted, SAME_RUN | {"pretrained", "evaluation", "budget"}):
        raise ValueError(
            f"{path} belongs to another run: it differs from {CONFIG} in {', '.join(changed)}. Restore the checkpoint "
            "of this run, or remove the file to continue from the previous checkpoint"
        )


def _without_length(config: Mapping[str, Any]) -> dict[str, Any]:
    return {**config, "training": {**config["training"], "total_frames": None}}


def elsewhere(folder: Path, cfg: DictConfig) -> str:
    """Return a message if a run continues on another machine, or an empty text if it continues on the same one."""
    precision = name(choose(cfg.autocast, cfg.device).autocast)
    first = _origin(folder).get("machine", {})
    current = machine(cfg.device)
    if all(first.get(part) in (None, current[part]) for part in ("processor", "device")):
        return ""
    return (
        f" on {current['processor']} ({current['device']}), after it began on {first['processor']} "
        f"({first['device']}), with networks in {precision} as before"
    )


def _stored_config(folder: Path) -> dict[str, Any]:
    """Return the configuration in a run folder in its stored form.

    Raises:
        ValueError: If the folder is not a run folder, or the configuration is damaged.
    """
    if not (folder / CONFIG).is_file():
        raise ValueError(f"{folder} is not a run folder: it has no {CONFIG}")
    config = read_config(folder / CONFIG)
    if missing := [name for name in ("task", "stage", "training") if name not in config]:
        raise ValueError(
            f"{folder / CONFIG} is damaged, because it lacks {', '.join(missing)}: restore the file from a copy, or "
            "give another run_dir"
        )
    return config


def _is_evaluated(folder: Path) -> bool:
    """Return whether a run folder has a readable evaluation; an unreadable one is repeated."""
    try:
        return bool(read_json(folder / EVALUATION))
    except (OSError, ValueError):
        return False


def _origin(folder: Path) -> dict[str, Any]:
    """Return the provenance of the run in a folder, which is empty for older runs."""
    return read_json(folder / PROVENANCE) if (folder / PROVENANCE).is_file() else {}


def _write_config(config: Mapping[str, Any], folder: Path) -> None:
    with replacing(folder / CONFIG) as partial:
        OmegaConf.save(OmegaConf.create(dict(config)), partial)
