"""Names of settings: whether one that nothing uses is a mistake."""

import difflib
import re
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs.settings import leaves

FOLDER = Path(str(files("torchrl_mcp.conf")))

GROUPS = ("method", "task", "training", "step_size", "evaluation", "transfer")
"""Groups whose settings are compared one by one: those that are no arguments of a class."""

HEADER = "# @package _global_"
PARTS = {"transport": "task"}
"""Files of ``conf`` that others include, and the group of their settings."""

ALIKE = 0.8
"""Similarity to a known name, from 0 to 1, above which an unknown one is taken for a mistake."""


def require_used(cfg: DictConfig) -> None:
    """Check that no setting of a run is a known one misspelt, or in a wrong group.

    Other settings that nothing uses are allowed, as labels of runs.

    Args:
        cfg: The configuration, with its references.

    Raises:
        ValueError: If one is, with its remedy, or a setting that all runs have is missing.
    """
    if lost := [name for name in _content(FOLDER / "train.yaml") if name not in ("defaults", "hydra", *cfg)]:
        raise ValueError(f"the setting {lost[0]} is missing: leave ~{lost[0]} out")
    config: Any = OmegaConf.to_container(cfg)
    groups = {group: config[group] for group in GROUPS if isinstance(config[group], Mapping)}
    names = [*config, *(f"{group}.{key}" for group, settings in groups.items() for key in settings)]
    references = [str(value) for _, value in leaves(config) if "${" in str(value)]
    own = set(re.findall(r"[\w-]+", " ".join(references))) - known()
    unused = [name for name in names if name not in known() and name.rpartition(".")[2] not in own]
    remedies = {name: _remedy(name) for name in unused}
    if lines := [f"nothing uses the setting {name}: {remedy}" for name, remedy in remedies.items() if remedy]:
        raise ValueError("\n".join(lines))


@cache
def known() -> frozenset[str]:
    """Return the settings that the files of ``conf`` have at the top, and those in :data:`GROUPS`."""
    names: set[str] = set()
    for path in FOLDER.rglob("*.yaml"):
        content = _content(path)
        if path.stem in PARTS or not (path.parent == FOLDER or HEADER in path.read_text(encoding="utf-8")):
            content = {PARTS.get(path.stem, path.parent.name): content}
        names |= {*content, *(f"{group}.{key}" for group in GROUPS for key in content.get(group, ()))}
    return frozenset(names)


def _content(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8")) or {}


def _remedy(name: str) -> str | None:
    """Return what to write in place of a setting that nothing uses, None if it resembles no known one."""
    group, _, key = name.rpartition(".")
    if (FOLDER / (group or name)).is_dir() and (not group or key in known()):
        return f"begin the file of {group or name}= with the line '{HEADER}', or leave {name} out"
    if key in known() and group:
        return f"write {key}=..."
    near = difflib.get_close_matches(name, known(), n=1, cutoff=ALIKE)
    return f"write {near[0]}" if near else None
