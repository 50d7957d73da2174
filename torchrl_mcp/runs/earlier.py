"""Configurations that earlier versions of the library wrote."""

from collections.abc import Mapping
from typing import Any

REMOVED = {"failure_weighting": 0.0, "shaping": {}}
"""Settings of environments that this version lacks, with the values at which they had no effect."""


def translated(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's configuration as this version writes it, to evaluate its policy.

    What only training used and this version lacks is left out.

    Args:
        config: The configuration of a run of this version or an earlier one.
    """
    return {key: _translated(value) for key, value in config.items() if key not in REMOVED}


def require_resumable(config: Mapping[str, Any]) -> None:
    """Check that a run can be trained further, from its configuration before it was translated.

    Raises:
        ValueError: If it was trained with something that this version lacks.
    """
    stage = config["task"][config["stage"]["name"]]
    if lost := [name for name, value in REMOVED.items() if stage.get(name, value) != value]:
        raise ValueError(
            f"the run is trained with {lost[0]}={stage[lost[0]]}, which this version lacks: resume it with the version "
            "that wrote it, whose commit is in the run folder's origin.json"
        )


def _translated(value: Any) -> Any:
    if isinstance(value, Mapping):
        return translated(value)
    return [_translated(item) for item in value] if isinstance(value, list) else value
