"""Checks the names of settings: whether the library, or another setting, uses them."""

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
"""Folder of the library's configuration files."""

COMPARED = ("method", "task", "training", "step_size", "evaluation", "transfer")
"""Groups whose settings are compared by name, because they are not arguments of a class."""

HEADER = "# @package _global_"
"""First line of configuration files whose settings are outside the group of the file."""

PARTS = {"transport": "task"}
"""Files of ``conf`` that other files include, and the group of their settings."""

ALIKE = 0.8
"""Similarity to a known name, from 0 to 1, above which an unknown name counts as misspelt."""


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
