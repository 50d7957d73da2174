"""Groups of runs that are averaged, and what differs between them."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchrl_mcp.report.cell import DEFAULT, Cell, grouped, mixed, protocols, varying
from torchrl_mcp.report.paper import METHODS, PLACES, Reported
from torchrl_mcp.report.results import Run
from torchrl_mcp.runs.identity import PRETRAINING, UNLEARNT, is_among


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
    """Return settings that the paper or the command line names, and the method's own, which its file declares.

    The method declares its own as ``method.standard``. Settings that a method lacks are None.
    """
    settings = run.settings
    kept = settings.get("transfer.keep", ()) if run.stage == "transfer" else ()
    trained = "gate" if "primitives" in settings.get("transfer.freeze", ()) else "gate and primitives"
    named = {
        "preset": run.preset,
        "total_frames": run.total_frames,
        **{name: settings[name] for name in run.standard if name in settings},
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

    Runs of one task, character, stage, method and title share a cell unless their :func:`choices` differ, or any other
    setting that :mod:`~torchrl_mcp.runs.identity` counts. Runs of different commits may share a cell.
    """
    groups = []
    for alike in grouped(runs, lambda run: (run.place, run.stage, run.method, run.title)).values():
        telling = varying([choices(run) for run in alike])
        for chosen in grouped(alike, lambda run: _frozen(choices(run))).values():
            groups += _cells(chosen, telling)
    return sorted(groups, key=_order)


def reported(run: Run) -> Reported | None:
    """Return the paper's figure for a run, if it has one."""
    (cell,) = cells([run])
    return cell.reported


def methods(cells: Iterable[Cell]) -> dict[str, str]:
    """Return the titles of methods by name: first in the order of Table 2, then alphabetically."""
    return {cell.method: cell.title for cell in sorted(cells, key=lambda cell: _rank(cell.method, METHODS))}


def ablations(cells: Iterable[Cell], setting: str) -> list[Ablation]:
    """Return the groups of cells that differ only in one of the :func:`choices`."""

    def rest(cell: Cell) -> Hashable:
        others = _frozen({k: v for k, v in {**cell.choices, **cell.settings}.items() if k != setting})
        return cell.place, cell.stage, cell.method, others

    groups = grouped((cell for cell in cells if cell.choices.get(setting) is not None), rest).values()
    return [
        Ablation(setting, sorted(group, key=lambda cell: cell.choices[setting])) for group in groups if len(group) > 1
    ]


def caveats(cells: Sequence[Cell]) -> list[str]:
    """Return differences between cells other than their methods, which may affect their results."""
    runs = [run for cell in cells for run in cell.runs]
    steps = {
        title: sorted({run.total_frames for run in group})
        for title, group in grouped(runs, lambda run: run.title).items()
    }
    return [
        *mixed("presets", (run.preset for run in runs)),
        *mixed("commits", (run.commit for run in runs)),
        *mixed("evaluations", protocols([run for run in runs if run.state == "complete"])),
        *(
            f"numbers of steps of {title}: {', '.join(f'{total:,}' for total in totals)}"
            for title, totals in steps.items()
            if len(totals) > 1
        ),
    ]


def _cells(runs: Sequence[Run], telling: Sequence[str]) -> list[Cell]:
    """Cells of runs with the same choices; ``telling`` are the names of choices that differ from other runs."""
    others = _independent(varying([_learned(run) for run in runs]), runs)
    groups = []
    for alike in grouped(runs, lambda run: _frozen(_learned(run), others)).values():
        first = alike[0]
        named = choices(alike[0])
        learned = _learned(alike[0])
        settings = {name: named[name] for name in telling if named[name] is not None}
        settings |= {name: learned.get(name, DEFAULT) for name in others}
        by_seed = sorted(alike, key=lambda run: run.seed)
        groups.append(Cell(first.place, first.stage, first.method, settings, named, by_seed))
    return groups


def _independent(names: Sequence[str], runs: Sequence[Run]) -> list[str]:
    """Return settings without those that only repeat another one, as references such as ``${mixer.temperature}`` do.

    Of settings with equal values in all runs, those of a command line stand for all, else the shortest path.
    """
    given = {name for run in runs for name in run.overrides}
    alike = grouped(names, lambda name: tuple(repr(run.settings.get(name, DEFAULT)) for run in runs)).values()
    chosen = {name for group in alike for name in given.intersection(group) or [min(group, key=_depth)]}
    return [name for name in names if name in chosen]


def _depth(name: str) -> tuple[int, int]:
    return name.count("."), len(name)


def _learned(run: Run) -> dict[str, Any]:
    """Settings of a run that may affect learning."""
    other_stage = "task.transfer" if run.stage == "pretrain" else "task.pretrain"
    counted = PRETRAINING if run.stage == "transfer" and run.settings.get("transfer.keep") else set()
    ignored = UNLEARNT - counted | {other_stage} | (set() if _explores(run) else {"exploration"})
    return {name: value for name, value in run.settings.items() if not is_among(name, ignored)}


def _explores(run: Run) -> bool:
    """Return whether the policy of a run is one of the group ``exploration``, which other methods do not use."""
    return run.settings.get("actor._target_") == run.settings.get("exploration.actor._target_")


def _frozen(settings: Mapping[str, Any], names: Iterable[str] | None = None) -> Hashable:
    return tuple((name, repr(settings.get(name, DEFAULT))) for name in (settings if names is None else names))


def _order(cell: Cell) -> tuple:
    variants = tuple((name, repr(value).rjust(20)) for name, value in cell.settings.items())
    return _rank(cell.place, PLACES), cell.stage, _rank(cell.method, METHODS), not cell.is_standard, variants


def _rank(value: Any, known: Sequence[Any]) -> tuple[int, Any]:
    return (known.index(value), "") if value in known else (len(known), value)
