"""Checks the arguments that a configuration gives to classes and functions, and reads the types of these arguments."""

import difflib
import inspect
import pkgutil
from collections.abc import Mapping
from typing import Any

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.runs.schema import OTHER_LIBRARIES
from torchrl_mcp.runs.settings import leaves
from torchrl_mcp.values import has_rules, types_of

SIMULATION = frozenset({"device", "num_threads", "physics", "pin_memory"})
"""Arguments that settings of the run give to simulations, and that environments of other libraries do not take."""


def arguments(name: str) -> dict[str, inspect.Parameter]:
    """Return the parameters of a class or function, including parameters that a class passes on to its bases.

    A parameter ``**kwargs`` is among them only if no base refuses unknown arguments.

    Args:
        name: Dotted name of the class or function.
    """
    signatures = [_parameters(called) for called in _called(name)]
    parameters = {name: parameter for signature in reversed(signatures) for name, parameter in signature.items()}
    if is_open(signatures[-1]):
        return parameters
    return {name: parameter for name, parameter in parameters.items() if not _is_keywords(parameter)}


def argument_types(name: str) -> dict[str, Any]:
    """Return the types of the parameters of a class or function whose values have rules, by name.

    A class that passes a parameter on to a base without a rule of its own has the rule of the base.

    Args:
        name: Dotted name of the class or function. A name that Python does not find has no types.
    """
    if not exists(name):
        return {}
    types: dict[str, Any] = {}
    for called in reversed(_called(name)):
        declared = types_of(OTHER_LIBRARIES.get(called, _function(called)))
        parameters = _parameters(called)
        for argument, annotation in declared.items():
            # Not every library annotates `flag: bool = None` as optional.
            is_optional = argument in parameters and parameters[argument].default is None
            if has_rules(annotation):
                types[argument] = annotation | None if is_optional else annotation
    return types


def _called(name: str) -> list[Any]:
    """Return a function, or a class and the bases whose constructors receive arguments of the class, in order."""
    target = pkgutil.resolve_name(name)
    if not inspect.isclass(target):
        return [target]
    constructed: list[Any] = []
    for base in target.__mro__:
        if "__init__" in vars(base):
            constructed.append(base)
            if not is_open(_parameters(base)):
                break
    return constructed


def _function(called: Any) -> Any:
    return vars(called)["__init__"] if inspect.isclass(called) else called


def _parameters(called: Any) -> Mapping[str, inspect.Parameter]:
    try:
        return inspect.signature(_function(called)).parameters
    except ValueError:  # functions in C have no signature
        return {}


def is_open(parameters: Mapping[str, inspect.Parameter]) -> bool:
    """Return whether parameters include ``**kwargs``."""
    return any(map(_is_keywords, parameters.values()))


def _is_keywords(parameter: inspect.Parameter) -> bool:
    return parameter.kind is parameter.VAR_KEYWORD


def require_callable(config: Mapping[str, Any]) -> None:
    """Check that classes and functions of the library, and environments derived from its own, take their arguments.

    Args:
        config: The configuration, with resolved references.

    Raises:
        ValueError: If an argument is unknown; the message names the most similar arguments.
    """
    settings = list(leaves(config))
    for setting, value in settings:
        name = str(value)
        group = setting.removesuffix("_target_")
        if group == setting or not exists(name) or not (name.startswith("torchrl_mcp.") or _is_environment(name)):
            continue
        given = [inner.removeprefix(group).partition(".")[0] for inner, _ in settings if inner.startswith(group)]
        taken = arguments(name)
        unknown = [key for key in given if key not in taken and not key.startswith("_")]
        if unknown and not is_open(taken):
            similar = difflib.get_close_matches(unknown[0], taken, cutoff=0.5) or sorted(taken)
            raise ValueError(f"{group}{unknown[0]} is not an argument of {name}: use one of {', '.join(similar)}")


def _is_environment(name: str) -> bool:
    target = pkgutil.resolve_name(name)
    return inspect.isclass(target) and issubclass(target, CharacterEnv)


def require_arguments(name: str, given: Mapping[str, Any]) -> None:
    """Check that the class of a task takes arguments.

    Args:
        name: Name of the class. Functions that make environments are not checked.
        given: The arguments by name.

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


def applicable(name: str, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of environments without the arguments for simulations that these environments do not take.

    Args:
        name: Name of the class or function that makes the environments.
        given: The arguments.
    """
    taken = arguments(name)
    if is_open(taken):
        return dict(given)
    return {key: value for key, value in given.items() if key in taken or key not in SIMULATION}


def exists(name: str) -> bool:
    """Return whether Python finds a class or function."""
    try:
        pkgutil.resolve_name(name)
    except (ImportError, AttributeError, SyntaxError, ValueError):
        return False
    return True
