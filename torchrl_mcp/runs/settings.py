"""Accesses the settings of a configuration by their dotted names."""

from collections.abc import Iterator, Mapping
from typing import Any


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the dotted name and the value of every setting that is not a group of settings.

    A list of groups is a group, whose items are named by their index. Any other list is a value.

    Args:
        config: A configuration, or a list of configurations.
        prefix: Prefix of the names.

    >>> list(leaves({"seed": 0, "task": {"near": [1, 2], "mixture": [{"weight": 3}]}}))
    [('seed', 0), ('task.near', [1, 2]), ('task.mixture.0.weight', 3)]
    """
    for key, value in items(config):
        if is_group(value):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def replaced(config: Any, values: Mapping[str, Any], prefix: str = "") -> Any:
    """Return a configuration with new values of some settings.

    Args:
        config: A configuration, or a list of configurations.
        values: New values by the dotted names of their settings.
        prefix: Prefix of the names.

    >>> replaced({"seed": 0, "task": {"path": "clips"}}, {"task.path": "walks"})
    {'seed': 0, 'task': {'path': 'walks'}}
    """
    changed = {
        key: replaced(value, values, f"{prefix}{key}.") if is_group(value) else values.get(f"{prefix}{key}", value)
        for key, value in items(config)
    }
    return changed if isinstance(config, Mapping) else list(changed.values())


def is_group(value: Any) -> bool:
    """Return whether a value is a group of settings, or a list of groups."""
    return isinstance(value, Mapping) or (isinstance(value, list) and any(isinstance(item, Mapping) for item in value))


def items(group: Any) -> Iterator[tuple[Any, Any]]:
    """Yield the names, or the indices, and the entries of a group."""
    return iter(group.items() if isinstance(group, Mapping) else enumerate(group))
