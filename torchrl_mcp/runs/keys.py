"""Names of settings: whether the library, or another setting, uses each."""

import difflib
import re
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]
from omegaconf import DictConfig, OmegaConf

FOLDER = Path(str(files("torchrl_mcp.conf")))

GROUPS = ("method", "task", "training", "step_size", "evaluation", "transfer")
"""Groups whose settings are checked one by one: those that are no arguments of a class and no choice of ``conf``."""

HEADER = re.compile(r"^# @package _global_$", re.MULTILINE)
REFERENCE = re.compile(r"\$\{([\w.]+)")


def require_used(cfg: DictConfig) -> None:
    """Check that every setting of a run is one of the library's, or that another refers to it, and that none is lost.

    Args:
        cfg: The configuration, with its references.

    Raises:
        ValueError: If one is not, with the nearest known settings.
    """
    if lost := [name for name in _content(FOLDER / "train.yaml") if name not in ("defaults", "hydra", *cfg)]:
        raise ValueError(f"the setting {lost[0]} is missing: leave ~{lost[0]} out")
    config: Any = OmegaConf.to_container(cfg)
    names = [*config, *(f"{group}.{key}" for group in GROUPS for key in config[group])]
    used = known() | set(_referenced(config))
    wrong = [name for name in names if name not in used]
    lines = [f"nothing uses the setting {name}: {_remedy(name)}" for name in wrong]
    if lines:
        raise ValueError("\n".join(lines))


@cache
def known() -> frozenset[str]:
    """Return the settings that the files of ``conf`` have at the top, and those in :data:`GROUPS`."""
    names: set[str] = set()
    for path in FOLDER.rglob("*.yaml"):
        content = _content(path)
        if path.stem == "transport":  # a part of two tasks
            content = {"task": content}
        elif path.parent != FOLDER and not HEADER.search(path.read_text(encoding="utf-8")):
            content = {path.parent.name: content}
        names |= {*content, *(f"{group}.{key}" for group in GROUPS for key in content.get(group, ()))}
    return frozenset(names)


def _content(path: Path) -> dict[str, Any]:
    return yaml.safe_load(path.read_text(encoding="utf-8")) or {}


def _referenced(value: Any) -> Iterator[str]:
    """Yield the settings that references in a configuration name, with the groups that they are in."""
    if isinstance(value, Mapping | list):
        for item in value.values() if isinstance(value, Mapping) else value:
            yield from _referenced(item)
    elif isinstance(value, str):
        for name in REFERENCE.findall(value):
            parts = name.split(".")
            yield from (".".join(parts[:end]) for end in range(1, len(parts) + 1))


def _remedy(name: str) -> str:
    group, _, key = name.rpartition(".")
    if key in known() or (FOLDER / name).is_dir():
        return f"begin the file of {group or name}= with the line '# @package _global_', or leave {name} out"
    near = difflib.get_close_matches(name, known(), n=3, cutoff=0.6)
    return f"correct its name{f' ({chr(32).join(near)})' if near else ''}, or leave it out"
