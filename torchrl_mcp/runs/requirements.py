"""The checks before a run: :func:`require_all` calls all of them, in order."""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs import places
from torchrl_mcp.runs.arguments import arguments, require_callable
from torchrl_mcp.runs.builtin import FOLDER
from torchrl_mcp.runs.imports import require_environment
from torchrl_mcp.runs.names import require_used
from torchrl_mcp.runs.validation import require_valid, resolved

SHARED = {name: name for name in ("seed", "device", "physics", "num_threads")} | {"num_envs": "training.num_envs"}
"""Arguments of environments that come from settings of the run, with the names of these settings."""

EVALUATED = SHARED | {"seed": "evaluation.seed", "num_envs": "evaluation.episodes"}
"""The same arguments for environments that evaluate, which simulate on the CPU."""


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
