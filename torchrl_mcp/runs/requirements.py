"""The checks before a run: :func:`require_all` calls all of them, in order."""

import difflib
import re
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
import yaml  # type: ignore[import-untyped]
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs import places
from torchrl_mcp.runs.arguments import arguments, require_callable
from torchrl_mcp.runs.builtin import FOLDER
from torchrl_mcp.runs.imports import require_environment
from torchrl_mcp.runs.settings import leaves
from torchrl_mcp.runs.validation import require_valid, resolved

SHARED = {name: name for name in ("seed", "device", "physics", "num_threads")} | {"num_envs": "training.num_envs"}
"""Arguments of environments that come from settings of the run, with the names of these settings."""

EVALUATED = SHARED | {"seed": "evaluation.seed", "num_envs": "evaluation.episodes"}
"""The same arguments for environments that evaluate, which simulate on the CPU."""

CONF = Path(str(files("torchrl_mcp.conf")))
"""Folder of the library's configuration files."""

COMPARED = ("method", "task", "training", "step_size", "evaluation", "transfer")
"""Groups whose settings are compared by name, because they are not arguments of a class."""

HEADER = "# @package _global_"
"""First line of configuration files whose settings are outside the group of the file."""

PARTS = {"transport": "task"}
"""Files of ``conf`` that other files include, and the group of their settings."""

ALIKE = 0.8
"""Similarity to a known name, from 0 to 1, above which an unknown name counts as misspelt."""


def require_all(cfg: DictConfig) -> None:
    """Check everything that a new run needs, before its folder is created.

    Raises:
        ValueError: As :func:`require_settings` and :func:`require_executable`.
    """
    require_settings(cfg)
    require_executable(cfg)


def require_settings(cfg: DictConfig) -> None:
    """Check the values and the names of all settings of a new run.

    Raises:
        ValueError: As the functions below.
    """
    require_valid(cfg)
    require_used(cfg)
    require_label(cfg)


def require_executable(cfg: DictConfig) -> None:
    """Check that a new or resumed run can be executed on this machine.

    Raises:
        ValueError: As the functions below.
    """
    require_environment(cfg)
    require_callable(resolved(cfg))
    require_effect(cfg)
    require_files(cfg, cfg.task[cfg.stage.name])
    require_equipment(cfg)
    require_pretraining(cfg)


def require_effect(cfg: DictConfig) -> None:
    """Check that no setting of the environments would be replaced by a setting of the run.

    Raises:
        ValueError: If a setting would have no effect; the message names the setting that replaces it.
    """
    for section, given in ((cfg.stage.name, SHARED), ("evaluation", EVALUATED)):
        if unread := [name for name in given if name in (cfg.task.get(section) or ())]:
            raise ValueError(f"task.{section}.{unread[0]} would have no effect: pass {given[unread[0]]} instead")


def require_pretraining(cfg: DictConfig) -> None:
    """Check that a transfer that keeps networks has a pre-training.

    Raises:
        ValueError: If the pre-training is missing.
    """
    if cfg.stage.name == "transfer" and cfg.transfer.keep and cfg.pretrained is None:
        is_builtin = (FOLDER / f"{cfg.method.name}-{cfg.character.name}.torchrl").is_file()
        raise ValueError(
            f"stage=transfer needs the pre-training of method={cfg.method.name}: run it with stage=pretrain first and "
            "give its run folder as pretrained=<folder>"
            + (", or use the networks that come with the library: pretrained=builtin" if is_builtin else "")
            + "; benchmark=table2 runs both stages of several methods"
        )


def require_files(cfg: DictConfig, task: DictConfig) -> None:
    """Check that the files of a task's environments exist.

    Args:
        cfg: Configuration of the run.
        task: Configuration of the environments.

    Raises:
        ValueError: If a file is missing; the message names the settings that give its new place.
    """
    files = places.settings(OmegaConf.to_container(task, resolve=True))
    missing = {value: name for name, value in files if not Path(value).exists()}
    if not missing:
        return
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    names = {value: name for name, value in places.outside(config).items()}
    value, argument = next(iter(missing.items()))
    name = names.get(value, f"task.{cfg.stage.name}.{argument}")
    raise ValueError(
        f"{name}={value} does not exist: restore it, or give its new place: {name}=PATH for a new run, +{name}=PATH "
        f"with resume=, or --task {argument}=PATH for torchrl-mcp-play and torchrl-mcp-evaluate"
    )


def require_equipment(cfg: DictConfig) -> None:
    """Check that this machine has the configured device and logger.

    Raises:
        ValueError: If the device or the package of the logger is missing, or the physics engine cannot simulate the
            task.
    """
    try:
        kind_of_device = torch.device(cfg.device).type
    except RuntimeError as error:
        raise ValueError(f"device={cfg.device} is not a device of torch: pass cpu or cuda") from error
    if kind_of_device == "meta":
        raise ValueError(f"device={cfg.device} holds no numbers: pass cpu or cuda")
    if kind_of_device == "mps":
        raise ValueError(f"device={cfg.device} lacks float64, in which normalisers count: pass cpu or cuda")
    if kind_of_device == "cuda" and not torch.cuda.is_available():
        raise ValueError(
            f"device={cfg.device}: torch {torch.__version__} finds no CUDA device. Pass device=cpu, or install a CUDA "
            "build of torch on a machine with a GPU"
        )
    if cfg.physics.on_device and "physics" not in arguments(cfg.task[cfg.stage.name]["_target_"]):
        raise ValueError(
            f"physics=warp cannot simulate task={cfg.task.name}, which uses another library's physics: pass "
            "physics=mujoco"
        )
    if cfg.physics.on_device and "num_workers" in cfg.collector:
        raise ValueError("physics=warp simulates all environments at once, without workers: pass collector=local")
    kind = cfg.logger.logger_type if cfg.logger else "csv"
    if kind != "csv" and find_spec(kind) is None:
        raise ValueError(f"logger={kind} needs {kind}: pip install 'torchrl-mcp[{kind}]', or choose logger=tensorboard")


def require_used(cfg: DictConfig) -> None:
    """Check that no setting of a run is misspelt or in a wrong group.

    Other settings that nothing uses are allowed, because they can label runs.

    Args:
        cfg: The configuration, with unresolved references.

    Raises:
        ValueError: If a setting is misspelt or in a wrong group, or a setting that every run needs is missing; the
            message gives the remedy.
    """
    if missing := [name for name in _content(CONF / "train.yaml") if name not in ("defaults", "hydra", *cfg)]:
        raise ValueError(f"the setting {missing[0]} is missing: remove ~{missing[0]} from the command line")
    config: Any = OmegaConf.to_container(cfg)
    groups = {group: config[group] for group in COMPARED if isinstance(config[group], Mapping)}
    names = [*config, *(f"{group}.{key}" for group, settings in groups.items() for key in settings)]
    references = [str(value) for _, value in leaves(config) if "${" in str(value)]
    referenced = set(re.findall(r"[\w-]+", " ".join(references))) - known_settings()
    unused = [name for name in names if name not in known_settings() and name.rpartition(".")[2] not in referenced]
    remedies = {name: _remedy(name) for name in unused}
    if lines := [f"nothing uses the setting {name}: {remedy}" for name, remedy in remedies.items() if remedy]:
        raise ValueError("\n".join(lines))


def require_label(cfg: DictConfig) -> None:
    """Check that a run does not give its mixer the name of another mixer of the library, by which reports call it.

    Raises:
        ValueError: If it does, with the choice that changes the mixer.
    """
    path = CONF / "mixer" / f"{cfg.mixer.name}.yaml"
    if path.is_file() and _content(path)["distribution_class"]["path"] != cfg.mixer.distribution_class.path:
        raise ValueError(
            f"mixer.name={cfg.mixer.name} is the name of another mixer than {cfg.mixer.distribution_class.path}: pass "
            f"mixer={cfg.mixer.name} to use that mixer, or give this one another name"
        )


@cache
def known_settings() -> frozenset[str]:
    """Return the top-level settings of the files of ``conf``, and the settings in the groups :data:`COMPARED`."""
    names: set[str] = set()
    for path in CONF.rglob("*.yaml"):
        content = _content(path)
        if path.stem in PARTS or not (path.parent == CONF or HEADER in path.read_text(encoding="utf-8")):
            content = {PARTS.get(path.stem, path.parent.name): content}
        names |= {*content, *(f"{group}.{key}" for group in COMPARED for key in content.get(group, ()))}
    return frozenset(names)


def _content(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8")) or {}


def _remedy(name: str) -> str | None:
    """Return the remedy for a setting that nothing uses, or None if it is not similar to a known setting."""
    group, _, key = name.rpartition(".")
    if (CONF / (group or name)).is_dir() and (not group or key in known_settings()):
        return f"begin the file of {group or name}= with the line '{HEADER}', or omit {name}"
    if key in known_settings() and group:
        return f"write {key}=..."
    similar = difflib.get_close_matches(name, known_settings(), n=1, cutoff=ALIKE)
    return f"write {similar[0]}" if similar else None
