"""Groups runs whose results are averaged, and finds differences between the groups."""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchrl_mcp.report.cell import DEFAULT, Cell, comparable, grouped, mixed, protocols, varying
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
    """Return the settings of a run that the report shows as choices; settings that a method lacks are None.

    They are the choices that the paper compares, and the settings that a method declares as ``method.standard``.
    """
    settings = run.settings
    kept = settings.get("transfer.keep", ()) if run.stage == "transfer" else ()
    trained = "gate" if "primitives" in settings.get("transfer.freeze", ()) else "gate and primitives"
    common = {
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
    return common | {name: settings.get(name) for name in run.standard if name not in common}


def cells(runs: Iterable[Run]) -> list[Cell]:
    """Group runs into cells, in the paper's order of tasks, stages and methods.

    Runs with the same task, character, stage, method and title share a cell unless they differ in their :func:`choices`
    or in another setting that affects learning, as defined by :mod:`~torchrl_mcp.runs.identity`. Runs of different
    commits may share a cell.
    """
    groups = []
    for alike in grouped(runs, lambda run: (run.place, run.stage, run.method, run.title)).values():
        different = varying([choices(run) for run in alike])
        for chosen in grouped(alike, lambda run: _frozen(choices(run))).values():
            groups += _cells(chosen, different)
    return sorted(groups, key=_order)


def reported(run: Run) -> Reported | None:
    """Return the number that the paper reports for a run, or None."""
    (cell,) = cells([run])
    return cell.reported


def methods(cells: Iterable[Cell]) -> dict[str, str]:
    """Return the titles of methods by name, in the order of Table 2; other methods follow in alphabetical order."""
    return {cell.method: cell.title for cell in sorted(cells, key=lambda cell: _rank(cell.method, METHODS))}


def ablations(cells: Iterable[Cell], setting: str) -> list[Ablation]:
    """Return the groups of cells that differ only in one of the :func:`choices`."""

    def rest(cell: Cell) -> Hashable:
        settings = {k: v for k, v in {**cell.choices, **cell.settings}.items() if k != setting}
        return cell.place, cell.stage, cell.method, _frozen(settings)

    groups = grouped((cell for cell in cells if cell.choices.get(setting) is not None), rest).values()
    return [
        Ablation(setting, sorted(group, key=lambda cell: cell.choices[setting])) for group in groups if len(group) > 1
    ]


def caveats(cells: Sequence[Cell]) -> list[str]:
    """Return differences between cells, besides their methods, which may affect the results."""
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


def _cells(runs: Sequence[Run], different: Sequence[str]) -> list[Cell]:
    """Return the cells of runs with the same choices; ``different`` names choices that differ from other runs."""
    further = _independent(varying([_learned(run) for run in runs]), runs)
    groups = []
    for alike in grouped(runs, lambda run: _frozen(_learned(run), further)).values():
        first = alike[0]
        chosen = choices(first)
        learned = _learned(first)
        settings = {name: chosen[name] for name in different if chosen[name] is not None}
        settings |= {name: learned.get(name, DEFAULT) for name in further}
        by_seed = sorted(alike, key=lambda run: run.seed)
        groups.append(Cell(first.place, first.stage, first.method, settings, chosen, by_seed))
    return groups


def _independent(names: Sequence[str], runs: Sequence[Run]) -> list[str]:
    """Return settings without repetitions, which come from references such as ``${mixer.temperature}``.

    Settings are repetitions if their values are equal in every run. Of these, the settings that were given on a command
    line are returned, or else the setting with the shortest path.
    """
    given = {name for run in runs for name in run.overrides}
    alike = grouped(names, lambda name: tuple(comparable(run.settings.get(name, DEFAULT)) for run in runs)).values()
    chosen = {name for group in alike for name in given.intersection(group) or [min(group, key=_depth)]}
    return [name for name in names if name in chosen]


def _depth(name: str) -> tuple[int, int]:
    return name.count("."), len(name)


def _learned(run: Run) -> dict[str, Any]:
    """Return the settings of a run that may affect learning."""
    other_stage = "task.transfer" if run.stage == "pretrain" else "task.pretrain"
    counted = PRETRAINING if run.stage == "transfer" and run.settings.get("transfer.keep") else set()
    ignored = UNLEARNT - counted | {other_stage} | (set() if _explores(run) else {"exploration"})
    return {name: value for name, value in run.settings.items() if not is_among(name, ignored)}


def _explores(run: Run) -> bool:
    """Return whether a run uses the group ``exploration``, which some methods ignore."""
    return run.settings.get("actor._target_") == run.settings.get("exploration.actor._target_")


def _frozen(settings: Mapping[str, Any], names: Iterable[str] | None = None) -> Hashable:
    return tuple((name, comparable(settings.get(name, DEFAULT))) for name in (settings if names is None else names))


def _order(cell: Cell) -> tuple:
    variants = tuple((name, repr(value).rjust(20)) for name, value in cell.settings.items())
    return _rank(cell.place, PLACES), cell.stage, _rank(cell.method, METHODS), not cell.is_standard, variants


def _rank(value: Any, order: Sequence[Any]) -> tuple[int, Any]:
    return (order.index(value), "") if value in order else (len(order), value)
