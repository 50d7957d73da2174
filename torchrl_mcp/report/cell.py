"""Cells of tables of results, which are runs that differ only in their seeds, with their statistics."""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Any, TypeVar

from torchrl_mcp.evaluation.statistics import Estimate, deviation, mean, shared_means
from torchrl_mcp.report.paper import TABLE_2, Reported
from torchrl_mcp.report.results import Run
from torchrl_mcp.runs.settings import leaves

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")

DEFAULT = "default"
"""Value of an argument that a run's configuration does not set."""

SEED = re.compile(r"/seed\d+(?=/|$)|-\d{1,3}(?=\.torchrl$)")
"""The seed in the path of a run folder or in the name of published networks. Checkpoints' steps have more digits."""


@dataclass(frozen=True)
class Cell:
    """Runs whose configurations differ only in the seed.

    Attributes:
        place: Task and character.
        stage: ``pretrain`` or ``transfer``.
        method: Name of the method.
        settings: Settings in which the runs differ from other cells of the same place, stage and method.
        choices: :func:`~torchrl_mcp.report.comparison.choices` of the runs.
        runs: The runs, ordered by seed.
    """

    place: tuple[str, str]
    stage: str
    method: str
    settings: Mapping[str, Any]
    choices: Mapping[str, Any]
    runs: Sequence[Run]

    @cached_property
    def complete(self) -> list[Run]:
        """Runs that are trained and evaluated; means are over these runs."""
        return [run for run in self.runs if run.state == "complete"]

    @cached_property
    def by_seed(self) -> dict[int, list[Run]]:
        """Complete runs by seed. A seed has several runs if the same run was stored more than once."""
        return grouped(self.complete, lambda run: run.seed)

    @property
    def begun(self) -> int:
        """Number of seeds with a run in any state."""
        return len({run.seed for run in self.runs})

    @property
    def title(self) -> str:
        """Title of the method."""
        return self.runs[0].title

    @property
    def steps(self) -> int:
        """Environment steps of a whole run."""
        return self.runs[0].total_frames

    @property
    def variations(self) -> dict[str, Any]:
        """Choices that differ from the method's standard choices, by the names of their settings.

        Unless the method defines another standard, the gate is new and the character's symmetry is not used.
        """
        standard = {"gate": None, "symmetry": None} | self.runs[0].standard
        if self.stage == "pretrain":
            standard.pop("trained", None)  # only transfer has this choice, because pre-training trains all parts
        return {name: self.choices[name] for name, value in standard.items() if self.choices[name] != value}

    @property
    def is_standard(self) -> bool:
        """Whether all choices are the method's standard choices."""
        return not self.variations

    @property
    def is_shared(self) -> bool:
        """Whether several seeds begin with the networks of the same pre-training."""
        origins = {run.settings.get("pretrained") for run in self.complete}
        return len(self.by_seed) > 1 and len(origins) == 1 and origins != {None}

    @property
    def reported(self) -> Reported | None:
        """The number that the paper reports, or None."""
        comparable = self.stage == "transfer" and self.is_standard
        return TABLE_2.get((*self.place, self.method)) if comparable else None

    def returns(self, mode: str = "deterministic") -> list[float]:
        """Normalised return of each seed, the mean over the episodes of its complete runs."""
        return [fmean(run.evaluation[mode]["normalised_return"] for run in runs) for runs in self.by_seed.values()]

    def mean(self, mode: str = "deterministic") -> Estimate | None:
        """Return the mean over seeds with its interval, or None without complete runs.

        For a single seed, the interval is over its episodes.
        """
        returns = self.returns(mode)
        if len(returns) == 1:
            intervals = (run.evaluation[mode]["interval"] for run in self.complete)
            return Estimate(*returns, *map(fmean, zip(*intervals, strict=True)))
        return mean(returns) if returns else None

    @property
    def spread(self) -> str:
        """Name of the mean's interval: ``range`` for two or three seeds, whose bootstrap interval is their range."""
        return "range " if len(self.by_seed) in (2, 3) else ""

    def deviation(self, mode: str = "deterministic") -> float:
        """Standard deviation over seeds, NaN for fewer than two seeds."""
        return deviation(self.returns(mode))

    @property
    def gap(self) -> float | None:
        """Our deterministic mean over seeds minus the paper's mean."""
        ours = self.mean()
        return ours.value - self.reported.mean if ours and self.reported else None

    @property
    def seconds(self) -> float:
        """Mean wall time in seconds of the complete runs, or of all runs if none is complete."""
        runs = self.complete or self.runs
        return sum(run.seconds for run in runs) / len(runs)

    @property
    def speed(self) -> float:
        """Environment steps per second of all runs together, NaN before the first step."""
        seconds = sum(run.seconds for run in self.runs)
        return sum(run.frames for run in self.runs) / seconds if seconds else math.nan

    @property
    def commits(self) -> list[str]:
        """Commits of the runs, without repetitions."""
        return list(dict.fromkeys(run.commit for run in self.runs))

    @property
    def standing(self) -> str:
        """Progress of the runs, for a cell without complete runs."""
        if any(run.state == "unfinished" for run in self.runs):
            return f"{sum(run.progress for run in self.runs) / len(self.runs):.0%} trained"
        return self.runs[0].state

    @property
    def metrics(self) -> dict[str, float]:
        """Means over seeds of the metrics of deterministic episodes, without the terms of the reward."""
        return self.over_seeds(lambda run: run.evaluation["deterministic"].get("metrics", {}), "reward_")

    @property
    def reach(self) -> dict[str, float]:
        """Means over seeds of ``skill``, ``standing`` and ``ideal`` of deterministic episodes; empty for some tasks."""
        return self.over_seeds(lambda run: run.evaluation["deterministic"].get("reach", {}))

    @property
    def success_return(self) -> float | None:
        """Mean over seeds of the deterministic return with the reward 1 while successful; None if a run lacks it."""
        name = "success_return"
        if any(name not in run.evaluation["deterministic"] for run in self.complete):
            return None
        return self.over_seeds(lambda run: {name: run.evaluation["deterministic"][name]}).get(name)

    def over_seeds(self, numbers: Callable[[Run], Mapping[str, float]], *left_out: str) -> dict[str, float]:
        """Return the means over seeds of the numbers that all complete runs have, by name.

        Args:
            numbers: From a run to its numbers by name.
            *left_out: Prefixes of names that are omitted.
        """
        seeds = [shared_means([numbers(run) for run in runs]) for runs in self.by_seed.values()]
        return shared_means(seeds, left_out)

    @property
    def remarks(self) -> list[str]:
        """Remarks on the reliability of the numbers."""
        incomplete = grouped((run for run in self.runs if run.state != "complete"), _standing)
        reevaluated = grouped((run for run in self.complete if _is_evaluated_otherwise(run)), _protocol)
        seeds = [run.seed for run in self.runs]
        remarks = [f"{_seeds(run.seed for run in runs)} {standing}" for standing, runs in incomplete.items()]
        if len(self.by_seed) == 1:
            remarks.append("one seed: the interval is over its episodes")
        if self.is_shared:
            remarks.append("all seeds share one pre-training: the spread does not include that of pre-trainings")
        remarks += [f"seed {seed} occurs more than once" for seed in sorted(set(seeds)) if seeds.count(seed) > 1]
        for protocol, runs in reevaluated.items():
            remarks.append(f"{_seeds(run.seed for run in runs)} evaluated in {protocol}, unlike after training")
        remarks += [f"mixed {difference}" for difference in mixed("evaluations", protocols(self.complete))]
        remarks += [f"mixed {difference}" for difference in mixed("pre-trainings", map(_pretraining, self.runs))]
        curriculum = self.choices["curriculum"]
        return remarks + [f"trained with curriculum={curriculum}: {used}" for used in self.runs[0].curriculum]


def grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    """Return items in groups, by the value of a function."""
    groups: dict[Key, list[Item]] = defaultdict(list)
    for item in items:
        groups[key(item)].append(item)
    return groups


def varying(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the names of settings with more than one value.

    An argument that a configuration leaves out has the value ``default``. A setting counts only if every configuration
    states it, so that a setting of a later version of the library does not tell older runs apart.
    """
    names = dict.fromkeys(name for one in settings for name in one)
    groups = [{parent for name in one for parent in _parents(name)} for one in settings]
    shared = [name for name in names if all(_states(*one, name=name) for one in zip(settings, groups, strict=True))]
    different = {name for name in shared if len({comparable(one.get(name, DEFAULT)) for one in settings}) > 1}
    return [name for name in shared if name in different and different.isdisjoint(_parents(name))]


def comparable(value: Any) -> str:
    """Return a text that equal values of a setting share: 1 and 1.0 have the same text, 1 and true have not."""
    return repr(float(value)) if type(value) in (int, float) else repr(value)


def _states(settings: Mapping[str, Any], groups: Collection[str], *, name: str) -> bool:
    """Return whether a configuration states a setting, also by leaving it out.

    It states a setting with a value or a group in its place, or with a value in place of a group that contains it. By
    leaving it out, it states an argument of a class or function, a setting of a curriculum, and an item of a list.

    Args:
        settings: The values by their names.
        groups: The names of the groups of settings.
        name: Name of the setting.
    """
    parents = _parents(name)
    if name in settings or name in groups or any(parent in settings for parent in parents):
        return True
    within = [parent for parent in parents if parent in groups]
    is_item = any(name[len(parent) + 1].isdigit() for parent in within)
    is_of_curriculum = any(parent.endswith(".curriculum") for parent in within)
    return is_item or is_of_curriculum or (bool(parents) and f"{parents[-1]}._target_" in settings)


def _parents(name: str) -> list[str]:
    """Return the names of the groups that contain a setting, from the outermost to the innermost."""
    parts = name.split(".")
    return [".".join(parts[:number]) for number in range(1, len(parts))]


def protocols(runs: Sequence[Run]) -> list[str]:
    """Return a description of each run's evaluation: its episodes, and settings that differ between the runs."""
    environments = [run.evaluation.get("environment") or {} for run in runs]
    names = varying(environments)
    return [
        f"{run.evaluation.get('episodes', 'unknown')} episodes of seed {run.evaluation.get('seed', 'unknown')}"
        + "".join(f" with {name}={environment[name]}" for name in names)
        for run, environment in zip(runs, environments, strict=True)
    ]


def mixed(name: str, values: Iterable[str]) -> list[str]:
    """Return a line that lists the values if there are several, else no line."""
    distinct = sorted(set(values))
    return [f"{name}: {', '.join(distinct)}"] if len(distinct) > 1 else []


def _protocol(run: Run) -> str:
    """Return a description of a run's evaluation, with the settings of the task that differ from its configuration."""
    return "".join([*protocols([run]), *(f" with {name}={value}" for name, value in _changed(run).items())])


def _changed(run: Run) -> dict[str, Any]:
    """Return the settings of the task in a run's evaluation that differ from its configuration."""
    evaluated = leaves(run.evaluation.get("environment") or {}, "evaluation.environment.")
    changed = {name: value for name, value in evaluated if run.settings.get(name, value) != value}
    return {name.removeprefix("evaluation.environment."): value for name, value in changed.items()}


def _is_evaluated_otherwise(run: Run) -> bool:
    """Return whether a run's evaluation has other episodes or another task than its configuration defines."""
    names = ("episodes", "seed")
    planned = [run.settings.get(f"evaluation.{name}") for name in names]
    played = [run.evaluation.get(name) for name in names]
    return bool(_changed(run)) or (bool(planned[0]) and None not in (*planned, *played) and planned != played)


def _pretraining(run: Run) -> str:
    """Return the origin of a run's initial networks, without the seed of their pre-training."""
    return SEED.sub("", str(run.settings.get("pretrained") or "none"))


def _standing(run: Run) -> str:
    return f"unfinished, {run.progress:.0%} of the steps" if run.state == "unfinished" else run.state


def _seeds(seeds: Iterable[int]) -> str:
    listed = [str(seed) for seed in seeds]
    return f"seed{'s' if len(listed) > 1 else ''} {', '.join(listed)}"
