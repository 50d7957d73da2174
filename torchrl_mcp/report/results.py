"""Reads run folders: configuration, progress, evaluation and provenance."""

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from torchrl_mcp.runs.settings import leaves
from torchrl_mcp.runs.trust import read_config
from torchrl_mcp.training.run_folder import (
    CHECKPOINTS,
    CONFIG,
    EVALUATION,
    METRICS,
    MODES,
    NORMALISED_RETURN,
    PROVENANCE,
    UNREADABLE,
    is_run,
    read_json,
    read_metrics,
)

STATES = ("complete", "not evaluated", "unfinished", "damaged")
"""States of a run."""

VALUE_TYPES = {"choices": str, "machine": str | int}
"""Types of the values in the groups of a run's provenance."""

REACH = {"skill", "standing", "ideal"}
"""Entries of an evaluation's ``reach``."""

MOST_FRAMES = 1e15
"""Upper bound on environment steps, which no training reaches."""

REQUIRED = {
    "task.name": str,
    "character.name": str,
    "method.name": str,
    "stage.name": str,
    "seed": int,
    "training.total_frames": int,
}
"""Types of the settings that every configuration must have."""

DEAD = "dead_units/"
"""Prefix of the metrics that give the share of dead units in the worst layer of a network."""

MANY_DEAD = 1 / 3
"""Share of dead units above which a report lists the network."""


@dataclass(frozen=True)
class Damaged:
    """A folder that cannot be read, and the reason."""

    path: Path
    reason: str


@dataclass(frozen=True)
class Run:
    """A run folder whose configuration can be read.

    Attributes:
        path: The folder.
        settings: The resolved configuration, flat: ``{"method.name": "mcp", "training.total_frames": 1500000, ...}``.
        frames: Environment steps taken so far.
        seconds: Wall time of these steps in seconds.
        has_episodes: Whether an episode of full length has ended, so that the run has a learning curve.
        dead_units: Share of dead units in the worst layer of each network after these steps.
        evaluation: Content of ``evaluation.json``, or empty if the run has not been evaluated.
        provenance: Content of ``origin.json``, such as commit, choices and machine, or empty for older runs.
        fault: Description of the damage in the run's files, or None.
    """

    path: Path
    settings: Mapping[str, Any]
    frames: int = 0
    seconds: float = 0.0
    has_episodes: bool = False
    dead_units: Mapping[str, float] = field(default_factory=dict)
    evaluation: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    fault: str | None = None

    @property
    def place(self) -> tuple[str, str]:
        """Names of task and character; environments of another library have their name in place of a character."""
        names = [self.settings.get(f"task.{self.stage}.{key}") for key in ("id", "env._target_")]
        environments = [name for name in names if isinstance(name, str)]
        return self.settings["task.name"], environments[0] if environments else self.settings["character.name"]

    @property
    def method(self) -> str:
        """Name of the method."""
        return self.settings["method.name"]

    @property
    def title(self) -> str:
        """Title of the method."""
        return self.settings.get("method.title", self.method)

    @property
    def standard(self) -> dict[str, Any]:
        """The method's standard settings."""
        return self._below("method.standard.")

    @property
    def stage(self) -> str:
        """``pretrain`` or ``transfer``."""
        return self.settings["stage.name"]

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.settings["seed"]

    @property
    def total_frames(self) -> int:
        """Environment steps of the whole run."""
        return self.settings["training.total_frames"]

    @property
    def preset(self) -> str:
        """Preset of the run: ``demo`` for runs of the demonstration, ``unknown`` if not recorded."""
        is_demo = any(name.startswith("demo.") for name in self.settings)
        return self._choices.get("preset", "demo" if is_demo else "unknown")

    @property
    def commit(self) -> str:
        """Commit of the library at the start of the run, ``unknown`` if not recorded."""
        return self.provenance.get("commit") or "unknown"

    @property
    def _choices(self) -> dict[str, str]:
        """Choices of groups of settings, empty if not recorded."""
        return self.provenance.get("choices") or {}

    @property
    def overrides(self) -> list[str]:
        """Names of the settings on the command line that started the run."""
        words = self.provenance.get("command") or []
        return [word.partition("=")[0].lstrip("+~") for word in words if "=" in word]

    @property
    def curriculum_name(self) -> str | None:
        """Choice of the group ``curriculum``."""
        return self.settings.get("curriculum.name")

    @property
    def symmetry(self) -> str | None:
        """Choice of the group ``symmetry``, None for ``none`` or if not recorded."""
        choice = self._choices.get("symmetry")
        return None if choice == "none" else choice

    @property
    def curriculum(self) -> list[str]:
        """Settings of the environment that differ between transfer and evaluation, as one line or none."""
        if self.stage != "transfer":
            return []
        trained = self._below("task.transfer.")
        evaluated = self._below("task.evaluation.")
        shared = (name for name in trained if name in evaluated or name.startswith("curriculum."))
        different = [f"{name}={trained[name]}" for name in shared if trained[name] not in (None, evaluated.get(name))]
        return [", ".join(different)] if different else []

    def _below(self, prefix: str) -> dict[str, Any]:
        """Return the settings whose names begin with a prefix, by the rest of their names."""
        return {name.removeprefix(prefix): value for name, value in self.settings.items() if name.startswith(prefix)}

    @property
    def progress(self) -> float:
        """Share of the planned steps that the run has taken, at most 1."""
        return min(1.0, self.frames / self.total_frames)

    @property
    def dying(self) -> dict[str, float]:
        """Share of dead units by network, for networks with more than :data:`MANY_DEAD` after training."""
        if self.state == "unfinished":
            return {}
        return {network: share for network, share in self.dead_units.items() if share > MANY_DEAD}

    @property
    def state(self) -> str:
        """One of :data:`STATES`."""
        if self.fault:
            return "damaged"
        if self.frames < self.total_frames:
            return "unfinished"
        return "complete" if self.evaluation else "not evaluated"


def find_runs(paths: Iterable[Path]) -> tuple[list[Run], list[Damaged]]:
    """Read the run folders in ``paths`` at any depth, each only once, ordered by name.

    Raises:
        ValueError: If no path contains a run.
    """
    folders: dict[Path, Path] = {}
    for path in (paths := list(paths)):
        for folder in sorted(_run_folders(path)):
            folders.setdefault(folder.resolve(), folder)
    if not folders:
        empty = " and ".join(f"{path} contains no run" for path in paths)
        raise ValueError(
            f"{empty}: pass run folders, which contain {CONFIG} and {METRICS}, or folders that contain runs"
        )
    outcomes = [read_run(folder) for folder in folders.values()]
    runs = [outcome for outcome in outcomes if isinstance(outcome, Run)]
    return runs, [outcome for outcome in outcomes if isinstance(outcome, Damaged)]


def read_run(folder: Path) -> Run | Damaged:
    """Read a run folder. Errors in its files are part of the result; no exception is raised."""
    try:
        settings = dict(leaves(read_config(folder / CONFIG)))
    except FileNotFoundError:
        return Damaged(folder, f"has no {CONFIG}")
    except (OSError, ValueError) as error:
        return Damaged(folder, f"{CONFIG} cannot be read: {_line(error)}")
    if invalid := [name for name, kind in REQUIRED.items() if not isinstance(settings.get(name), kind)]:
        return Damaged(folder, f"{CONFIG} has no valid {', '.join(invalid)}")
    if (total := settings["training.total_frames"]) < 1:
        return Damaged(folder, f"{CONFIG} has training.total_frames={total}, which must be at least 1")
    contents: dict[str, Any] = {"settings": settings}
    faults = []
    for file, read in ((METRICS, _progress), (EVALUATION, _evaluation), (PROVENANCE, _provenance)):
        try:
            contents |= read(folder)
        except UNREADABLE as error:
            faults.append(f"{file} cannot be read: {_line(error)}")
    return Run(folder, **contents, fault="; ".join(faults) or None)


def _run_folders(path: Path) -> Iterator[Path]:
    """Yield the run folders below a folder, also inside other run folders and behind links, each only once."""
    visited = set()
    for folder, subfolders, names in os.walk(path, followlinks=True):
        if (real := os.path.realpath(folder)) in visited:
            subfolders.clear()
            continue
        visited.add(real)
        if is_run([*names, *subfolders]):
            yield Path(folder)
            subfolders[:] = [name for name in subfolders if name != CHECKPOINTS]
        subfolders[:] = sorted(name for name in subfolders if not name.startswith("."))


def _progress(folder: Path) -> dict[str, Any]:
    rows = read_metrics(folder)
    if not rows:
        return {}
    if not all(0 <= row["frames"] < MOST_FRAMES for row in rows):
        raise ValueError(f"frames must be numbers of steps below {MOST_FRAMES:.0e}")
    if not math.isfinite(rows[-1]["seconds"]):
        raise ValueError("the last row has no seconds")
    return {
        "frames": int(rows[-1]["frames"]),
        "seconds": rows[-1]["seconds"],
        "has_episodes": any(math.isfinite(row[NORMALISED_RETURN]) for row in rows),
        "dead_units": {name.removeprefix(DEAD): x for name, x in rows[-1].items() if name.startswith(DEAD)},
    }


def _evaluation(folder: Path) -> dict[str, Any]:
    if not (folder / EVALUATION).exists():
        return {}
    content = read_json(folder / EVALUATION)
    for name, kind in {"episodes": int, "seed": int, "environment": dict}.items():
        if not isinstance(content.get(name), kind | None):
            raise ValueError(f"{name} is {content[name]!r}")
    for mode in MODES:
        numbers = content[mode]
        for value in (numbers["normalised_return"], *numbers["interval"]):
            if not math.isfinite(value):
                raise ValueError(f"the {mode} normalised return is {value}")
        if wrong := [name for name, value in numbers.items() if not _is_quantity(name, value)]:
            raise ValueError(f"{mode} has values of a wrong type: {', '.join(wrong)}")
        if numbers.get("reach", {}).keys() != REACH:
            numbers.pop("reach", None)  # it is of another version of the library
    return {"evaluation": content}


def _is_quantity(name: str, value: Any) -> bool:
    """Return whether a quantity of an evaluation has a valid type."""
    if name == "interval":
        return isinstance(value, list) and len(value) == 2
    if name in ("metrics", "durations", "diagnostics", "reach"):
        return isinstance(value, dict) and all(isinstance(number, int | float) for number in value.values())
    return isinstance(value, int | float)


def _provenance(folder: Path) -> dict[str, Any]:
    if not (folder / PROVENANCE).exists():
        return {}
    content = read_json(folder / PROVENANCE)
    kinds = {"choices": dict, "machine": dict, "command": list, "commit": str, "precision": str}
    for name, kind in kinds.items():
        if not isinstance(content.get(name), kind | None):
            raise ValueError(f"{name} is {content[name]!r}")
        if kind is list and not all(isinstance(value, str) for value in content.get(name) or []):
            raise ValueError(f"{name} is {content[name]!r}")
        values = (content.get(name) or {}).values() if kind is dict else []
        if not all(isinstance(value, VALUE_TYPES[name]) for value in values):
            raise ValueError(f"{name} is {content[name]!r}")
    return {"provenance": content}


def _line(error: Exception) -> str:
    """Return the first line of an error's message."""
    message = str(error).partition("\n")[0] or type(error).__name__
    return f"the file lacks {message}" if isinstance(error, KeyError) else message
