"""Comparison of runs: groups of seeds to average, their differences, and the paper's numbers."""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from statistics import fmean
from typing import Any, TypeVar

from torchrl_mcp.evaluation.statistics import Estimate, deviation, mean, shared_means
from torchrl_mcp.report.paper import METHODS, PLACES, TABLE_2, Reported
from torchrl_mcp.report.results import Run
from torchrl_mcp.runs.identity import PRETRAINING, UNLEARNT, is_among

Key = TypeVar("Key", bound=Hashable)
Item = TypeVar("Item")

DEFAULT = "default"
"""Value of an argument that a run's configuration does not set."""

SEED = re.compile(r"/seed\d+(?=/|$)|-\d{1,3}(?=\.torchrl$)")
"""The seed in the path of a run folder, or in the name of published networks; a checkpoint's steps have more digits."""


@dataclass(frozen=True)
class Cell:
    """Runs that differ only in their seeds, according to their configurations.

    Attributes:
        place: Task and character.
        stage: ``pretrain`` or ``transfer``.
        method: Name of the method.
        settings: Settings that differ from other cells of the same place, stage and method.
        choices: :func:`choices` of the runs.
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
        """Runs that are trained and evaluated; means leave out the others."""
        return [run for run in self.runs if run.state == "complete"]

    @cached_property
    def by_seed(self) -> dict[int, list[Run]]:
        """Complete runs by seed: several if benchmarks that share a folder stored the same run."""
        return _grouped(self.complete, lambda run: run.seed)

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
    def is_standard(self) -> bool:
        """Whether the settings are the method's standard ones, so that the cell is no variant.

        Unless the method says otherwise, a new gate is standard, and no use of the character's symmetry.
        """
        standard = {"gate": None, "symmetry": None} | self.runs[0].standard
        if self.stage == "pretrain":
            standard.pop("trained", None)  # a choice of transfer: pre-training trains all parts
        return all(self.choices[name] == value for name, value in standard.items())

    @property
    def reported(self) -> Reported | None:
        """The paper's figure, if it has one."""
        comparable = self.stage == "transfer" and self.is_standard
        return TABLE_2.get((*self.place, self.method)) if comparable else None

    def returns(self, mode: str = "deterministic") -> list[float]:
        """Normalised returns by seed, each a mean over the episodes of its complete runs."""
        return [fmean(run.evaluation[mode]["normalised_return"] for run in runs) for runs in self.by_seed.values()]

    def mean(self, mode: str = "deterministic") -> Estimate | None:
        """Mean over seeds with its interval; for a single seed, the interval is over its episodes."""
        returns = self.returns(mode)
        if len(returns) == 1:
            intervals = (run.evaluation[mode]["interval"] for run in self.complete)
            return Estimate(*returns, *map(fmean, zip(*intervals, strict=True)))
        return mean(returns) if returns else None

    @property
    def spread(self) -> str:
        """Name of the mean's interval: a bootstrap of two or three seeds is their range."""
        return "range " if len(self.by_seed) in (2, 3) else ""

    def deviation(self, mode: str = "deterministic") -> float:
        """Standard deviation over seeds, NaN of fewer than two."""
        return deviation(self.returns(mode))

    @property
    def gap(self) -> float | None:
        """Our deterministic mean over seeds less the paper's."""
        ours = self.mean()
        return ours.value - self.reported.mean if ours and self.reported else None

    @property
    def seconds(self) -> float:
        """Mean wall time of the complete runs, or of all runs if none is complete."""
        runs = self.complete or self.runs
        return sum(run.seconds for run in runs) / len(runs)

    @property
    def speed(self) -> float:
        """Environment steps per second of all runs together, NaN before the first."""
        seconds = sum(run.seconds for run in self.runs)
        return sum(run.frames for run in self.runs) / seconds if seconds else math.nan

    @property
    def commits(self) -> list[str]:
        """Commits of the runs."""
        return list(dict.fromkeys(run.commit for run in self.runs))

    @property
    def standing(self) -> str:
        """Progress of the runs, for a cell without a complete one."""
        if any(run.state == "unfinished" for run in self.runs):
            return f"{sum(run.progress for run in self.runs) / len(self.runs):.0%} trained"
        return self.runs[0].state

    @property
    def metrics(self) -> dict[str, float]:
        """Means over seeds of the metrics of deterministic episodes, without the terms of the reward."""
        return shared_means([run.evaluation["deterministic"].get("metrics", {}) for run in self.complete], "reward_")

    @property
    def reach(self) -> dict[str, float]:
        """Means over seeds of ``place``, ``standing`` and ``ideal`` of deterministic episodes, if the task has them."""
        return shared_means([run.evaluation["deterministic"].get("reach", {}) for run in self.complete])

    @property
    def remarks(self) -> list[str]:
        """Remarks on the reliability of the numbers."""
        standings = _grouped((run for run in self.runs if run.state != "complete"), _standing)
        seeds = [run.seed for run in self.runs]
        return [
            *(f"{_seeds(run.seed for run in runs)} {standing}" for standing, runs in standings.items()),
            *(["one seed: the interval is over its episodes"] if len(self.by_seed) == 1 else []),
            *(f"seed {seed} occurs more than once" for seed in sorted(set(seeds)) if seeds.count(seed) > 1),
            *(f"mixed {found}" for found in _mixed("evaluations", _protocols(self.complete))),
            *(f"mixed {found}" for found in _mixed("pre-trainings", map(_pretraining, self.runs))),
            *(f"trained with curriculum={self.choices['curriculum']}: {used}" for used in self.runs[0].curriculum),
        ]


@dataclass(frozen=True)
class Ablation:
    """Cells of one method that differ in one setting.

    Attributes:
        setting: Name of the setting.
        cells: The cells, ordered by the value of the setting.
    """

    setting: str
    cells: Sequence[Cell]


def choices(run: Run) -> dict[str, Any]:
    """Return settings that the paper or the command line names, and the method's standard settings.

    Settings that a method lacks are None.
    """
    settings = run.settings
    kept = settings.get("transfer.keep", ()) if run.stage == "transfer" else ()
    trained = "gate" if "primitives" in settings.get("transfer.freeze", ()) else "gate and primitives"
    named = {
        "preset": run.preset,
        "total_frames": run.total_frames,
        "num_primitives": settings.get("num_primitives"),
        "num_options": settings.get("num_options"),
        "latent_dim": settings.get("latent_dim"),
        "trained": trained if "primitives" in kept else None,
        "gate": "kept" if "gating" in kept else None,
        "mixer": settings.get("mixer.name"),
        "exploration": settings.get("exploration.name") if _explores(run) else None,
        "curriculum": run.curriculum_name if run.stage == "transfer" else None,
        "symmetry": run.symmetry,
        "pretrained": "builtin" if settings.get("pretrained") == "builtin" else None,
        "budget.pretrain": settings.get("budget.pretrain") if kept else None,
    }
    return named | {name: settings.get(name) for name in run.standard if name not in named}


def cells(runs: Iterable[Run]) -> list[Cell]:
    """Group runs into cells, in the paper's order of tasks, stages and methods.

    Runs of one task, character, stage and method share a cell unless their :func:`choices` differ, or any other
    setting that :mod:`~torchrl_mcp.runs.identity` counts. Runs of different commits may share a cell.
    """
    found = []
    for alike in _grouped(runs, lambda run: (run.place, run.stage, run.method)).values():
        telling = _varying([choices(run) for run in alike])
        for chosen in _grouped(alike, lambda run: _frozen(choices(run))).values():
            found += _cells(chosen, telling)
    return sorted(found, key=_order)


def methods(cells: Iterable[Cell]) -> dict[str, str]:
    """Return the titles of methods by name: first in the order of Table 2, then alphabetically."""
    return {cell.method: cell.title for cell in sorted(cells, key=lambda cell: _rank(cell.method, METHODS))}


def ablations(cells: Iterable[Cell], setting: str) -> list[Ablation]:
    """Return the groups of cells that differ only in one of the :func:`choices`."""

    def rest(cell: Cell) -> Hashable:
        others = _frozen({k: v for k, v in {**cell.choices, **cell.settings}.items() if k != setting})
        return cell.place, cell.stage, cell.method, others

    groups = _grouped((cell for cell in cells if cell.choices[setting] is not None), rest).values()
    return [
        Ablation(setting, sorted(group, key=lambda cell: cell.choices[setting])) for group in groups if len(group) > 1
    ]


def caveats(cells: Sequence[Cell]) -> list[str]:
    """Return differences between cells other than their methods, which may affect their results."""
    runs = [run for cell in cells for run in cell.runs]
    steps = {
        title: sorted({run.total_frames for run in group})
        for title, group in _grouped(runs, lambda run: run.title).items()
    }
    return [
        *_mixed("presets", (run.preset for run in runs)),
        *_mixed("commits", (run.commit for run in runs)),
        *_mixed("evaluations", _protocols([run for run in runs if run.state == "complete"])),
        *(
            f"numbers of steps of {title}: {', '.join(f'{total:,}' for total in totals)}"
            for title, totals in steps.items()
            if len(totals) > 1
        ),
    ]


def _cells(runs: Sequence[Run], telling: Sequence[str]) -> list[Cell]:
    """Cells of runs with the same choices; ``telling`` are the names of choices that differ from other runs."""
    others = _varying([_learned(run) for run in runs])
    found = []
    for alike in _grouped(runs, lambda run: _frozen(_learned(run), others)).values():
        first, named, learned = alike[0], choices(alike[0]), _learned(alike[0])
        settings = {name: named[name] for name in telling if named[name] is not None}
        settings |= {name: learned.get(name, DEFAULT) for name in others}
        by_seed = sorted(alike, key=lambda run: run.seed)
        found.append(Cell(first.place, first.stage, first.method, settings, named, by_seed))
    return found


def _learned(run: Run) -> dict[str, Any]:
    """Settings of a run that may affect learning."""
    other_stage = "task.transfer" if run.stage == "pretrain" else "task.pretrain"
    counted = PRETRAINING if run.stage == "transfer" and run.settings.get("transfer.keep") else set()
    ignored = UNLEARNT - counted | {other_stage} | (set() if _explores(run) else {"exploration"})
    return {name: value for name, value in run.settings.items() if not is_among(name, ignored)}


def _explores(run: Run) -> bool:
    """Return whether the policy of a run is one of the group ``exploration``, which other methods do not use."""
    return run.settings.get("actor._target_") == run.settings.get("exploration.actor._target_")


def _varying(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names with more than one value. A missing setting has its default if it is an argument; others are ignored."""
    names = dict.fromkeys(name for one in settings for name in one)
    shared = [name for name in names if all(name in one or _target(name) in one for one in settings)]
    return [name for name in shared if len({repr(one.get(name, DEFAULT)) for one in settings}) > 1]


def _target(name: str) -> str:
    """Name of the setting with the class or function of which a setting is an argument."""
    return f"{name.rpartition('.')[0]}._target_"


def _frozen(settings: Mapping[str, Any], names: Iterable[str] | None = None) -> Hashable:
    return tuple((name, repr(settings.get(name, DEFAULT))) for name in (settings if names is None else names))


def _grouped(items: Iterable[Item], key: Callable[[Item], Key]) -> dict[Key, list[Item]]:
    groups: dict[Key, list[Item]] = defaultdict(list)
    for item in items:
        groups[key(item)].append(item)
    return groups


def _order(cell: Cell) -> tuple:
    variants = tuple((name, repr(value).rjust(20)) for name, value in cell.settings.items())
    return _rank(cell.place, PLACES), cell.stage, _rank(cell.method, METHODS), not cell.is_standard, variants


def _rank(value: Any, known: Sequence[Any]) -> tuple[int, Any]:
    return (known.index(value), "") if value in known else (len(known), value)


def _standing(run: Run) -> str:
    return f"unfinished, {run.progress:.0%} of the steps" if run.state == "unfinished" else run.state


def _seeds(seeds: Iterable[int]) -> str:
    listed = [str(seed) for seed in seeds]
    return f"seed{'s' if len(listed) > 1 else ''} {', '.join(listed)}"


def _protocols(runs: Sequence[Run]) -> list[str]:
    """How each run was evaluated: its episodes, and settings of the environment that other runs have otherwise."""
    environments = [run.evaluation.get("environment", {}) for run in runs]
    telling = _varying(environments)
    return [
        f"{run.evaluation.get('episodes', 'unknown')} episodes of seed {run.evaluation.get('seed', 'unknown')}"
        + "".join(f" with {name}={environment[name]}" for name in telling)
        for run, environment in zip(runs, environments, strict=True)
    ]


def _pretraining(run: Run) -> str:
    """Where the networks that a run began with come from, without their seed."""
    return SEED.sub("", str(run.settings.get("pretrained") or "none"))


def _mixed(name: str, values: Iterable[str]) -> list[str]:
    found = sorted(set(values))
    return [f"{name}: {', '.join(found)}"] if len(found) > 1 else []
