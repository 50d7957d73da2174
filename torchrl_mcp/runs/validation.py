"""Checks the values of all settings, before a run writes anything."""

import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import InterpolationKeyError, OmegaConfBaseException

from torchrl_mcp.runs.arguments import argument_types
from torchrl_mcp.runs.schema import Evaluation, RunSettings, Task
from torchrl_mcp.runs.settings import is_group, items, leaves
from torchrl_mcp.values import GROUP, Rule, is_group_type, rule_of, shown, type_of_entry, types_of

TABLE = "method.paper."
"""Prefix of the settings that ``preset=paper`` reads, which not every method has for every character."""


def require_valid(cfg: DictConfig) -> None:
    """Check the value of every setting of the library.

    Args:
        cfg: The configuration of a run.

    Raises:
        ValueError: If values are wrong; the message gives the name, the value and the rule of each.
    """
    config = resolved(cfg)
    types = types_of_settings(config)
    wrong = [f"{name}=null must be {GROUP}" for name in types if is_group_type(types[name]) and name not in config]
    errors = list(wrong_values(config, types))
    # A setting that refers to a wrong setting has the same wrong value, which is named once.
    references = [name for name, value in leaves(OmegaConf.to_container(cfg)) if "${" in str(value)]
    referring = re.compile(rf"({'|'.join(map(re.escape, references))})[.= ]")
    wrong += [line for line in errors if not referring.match(line)] or errors
    if not wrong and (schedule := config["optimizer"].get("schedule")):
        wrong += _step_size_out_of_range(config["step_size"]["actor"], schedule)
    if not wrong:
        wrong += _uneven_batch(config["training"], config.get("batch_factor", 1))
        wrong += _short_batch(config["training"], config.get("batch_factor", 1), config["actor"])
        wrong += _wrong_folders(str(config["run_dir"]), str(config["run_root"]))
    if wrong:
        raise ValueError("\n".join(wrong))


def resolved(cfg: DictConfig) -> dict[str, Any]:
    """Return a configuration with resolved references.

    Raises:
        ValueError: If a reference between settings cannot be resolved.
    """
    try:
        return cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True))
    except InterpolationKeyError as error:
        missing = str(error).partition("'")[2].partition("'")[0]
        setting = error.full_key or "a setting"
        remedy = f"pass {setting}=..., or choose another group" if missing.startswith(TABLE) else "choose another group"
        raise ValueError(f"{setting} refers to {missing}, which the chosen groups lack: {remedy}") from error
    except OmegaConfBaseException as error:
        if "HydraConfig" in str(error):
            raise ValueError(
                "run_dir has a default only in torchrl-mcp-train, which names it after settings: pass run_dir=FOLDER"
            ) from error
        raise ValueError(f"the settings contradict each other: {str(error).partition(chr(10))[0]}") from error


def require_values(task: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    """Check the values of arguments that replace arguments of a task's environments.

    Args:
        task: Configuration of the environments.
        given: The arguments by name; a mapping replaces arguments of an object that the task builds.

    Raises:
        ValueError: If values are wrong; the message gives the name, the value and the rule of each.
    """
    types = argument_types(task["_target_"])
    for name in given:
        if isinstance(given[name], Mapping) and isinstance(task.get(name), Mapping) and "_target_" in task[name]:
            types[name] = argument_types(task[name]["_target_"])
    if wrong := list(wrong_values(given, types)):
        raise ValueError("\n".join(wrong))


def types_of_settings(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return the types of a run's settings by name, with the arguments of its environments.

    Args:
        config: The resolved configuration of the run.
    """
    environment = argument_types(_environment(config))
    stages = dict.fromkeys(("pretrain", "transfer", "evaluation"), environment)
    return {
        **types_of(RunSettings),
        "task": {**types_of(Task), **stages},
        "evaluation": {**types_of(Evaluation), "environment": environment},
    }


def _environment(config: Mapping[str, Any]) -> str:
    """Return the name of the class of a run's environments; without environments for the stage, of the other stage."""
    stage = config["stage"].get("name") if isinstance(config.get("stage"), Mapping) else None
    task = config["task"] if isinstance(config.get("task"), Mapping) else {}
    groups = [task.get(name) for name in (stage, "pretrain", "transfer")]
    return next((str(group["_target_"]) for group in groups if isinstance(group, Mapping) and "_target_" in group), "")


def wrong_values(settings: Any, types: Any) -> Iterator[str]:
    """Yield an error message for every setting whose value is missing or wrong.

    Args:
        settings: A group of settings.
        types: Type of the group, as in :func:`~torchrl_mcp.values.type_of_entry`.
    """
    for name, value, rule in with_rules(settings, types):
        if value == "???":
            yield f"{name} has no value: pass {name}=..."
        elif rule and not rule.allows(value):
            yield f"{name}={shown(value)} must be {rule.words}"


def with_rules(settings: Any, types: Any, prefix: str = "") -> Iterator[tuple[str, Any, Rule | None]]:
    """Yield the name, the value and the rule of every setting; the rule is None for values that are not checked.

    The signature of the class or function of a group has the rules of the group's settings. The settings of other
    groups have the rules of the type of the group.

    Args:
        settings: A group of settings, or a list of groups.
        types: Type of the group, as in :func:`~torchrl_mcp.values.type_of_entry`.
        prefix: Prefix of the names of the settings.
    """
    for key, value in items(settings):
        name = f"{prefix}{key}"
        annotation = type_of_entry(types, key)
        rule = rule_of(annotation)
        if isinstance(value, Mapping) and "_target_" in value:
            yield from with_rules(value, _types_of_target(value), f"{name}.")
        elif is_group(value) and (rule is None or rule.allows(value)):
            yield from with_rules(value, annotation, f"{name}.")
        else:
            yield name, value, rule


def _types_of_target(group: Mapping[str, Any]) -> dict[str, Any]:
    """Return the types of the arguments in a group with ``_target_``."""
    values = [value for name, value in group.items() if name not in ("_target_", "_partial_")]
    # An object without values, such as the recorder of a run without recordings, is not worth its import.
    return {} if all(value is None for value in values) else argument_types(str(group["_target_"]))


def _step_size_out_of_range(actor: float, schedule: Mapping[str, Any]) -> Iterator[str]:
    """Yield an error message if the schedule would clip the actor's step size in the first update."""
    low = schedule.get("min_lr", 0.0)
    high = schedule.get("max_lr", math.inf)
    if not low <= actor <= high:
        yield (
            f"step_size.actor={actor:g} must be from {low:g} (optimizer.schedule.min_lr) to {high:g} (step_size.max), "
            "the range of the schedule: change one of these settings"
        )


def _uneven_batch(training: Mapping[str, Any], factor: int) -> Iterator[str]:
    """Yield an error message if a batch cannot be divided evenly among environments or into minibatches.

    Args:
        training: The settings ``training``.
        factor: Factor on ``training.frames_per_batch``, the setting ``batch_factor`` of methods that have it.
    """
    frames = training["frames_per_batch"]
    num_envs = training["num_envs"]
    minibatch_size = training["minibatch_size"]
    batch = frames * factor
    if batch % num_envs or batch % minibatch_size:
        product = "" if factor == 1 else f" times batch_factor={factor}"
        yield (
            f"training.frames_per_batch={frames}{product} must be a multiple of training.num_envs={num_envs} and of "
            f"training.minibatch_size={minibatch_size}"
        )


def _short_batch(training: Mapping[str, Any], factor: int, actor: Mapping[str, Any]) -> Iterator[str]:
    """Yield an error message if a batch may contain no choice of an actor that chooses every few steps.

    Args:
        training: The settings ``training``.
        factor: Factor on ``training.frames_per_batch``.
        actor: The settings of the actor.
    """
    steps = training["frames_per_batch"] * factor // training["num_envs"]
    steps_per_choice = actor.get("steps_per_choice", 1)
    if steps < steps_per_choice:
        yield (
            f"steps_per_choice={steps_per_choice} must be at most {steps}, the steps of an environment in a batch: "
            "lower training.num_envs, or raise training.frames_per_batch"
        )


def _wrong_folders(run_dir: str, run_root: str) -> Iterator[str]:
    """Yield an error message for every folder that would be created in a wrong place."""
    home = [(name, path) for name, path in (("run_dir", run_dir), ("run_root", run_root)) if path.startswith("~")]
    for name, path in home:
        yield f"{name}={path} would create a folder called ~: write {name}={os.path.expanduser(path)}"
    if not home and _escapes(run_dir, run_root):
        yield f"run_dir={run_dir} is outside run_root={run_root}: pass another run_dir"


def _escapes(folder: str, root: str) -> bool:
    """Return whether a path that begins with ``root`` leaves this folder, for example by ``..``."""
    inside = Path(os.path.normpath(folder)).is_relative_to(os.path.normpath(root))
    return folder.startswith(f"{root}/") and not inside
