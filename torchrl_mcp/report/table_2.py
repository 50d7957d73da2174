"""Table 2 as a picture: a panel for each row, with our returns beside the paper's."""

from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from torchrl_mcp.analysis.figures import COLOURS, FAINT, INK, bare, new_figure
from torchrl_mcp.evaluation.statistics import Estimate, interquartile_mean, probability_of_improvement
from torchrl_mcp.report.cell import Cell, grouped
from torchrl_mcp.report.comparison import methods
from torchrl_mcp.report.paper import CHARACTERS, PLACES, TABLE_2, TITLES

BAR = 0.38
"""Width of a bar; a method has two, one unit apart from the next method's."""

COLUMNS = 4
"""Panels beside one another."""

Place = tuple[str, str]


def compared(cells: Iterable[Cell], place: Place) -> dict[str, Cell]:
    """Return the cell that stands for each method in a row of Table 2.

    Scratch stands with its longest runs, which may have the steps of both stages, every other method with its shortest.
    Of several :func:`.choices` of a method, such as two kinds of exploration, the one with the highest deterministic
    return stands for it; of cells with the same choices, that with the most seeds.

    Args:
        cells: Cells of any task and stage.
        place: Task and character.
    """
    here = [c for c in cells if c.place == place and c.stage == "transfer" and c.is_standard and c.complete]
    best = {}
    for method, alike in grouped(here, lambda cell: cell.method).items():
        steps = (max if method == "scratch" else min)(cell.steps for cell in alike)
        kinds = grouped((cell for cell in alike if cell.steps == steps), lambda cell: repr(cell.choices))
        most = (max(kind, key=lambda cell: len(cell.by_seed)) for kind in kinds.values())
        best[method] = max(most, key=average)
    return best


def average(cell: Cell) -> float:
    """Return the mean deterministic return over seeds."""
    return fmean(cell.returns())


def draw_table_2(cells: Sequence[Cell]) -> Figure | None:
    """Draw our returns and the paper's as bars, a panel for each row of Table 2 that has been run.

    Dots are single seeds. Where a task has successes, their share stands beside our bar.

    Args:
        cells: Cells of any task and stage.

    Returns:
        The figure, or None if no row has been run.
    """
    rows = {place: row for place in PLACES if (row := compared(cells, place))}
    if not rows:
        return None
    run = methods(cell for row in rows.values() for cell in row.values())
    named = TITLES | {name: title for name, title in run.items() if name not in TITLES}
    lines, columns = -(-len(rows) // COLUMNS), min(len(rows), COLUMNS)
    figure = new_figure(1.2 + 2.2 * columns, 0.5 + (0.5 + 0.27 * len(named)) * lines)
    panels = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).flat
    for place, axes in zip(rows, panels, strict=False):
        draw_row(axes, place, rows[place], named)
    for axes in list(panels)[len(rows) :]:
        axes.remove()
    keys = [Patch(color=COLOURS[0], label="ours"), Patch(color=FAINT, label="paper")]
    figure.legend(handles=keys, loc="outside upper center", ncols=2, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def draw_row(axes: Axes, place: Place, found: Mapping[str, Cell], named: Mapping[str, str]) -> None:
    """Draw a panel: two bars for each method, the first of them on top."""
    task, character = place
    for position, method in enumerate(named):
        if method in found:
            cell = found[method]
            axes.barh(position - BAR / 2, average(cell), BAR, color=COLOURS[0])
            axes.plot(cell.returns(), [position - BAR / 2] * len(cell.by_seed), ".", color=INK, markersize=3)
            if "success" in cell.metrics:
                end = max(*cell.returns(), 0.0) + 0.03
                share = f"{cell.metrics['success']:.0%}"
                axes.text(end, position - BAR / 2, share, va="center", fontsize=7, color=INK)
        if (*place, method) in TABLE_2:
            axes.barh(position + BAR / 2, TABLE_2[*place, method].mean, BAR, color=FAINT)
    axes.set_title(f"{task}, {CHARACTERS.get(character, character)}", fontsize=9, color=INK)
    axes.set_yticks(range(len(named)), named.values())
    axes.set_ylim(len(named) - 0.5, -0.5)
    axes.set_xticks([0.0, 0.5, 1.0])
    axes.grid(axis="x", color="#EEEEEE")
    axes.set_axisbelow(True)
    bare(axes)


def over_rows(cells: Sequence[Cell]) -> tuple[list[Place], dict[str, Estimate]]:
    """Return the rows of Table 2 in which every method was run, and each method's interquartile mean over them."""
    rows = {place: row for place in PLACES if (row := compared(cells, place))}
    named = methods(cell for row in rows.values() for cell in row.values())
    shared = [place for place, row in rows.items() if row.keys() == named.keys()]
    returns = {name: [rows[place][name].returns() for place in shared] for name in named if shared}
    return shared, {name: interquartile_mean(strata) for name, strata in returns.items()}


def draw_over_rows(cells: Sequence[Cell]) -> Figure | None:
    """Draw each method's interquartile mean, and how probable it is that a run of MCP is ahead of one of the method.

    Means are those of :func:`over_rows`, if there are any; the probability is over the rows that both have. Lines are
    95 % bootstrap intervals, where every row has two seeds or more.

    Args:
        cells: Cells of any task and stage.

    Returns:
        The figure, or None if MCP and another method share no row.
    """
    rows = [row for place in PLACES if "mcp" in (row := compared(cells, place)) and len(row) > 1]
    if not rows:
        return None
    named = methods(cell for row in rows for cell in row.values())
    others = [method for method in named if method != "mcp"]
    shared, means = over_rows(cells)
    ahead = {
        name: probability_of_improvement([(f["mcp"].returns(), f[name].returns()) for f in rows if name in f])
        for name in others
    }
    figure = new_figure(7.5, 0.9 + 0.27 * len(named))
    panels = figure.subplots(1, 2 if means else 1, squeeze=False)[0]
    titles = {name: TITLES.get(name, title) for name, title in named.items()}
    if means:
        draw_estimates(panels[0], means, titles, f"interquartile mean over {len(shared)} rows")
    draw_estimates(panels[-1], ahead, titles, "probability that MCP is ahead")
    panels[-1].axvline(0.5, color=INK, linewidth=0.8, linestyle=":")
    return figure


def draw_estimates(axes: Axes, estimates: Mapping[str, Estimate], titles: Mapping[str, str], label: str) -> None:
    """Draw numbers with their intervals, one below the other."""
    for position, estimate in enumerate(estimates.values()):
        axes.plot([estimate.low, estimate.high], [position] * 2, color=COLOURS[0])
        axes.plot(estimate.value, position, "o", color=COLOURS[0], markersize=4)
    axes.set_yticks(range(len(estimates)), [titles[name] for name in estimates])
    axes.set_ylim(len(estimates) - 0.5, -0.5)
    axes.set_xlim(1.02 * min(0.0, axes.dataLim.x0), 1.02 * max(1.0, axes.dataLim.x1))
    axes.grid(axis="x", color="#EEEEEE")
    axes.set_xlabel(label, fontsize=9)
    bare(axes)


def describe(cells: Sequence[Cell]) -> str:
    """Return what the picture shows, for readers who do not see it."""
    parts = []
    for place in PLACES:
        returns = [
            f"{TITLES.get(name, cell.title)} {average(cell):.3f}" for name, cell in compared(cells, place).items()
        ]
        if returns:
            parts.append(f"{place[0]} with the {CHARACTERS[place[1]]}: {', '.join(returns)}")
    return f"Normalised returns beside the paper's. {'; '.join(parts)}"
