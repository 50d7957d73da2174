"""Checks the names and the values of all settings, before a run writes anything."""

import difflib
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import yaml  # type: ignore[import-untyped]
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.envs.pd_character import CONES
from torchrl_mcp.envs.tasks.imitation import CLIP_ENDS, SWITCHES
from torchrl_mcp.envs.tasks.transport import POSITIONS
from torchrl_mcp.runs.settings import leaves


class Rule(NamedTuple):
    """A rule for the value of a setting.

    Attributes:
        words: Description for error messages.
        allows: Function that returns whether a value is valid.
    """

    words: str
    allows: Callable[[Any], bool]

    def or_null(self) -> "Rule":
        """Return the rule that also allows null."""
        return Rule(f"{self.words}, or null", lambda value: value is None or self.allows(value))


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _is_number(value: Any) -> bool:
    return _is_whole(value) or (isinstance(value, float) and math.isfinite(value))


def _is_list(value: Any, allows: Callable[[Any], bool]) -> bool:
    return isinstance(value, list) and all(allows(item) for item in value)


def _among(*choices: Any) -> Rule:
    words = [str(choice).lower() for choice in choices]
    return Rule(f"{', '.join(words[:-1])} or {words[-1]}", lambda value: any(value is x or value == x for x in choices))


SEEDS = 2**32
"""Number of seeds that all random generators accept."""

COUNT = Rule("a whole number, at least 1", lambda value: _is_whole(value) and value >= 1)
WHOLE = Rule("a whole number, at least 0", lambda value: _is_whole(value) and value >= 0)
SEED = Rule(f"a whole number from 0 to {SEEDS - 1}", lambda value: _is_whole(value) and 0 <= value < SEEDS)
POSITIVE = Rule("a finite number above 0", lambda value: _is_number(value) and value > 0)
NOT_NEGATIVE = Rule("a finite number, at least 0", lambda value: _is_number(value) and value >= 0)
SHARE = Rule("a number from 0 to 1", lambda value: _is_number(value) and 0 <= value <= 1)
DISCOUNT = Rule("a number from 0 to 1, below 1", lambda value: _is_number(value) and 0 <= value < 1)
PROBABILITY = Rule("a number between 0 and 1", lambda value: _is_number(value) and 0 < value < 1)
PERIOD = Rule(
    "a number above 0, or infinity (inf; in files and --task .inf)",
    lambda value: value == math.inf or POSITIVE.allows(value),
)
FLAG = Rule("true or false", lambda value: isinstance(value, bool))
TEXT = Rule("a text", lambda value: isinstance(value, str) and bool(value))
WIDTHS = Rule(
    "a list of one or more whole numbers, each at least 1", lambda value: _is_list(value, COUNT.allows) and bool(value)
)
WEIGHTS = Rule("a list of finite numbers, each at least 0", lambda value: _is_list(value, NOT_NEGATIVE.allows))
NAMES = Rule("a list of names", lambda value: _is_list(value, TEXT.allows))
RANGE = Rule(
    "two finite numbers in order, [low, high]",
    lambda value: _is_list(value, _is_number) and len(value) == 2 and value[0] <= value[1],
)

NUMBER = Rule("a finite number", _is_number)

SPEED = Rule(
    "a finite number above 0, or a range [low, high] from at least 0",
    lambda value: POSITIVE.allows(value) or (RANGE.allows(value) and value[0] >= 0),
)

NAMES_BY_RULE: dict[Rule, str] = {
    COUNT: """
        num_envs frames_per_batch minibatch_size num_epochs total_frames batch_factor lengths.none lengths.mixed
        checkpoint_interval keep_checkpoints max_episode_steps num_workers switch_candidates num_primitives num_options
        latent_dim steps_per_choice explorer.steps
    """,
    COUNT.or_null(): "torch_threads record_interval",
    WHOLE: "num_threads branch_cells warmup_batches evaluation.episodes",
    SEED: "seed",
    POSITIVE: """
        lr min_lr max_lr step_size.actor step_size.max step_size.critic target_kl clip_epsilon advantages.clip
        action_std initial_std std logits_std scale max_error width kept_width std_gain
    """,
    POSITIVE.or_null(): "max_grad_norm physics_timestep learned_logits_std latent_std",
    PERIOD: "switch_interval speed_interval step_size.inputs critic.inputs",
    SPEED: "speed",
    NOT_NEGATIVE: """
        bound_coeff coeff kl_coeff termination_cost weight max_turn
        target_distance_power reset_noise_scale forward_weight healthy_weight control_weight contact_weight
    """,
    DISCOUNT: "gamma",
    PROBABILITY: "terminations.initial",
    SHARE: """
        lmbda discount epsilon momentum initial_states.rest
        initial_states.motions motion_starts
    """,
    FLAG: """
        progress_bar fused entropy_bonus functional contact_forces self_collision learned_std terminate_on_fall
        terminate_when_unhealthy success_reward waypoint parts.blind on_device random_first_length restart_noise
        action_noise snapshots
    """,
    RANGE: """
        healthy_z_range initial_directions near_objects near object_distances
        object_directions target_distances target_directions target_intervals
        evaluation.directions environment.directions directions.pretrain directions.transfer pretrain.directions
        transfer.directions action_bounds
    """,
    RANGE.or_null(): "final_directions",
    NUMBER: "worst solved",
    WIDTHS: "num_cells state_cells goal_cells joint_cells trunk_cells values_cells",
    WEIGHTS.or_null(): "reward_weights",
    NAMES: """
        transfer.freeze transfer.keep pretrain.observation transfer.observation pretrain.goal transfer.goal
        pretrain.info transfer.info pretrain.metrics transfer.metrics
    """,
    TEXT: "device run_dir run_root",
    TEXT.or_null(): "pretrained resume goal_entry",
    _among(True, False, "auto"): "autocast",
    _among(*SWITCHES): "switch_to",
    _among(*CLIP_ENDS): "clip_end",
    _among(*CONES): "friction_cone",
    _among(*POSITIONS): "goal_positions",
}

RULES = {name: rule for rule, names in NAMES_BY_RULE.items() for name in names.split()}
"""Rules by the end of a setting's path. Settings with the same name therefore have the same rule in every group."""

GROUPS = ("task", "stage", "character", "method", "training", "evaluation", "optimizer", "objective", "transfer")
"""Settings that are groups of settings."""

FOLDER = Path(str(files("torchrl_mcp.conf")))
"""Folder of the library's configuration files."""

COMPARED = ("method", "task", "training", "step_size", "evaluation", "transfer")
"""Groups whose settings are compared by name, because they are not arguments of a class."""

HEADER = "# @package _global_"
"""First line of configuration files whose settings are outside the group of the file."""

PARTS = {"transport": "task"}
"""Files of ``conf`` that other files include, and the group of their settings."""

ALIKE = 0.8
"""Similarity to a known name, from 0 to 1, above which an unknown name counts as misspelt."""


def require_valid(config: Mapping[str, Any]) -> None:
    """Check the value of every setting of the library.

    Args:
        config: The resolved configuration of a run.

    Raises:
        ValueError: If values are wrong; the message gives the name, the value and the rule of each.
    """
    not_groups = [name for name in GROUPS if not isinstance(config.get(name), Mapping)]
    wrong = [f"{name}={_shown(config.get(name))} must be a group of settings" for name in not_groups]
    wrong += wrong_values(config)
    if not wrong and (schedule := config["optimizer"].get("schedule")):
        wrong += _step_size_out_of_range(config["step_size"]["actor"], schedule)
    if not wrong:
        folders = ((name, str(config[name])) for name in ("run_dir", "run_root"))
        wrong += [
            f"{name}={path} would create a folder called ~: write {name}={os.path.expanduser(path)}"
            for name, path in folders
            if path.startswith("~")
        ]
    if not wrong and _escapes(str(config["run_dir"]), str(config["run_root"])):
        wrong.append(f"run_dir={config['run_dir']} is outside run_root={config['run_root']}: pass another run_dir")
    if wrong:
        raise ValueError("\n".join(wrong))


def wrong_values(config: Mapping[str, Any]) -> Iterator[str]:
    """Yield an error message for every setting whose value is missing or wrong.

    Args:
        config: Settings, possibly in groups.
    """
    for path, value in leaves(config):
        if value == "???":
            yield f"{path} has no value: pass {path}=..."
        elif (rule := _rule(path)) and not rule.allows(value):
            yield f"{path}={_shown(value)} must be {rule.words}"


def _step_size_out_of_range(actor: float, schedule: Mapping[str, Any]) -> Iterator[str]:
    """Yield an error message if the schedule would clip the actor's step size in the first update."""
    low = schedule.get("min_lr", 0.0)
    high = schedule.get("max_lr", math.inf)
    if not low <= actor <= high:
        yield (
            f"step_size.actor={actor:g} must be from {low:g} (optimizer.schedule.min_lr) to {high:g} (step_size.max), "
            "the range of the schedule: change one of these settings"
        )


def _rule(path: str) -> Rule | None:
    parts = path.split(".")
    return next((RULES[end] for start in range(len(parts)) if (end := ".".join(parts[start:])) in RULES), None)


def _escapes(folder: str, root: str) -> bool:
    """Return whether a path that begins with ``root`` leaves this folder, for example by ``..``."""
    inside = Path(os.path.normpath(folder)).is_relative_to(os.path.normpath(root))
    return folder.startswith(f"{root}/") and not inside


def _shown(value: Any) -> str:
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def require_used(cfg: DictConfig) -> None:
    """Check that no setting of a run is misspelt or in a wrong group.

    Other settings that nothing uses are allowed, because they can label runs.

    Args:
        cfg: The configuration, with unresolved references.

    Raises:
        ValueError: If a setting is misspelt or in a wrong group, or a setting that every run needs is missing; the
            message gives the remedy.
    """
    if missing := [name for name in _content(FOLDER / "train.yaml") if name not in ("defaults", "hydra", *cfg)]:
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


@cache
def known_settings() -> frozenset[str]:
    """Return the top-level settings of the files of ``conf``, and the settings in the groups :data:`COMPARED`."""
    names: set[str] = set()
    for path in FOLDER.rglob("*.yaml"):
        content = _content(path)
        if path.stem in PARTS or not (path.parent == FOLDER or HEADER in path.read_text(encoding="utf-8")):
            content = {PARTS.get(path.stem, path.parent.name): content}
        names |= {*content, *(f"{group}.{key}" for group in COMPARED for key in content.get(group, ()))}
    return frozenset(names)


def _content(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8")) or {}


def _remedy(name: str) -> str | None:
    """Return the remedy for a setting that nothing uses, or None if it is not similar to a known setting."""
    group, _, key = name.rpartition(".")
    if (FOLDER / (group or name)).is_dir() and (not group or key in known_settings()):
        return f"begin the file of {group or name}= with the line '{HEADER}', or omit {name}"
    if key in known_settings() and group:
        return f"write {key}=..."
    similar = difflib.get_close_matches(name, known_settings(), n=1, cutoff=ALIKE)
    return f"write {similar[0]}" if similar else None
