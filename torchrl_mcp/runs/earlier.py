"""Configurations that earlier versions of the library wrote."""

from collections.abc import Mapping
from typing import Any

REMOVED = {"failure_weighting": 0.0, "shaping": {}, "state_dependent_std": True}
"""Settings that this version lacks, with the values at which they had no effect."""

AIDS = ("initial_states", "mixture", "emphasis", "staggered", "discount")
"""Settings of environments that are one setting in this version, ``curriculum``."""

ENGINES = {"mujoco": "mujoco_threads", "warp": "mujoco_warp"}
"""Functions of engines by their names, which earlier versions wrote."""

PLACES = ("pretrain", "transfer", "evaluation")
"""Groups of ``task`` that hold settings of environments."""


def translated(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return a run's configuration as this version writes it, to evaluate its policy.

    What only training used and this version lacks is left out.

    Args:
        config: The configuration of a run of this version or an earlier one.
    """
    made = _without(config)
    if isinstance(engine := made.get("physics", "mujoco"), str):
        target = f"torchrl_mcp.envs.physics.engines.{ENGINES[engine]}"
        made["physics"] = {"engine": {"_target_": target, "_partial_": True}, "on_device": engine == "warp"}
    if "task" in made:
        places = {name: _with_curriculum(made["task"][name]) for name in PLACES if name in made["task"]}
        made["task"] = made["task"] | places
    if "environment" in made.get("evaluation", {}):
        made["evaluation"] = made["evaluation"] | {"environment": _with_curriculum(made["evaluation"]["environment"])}
    return made


def require_resumable(config: Mapping[str, Any]) -> None:
    """Check that a run can be trained further, from its configuration before it was translated.

    Raises:
        ValueError: If it was trained with something that this version lacks.
    """
    held = {**config, **config["task"][config["stage"]["name"]]}
    if lost := [name for name, value in REMOVED.items() if held.get(name, value) != value]:
        raise ValueError(
            f"the run is trained with {lost[0]}={held[lost[0]]}, which this version lacks: resume it with the version "
            "that wrote it, whose commit is in the run folder's origin.json"
        )


def _without(value: Any) -> Any:
    """Return a copy of a configuration without the removed settings."""
    if isinstance(value, Mapping):
        return {key: _without(inner) for key, inner in value.items() if key not in REMOVED}
    return [_without(item) for item in value] if isinstance(value, list) else value


def _with_curriculum(place: Any) -> Any:
    """Return settings of environments with ``curriculum`` in place of the settings of earlier versions."""
    if not isinstance(place, Mapping) or not any(name in place for name in AIDS):
        return place
    rest = {name: value for name, value in place.items() if name not in AIDS}
    return {**rest, "curriculum": _curriculum(**{name: place[name] for name in AIDS if name in place})}


def _curriculum(
    initial_states: Any = "rest",
    mixture: Any = (),
    emphasis: Any = None,
    staggered: bool = False,
    discount: float = 0.99,
) -> dict[str, Any] | None:
    """Return a curriculum from an earlier version's settings, or None if training was like the task itself."""
    from_rest = initial_states == "rest" or (initial_states != "motions" and not initial_states.get("motions"))
    if from_rest and not mixture and not emphasis and not staggered:
        return None
    weights = None if emphasis is None else emphasis["weights"]
    power = {} if emphasis is None else {"target_distance_power": emphasis["target_distance_power"]}
    made = {"initial_states": initial_states, "mixture": mixture, "reward_weights": weights, **power}
    return {**made, "random_first_length": staggered, "discount": discount}
