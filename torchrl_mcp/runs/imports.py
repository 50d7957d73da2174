"""Imports the modules, classes and functions that a configuration names, and checks that they exist."""

import pkgutil
import sys
import warnings
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.runs.arguments import exists
from torchrl_mcp.runs.trust import require_trusted, targets


def require_environment(cfg: DictConfig) -> None:
    """Check that there is an environment for the configured task, stage and character.

    Raises:
        ValueError: If there is no such environment, or a class that the configuration names cannot be imported.
    """
    task = cfg.task.name
    character = cfg.character.name
    if module := cfg.character.get("module"):
        import_own(module, f"character={character} is in the module")
        if (body := CHARACTERS.get(character)) and (faults := body.check()):
            warnings.warn(
                f"character={character} breaks rules of characters, so that the simulation may be wrong: "
                f"{'; '.join(map(str, faults))}",
                stacklevel=2,
            )
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
    if missing := [name for name in names if name.startswith("torchrl_mcp.") and not exists(name)]:
        raise ValueError(
            f"{source} is from another version of torchrl-mcp: this version lacks {missing[0]}. Use the version that "
            "wrote the file, whose commit is in the run folder's origin.json, or train again"
        )
    require_trusted(config, source)
    if missing := [name for name in names if not exists(name)]:
        raise ValueError(
            f"{source} names {missing[0]}, which Python does not find: if the module is yours, run the command in the "
            "module's folder, or add this folder to PYTHONPATH"
        )


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
