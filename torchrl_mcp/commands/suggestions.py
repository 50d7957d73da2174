"""Answers to command lines that Hydra cannot compose."""

import difflib
import os
import shlex
from collections.abc import Collection, Sequence
from itertools import pairwise

from hydra import compose, initialize_config_module
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs.quoting import setting

EXTRAS = {"joblib": "launchers", "submitit": "launchers", "ray": "ray-launcher", "optuna": "optuna"}
"""Extras of the library with a plugin of Hydra, by the beginning of the plugin's name."""


def answer(error: HydraException, words: Sequence[str], *, several: str | None = "give one") -> str:
    """Return a line for each mistake of a command line, with a remedy.

    Args:
        error: The exception of Hydra.
        words: The command line.
        several: Remedy for a setting with several values, or None if settings may have several values.
    """
    settings = [word for word in words if ("=" in word or word.startswith("~")) and not word.startswith("-")]
    lines = stray(words) or unreadable(settings)
    if several and not lines:
        lines = swept(settings, several)
    if not lines:
        lines = suggestions(settings)
    if not lines and isinstance(error, MissingConfigException):
        lines = [_missing(error)]
    return "\n".join(lines) or "; ".join(line.strip() for line in str(error).splitlines() if line.strip())


def stray(words: Sequence[str]) -> list[str]:
    """Return a line if words are neither settings nor options or values of options."""
    values = {follower for word, follower in pairwise(words) if word.startswith("-") and "=" not in word}
    without_value = [word for word in words if "=" not in word or word == "="]
    strays = [word for word in without_value if not word.startswith(("-", "~")) and word not in values]
    if not strays:
        return []
    return [f"{' '.join(strays)} is not a setting: write NAME=VALUE without spaces, such as method=mcp"]


def unreadable(settings: Sequence[str]) -> list[str]:
    """Return a line for each setting that Hydra cannot read, with quotes if they help."""
    return [_quote(word) for word in settings if "=" in word and not _is_readable(word)]


def swept(settings: Sequence[str], remedy: str) -> list[str]:
    """Return a line with a remedy for each setting with several values."""
    overrides = OverridesParser.create().parse_overrides(list(settings))
    return [
        f"{override.input_line} has several values: {remedy}" for override in overrides if override.is_sweep_override()
    ]


def suggestions(settings: Sequence[str]) -> list[str]:
    """Return a line for each setting with an unknown name, with the nearest names."""
    try:
        overrides = OverridesParser.create().parse_overrides(list(settings))
        with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
            groups = list(compose("train", return_hydra_config=True).hydra.runtime.choices)
            # Methods and presets add settings.
            chosen = [str(o.input_line) for o in overrides if o.key_or_group in groups and not o.is_sweep_override()]
            cfg = compose("train", chosen, return_hydra_config=True)
    except HydraException:
        return []
    known = _keys(OmegaConf.to_container(cfg))
    unknown = [o.key_or_group for o in overrides if o.key_or_group not in {*groups, *known} and not o.is_add()]
    return [
        f"{key!r} is in no file, but is a valid argument: write it with a plus, +{key}=..."
        if _is_argument(key, cfg)
        else f"{key!r} is not a setting of this method" + _nearest(key, {*groups, *known})
        for key in unknown
    ]


def _nearest(key: str, known: Collection[str]) -> str:
    """Return the end of a sentence with the nearest names."""
    near = difflib.get_close_matches(key, known, n=3, cutoff=0.5)
    return f"; the nearest are: {', '.join(near)}" if near else ": torchrl-mcp-train --cfg job prints all"


def _is_readable(word: str) -> bool:
    try:
        OverridesParser.create().parse_overrides([word])
    except HydraException:
        return False
    return True


def _quote(word: str) -> str:
    name, _, value = word.partition("=")
    quoted = setting(name, os.path.expanduser(value))  # no shell expands ~ within a word or quotes
    if quoted == word or not _is_readable(quoted):
        return f"Hydra cannot read {word}"
    return f"Hydra cannot read {word} without quotes: write {shlex.quote(quoted)}"


def _missing(error: MissingConfigException) -> str:
    """Return a line about a choice that its group does not have."""
    group, _, choice = str(error.missing_cfg_file).rpartition("/")
    extra = next((EXTRAS[name] for name in EXTRAS if choice.startswith(name)), None)
    if group in ("hydra/launcher", "hydra/sweeper") and extra:
        return f"{group}={choice} needs a plugin of Hydra: pip install 'torchrl-mcp[{extra}]'"
    options = list(error.options or [])
    near = difflib.get_close_matches(choice, options, n=1, cutoff=0.5)
    question = f"did you mean {near[0]}? " if near else ""
    return f"there is no {group}={choice}: {question}The choices are {', '.join(options)}"


def _is_argument(key: str, cfg: DictConfig) -> bool:
    """Return whether a setting is an argument of its group's class or function."""
    group, _, name = key.rpartition(".")
    target = group and OmegaConf.select(cfg, f"{group}._target_")
    if not target:
        return False
    from torchrl_mcp.runs.arguments import arguments  # takes seconds

    return name in arguments(target)


def _keys(tree: object, prefix: str = "") -> list[str]:
    if not isinstance(tree, dict):
        return []
    return [name for key, value in tree.items() for name in (f"{prefix}{key}", *_keys(value, f"{prefix}{key}."))]
