"""Checks what a run needs besides valid settings: an environment, files, devices, networks, and existing classes."""

import difflib
import inspect
import pkgutil
import sys
from collections.abc import Collection, Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.adapters.contract import Environments
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.runs import places
from torchrl_mcp.runs.builtin import FOLDER
from torchrl_mcp.runs.settings import leaves
from torchrl_mcp.runs.trust import require_trusted, targets

SHARED = {name: name for name in ("seed", "device", "physics", "num_threads")} | {"num_envs": "training.num_envs"}
"""Arguments of environments that come from settings of the run, with the names of these settings."""

EVALUATED = SHARED | {"seed": "evaluation.seed", "num_envs": "evaluation.episodes"}
"""The same arguments for environments that evaluate, which simulate on the CPU."""


SIMULATION = frozenset({"device", "num_threads", "physics", "pin_memory"})
"""Arguments that settings of the run give to simulations, and that environments of other libraries do not take."""


def require_all(cfg: DictConfig) -> None:
    """Check that a run can be executed on this machine, before its folder is created or used.

    Raises:
        ValueError: As the functions below, or if a setting of the environments would have no effect, or transfer lacks
            a pre-training.
    """
    require_environment(cfg)
    require_callable(cast("dict[str, Any]", OmegaConf.to_container(cfg, resolve=True)))
    require_files(cfg, cfg.task[cfg.stage.name])
    require_equipment(cfg)
    for section, given in ((cfg.stage.name, SHARED), ("evaluation", EVALUATED)):
        if unread := [name for name in given if name in (cfg.task.get(section) or ())]:
            raise ValueError(f"task.{section}.{unread[0]} would have no effect: pass {given[unread[0]]} instead")
    if cfg.stage.name == "transfer" and cfg.transfer.keep and cfg.pretrained is None:
        is_builtin = (FOLDER / f"{cfg.method.name}-{cfg.character.name}.torchrl").is_file()
        raise ValueError(
            f"stage=transfer needs the pre-training of method={cfg.method.name}: run it with stage=pretrain first and "
            "give its run folder as pretrained=<folder>"
            + (", or use the networks that come with the library: pretrained=builtin" if is_builtin else "")
            + "; benchmark=table2 runs both stages of several methods"
        )


def require_environment(cfg: DictConfig) -> None:
    """Check that there is an environment for the configured task, stage and character.

    Raises:
        ValueError: If there is no such environment, or a class that the configuration names cannot be imported.
    """
    task = cfg.task.name
    character = cfg.character.name
    if module := cfg.character.get("module"):
        import_own(module, f"character={character} is in the module")
    if cfg.stage.name not in cfg.task:
        raise ValueError(
            f"task={task} has no stage={cfg.stage.name}: pre-train with task=imitation, and transfer to "
            f"task={task} with stage=transfer and pretrained=<folder of the pre-training>, or pretrained=builtin"
        )
    # Import everything that the configuration names: importing a user's motions may register the user's character.
    names = targets(OmegaConf.to_container(cfg.task[cfg.stage.name], resolve=True))
    if "_target_" not in cfg.task[cfg.stage.name]:
        raise ValueError(
            f"task.{cfg.stage.name} of task={task} has no separate settings: give task.pretrain.NAME=VALUE, which "
            "applies to both stages"
        )
    for name in names:
        _resolved(name)
    environment = _resolved(cfg.task[cfg.stage.name]["_target_"])
    characters: tuple[str, ...] = getattr(environment, "characters", tuple)()
    if characters and character not in characters:
        choices = " or ".join(characters)
        raise ValueError(f"no environment has task={task} with character={character}: pass character={choices}")


def require_callable(config: Mapping[str, Any]) -> None:
    """Check that the library's classes and functions take the arguments that a configuration gives them.

    Args:
        config: The configuration, with resolved references.

    Raises:
        ValueError: If an argument is unknown; the message names the most similar arguments.
    """
    settings = list(leaves(config))
    for setting, name in settings:
        group = setting.removesuffix("_target_")
        if group == setting or not str(name).startswith("torchrl_mcp.") or not _exists(name):
            continue
        given = [inner.removeprefix(group).partition(".")[0] for inner, _ in settings if inner.startswith(group)]
        taken = arguments(name)
        unknown = [key for key in given if key not in taken and not key.startswith("_")]
        if unknown and not any(map(_is_open, taken.values())):
            similar = difflib.get_close_matches(unknown[0], taken, cutoff=0.5) or sorted(taken)
            raise ValueError(f"{group}{unknown[0]} is not an argument of {name}: use one of {', '.join(similar)}")


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


def require_known(config: Mapping[str, Any], source: Path) -> None:
    """Check that all classes and functions in a run's configuration exist and may be called.

    Args:
        config: The configuration.
        source: The file of the configuration.

    Raises:
        ValueError: If a class or function is missing or not trusted.
    """
    names = list(targets(config))
    # Importing modules of this library runs no other code, so it is safe before the check of trust.
    if missing := [name for name in names if name.startswith("torchrl_mcp.") and not _exists(name)]:
        raise ValueError(
            f"{source} is from another version of torchrl-mcp: this version lacks {missing[0]}. Use the version that "
            "wrote the file, whose commit is in the run folder's origin.json, or train again"
        )
    require_trusted(config, source)
    if missing := [name for name in names if not _exists(name)]:
        raise ValueError(
            f"{source} names {missing[0]}, which Python does not find: if the module is yours, run the command in the "
            "module's folder, or add this folder to PYTHONPATH"
        )


def require_arguments(name: str, given: Collection[str]) -> None:
    """Check that the class of a task takes arguments.

    Args:
        name: Name of the class. Functions that make environments are not checked.
        given: Names of the arguments.

    Raises:
        ValueError: If an argument is unknown; the message lists the arguments that the task takes.
    """
    if not inspect.isclass(pkgutil.resolve_name(name)):
        return
    taken = arguments(name)
    if unknown := [argument for argument in given if argument not in taken]:
        common = {*inspect.signature(CharacterEnv.__init__).parameters} - {"max_episode_steps"}
        listed = sorted({*taken} - common - {"kwargs", "character"})
        raise ValueError(f"the task has no argument {' and no '.join(unknown)}: use some of {', '.join(listed)}")


def require_entry(env: Environments, name: str) -> slice:
    """Return the range of an entry in an environment's goal.

    Raises:
        ValueError: If the goal has no such entry.
    """
    layout = env.goal_layout
    if name not in layout or len(layout) == 1:
        remedy = f"use one of {', '.join(layout)}" if len(layout) > 1 else "omit it, because the goal has no parts"
        raise ValueError(f"transfer.goal_entry={name} is not an entry of the task's goal: {remedy}")
    return layout[name]


def applicable(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of environments without the arguments for simulations that these environments do not take.

    Args:
        name: Name of the class or function that makes the environments.
        given: The arguments.
    """
    taken = arguments(name)
    if any(map(_is_open, taken.values())):
        return dict(given)
    return {key: value for key, value in given.items() if key in taken or key not in SIMULATION}


def arguments(name: str) -> dict[str, inspect.Parameter]:
    """Return the parameters of a class or function, including parameters that a class passes on to its bases.

    A parameter ``**kwargs`` is among them only if no base refuses unknown arguments.

    Args:
        name: Dotted name of the class or function.
    """
    target = pkgutil.resolve_name(name)
    classes = target.__mro__ if inspect.isclass(target) else ()
    parameters_by_name: dict[str, inspect.Parameter] = {}
    for function in [vars(base)["__init__"] for base in classes if "__init__" in vars(base)] or [target]:
        parameters = inspect.signature(function).parameters
        parameters_by_name = {**parameters, **parameters_by_name}
        if not any(map(_is_open, parameters.values())):
            return {name: parameter for name, parameter in parameters_by_name.items() if not _is_open(parameter)}
    return parameters_by_name


def _is_open(parameter: inspect.Parameter) -> bool:
    return parameter.kind is parameter.VAR_KEYWORD


def import_own(module: str, origin: str) -> None:
    """Import a module of the user, which adds characters to the library.

    Args:
        module: Name of the module.
        origin: Beginning of error messages, which tells where the module is named.

    Raises:
        ValueError: If the module does not exist, is not valid Python, or Python has another module of this name.
    """
    top = module.partition(".")[0]
    try:
        import_module(module)
    except SyntaxError as error:
        raise ValueError(f"{origin} {module}, which is not valid Python: {error}") from error
    except ModuleNotFoundError as error:
        if error.name != top:
            _require_no_conflict(top, f"{origin} {module}")
            raise
        raise ValueError(
            f"{origin} {module}, which Python does not find: run the command in the folder of {module}.py, or add this "
            "folder to PYTHONPATH"
        ) from error
    _require_no_conflict(top, f"{origin} {module}")


def _resolved(name: str) -> Any:
    """Return the class or function with a name in a configuration, which may be defined by the user.

    Raises:
        ValueError: If Python does not find it, or another module has the name of the user's module.
    """
    try:
        return pkgutil.resolve_name(name)
    except (AttributeError, ImportError) as error:
        if (top := name.partition(".")[0]) in sys.modules:
            _require_no_conflict(top, f"the configuration names {name}")
        raise ValueError(
            f"the configuration names {name}, which Python cannot import: {error}. If the module is yours, run the "
            "command in its folder, or add this folder to PYTHONPATH"
        ) from error


def _require_no_conflict(module: str, origin: str) -> None:
    """Check that an imported module is the module of this name in the working directory, and not one of Python's.

    Raises:
        ValueError: If Python has imported another module of this name.
    """
    file = next((path for path in (Path(f"{module}.py"), Path(module, "__init__.py")) if path.exists()), None)
    imported = getattr(sys.modules[module], "__file__", None)
    if file is None and module not in sys.stdlib_module_names:
        return
    if file is None or imported is None or not file.samefile(imported):
        raise ValueError(
            f"{origin}, but Python has another module {module}{f', {imported}' if imported else ''}: rename your module"
        )


def _exists(name: str) -> bool:
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError):
        return False
    return True
