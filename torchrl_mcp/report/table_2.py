"""Draws Table 2 as a picture, with a panel for each row, and with our returns next to the paper's."""

from collections.abc import Iterable, Mapping, Sequence
from statistics import fmean

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from torchrl_mcp.analysis.figures import COLOURS, FAINT, GRID, INK, bare, new_figure
from torchrl_mcp.evaluation.statistics import Estimate, interquartile_mean, probability_of_improvement
from torchrl_mcp.report.cell import Cell, grouped
from torchrl_mcp.report.comparison import methods
from torchrl_mcp.report.paper import CHARACTERS, PLACES, TABLE_2, TITLES

BAR = 0.38
"""Width of a bar. A method has two bars, and methods are one unit apart."""

COLUMNS = 4
"""Number of panels side by side."""

Place = tuple[str, str]
"""Task and character."""


def compared(cells: Iterable[Cell], place: Place) -> dict[str, Cell]:
    """Return the cell that represents each method in a row of Table 2.

    Scratch is represented by its longest runs, which may have the steps of both stages, and every other method by its
    shortest runs. Of cells with the same :func:`.choices`, the cell with the most seeds is taken. Of several choices,
    such as two kinds of exploration, the cell with the highest deterministic return represents the method. Runs of the
    presets ``smoke`` and ``demo`` represent a method only in rows that have no other runs.

    Args:
        cells: Cells of any task and stage.
        place: Task and character.
    """
    candidates = [c for c in cells if c.place == place and c.stage == "transfer" and c.is_standard and c.complete]
    full = [cell for cell in candidates if not cell.runs[0].preset.startswith(("smoke", "demo"))]
    candidates = full or candidates
    best = {}
    for method, alike in grouped(candidates, lambda cell: cell.method).items():
        steps = (max if method == "scratch" else min)(cell.steps for cell in alike)
        by_choices = grouped((cell for cell in alike if cell.steps == steps), lambda cell: repr(cell.choices))
        most_seeds = (max(group, key=lambda cell: len(cell.by_seed)) for group in by_choices.values())
        best[method] = max(most_seeds, key=average)
    return best


def average(cell: Cell) -> float:
    """Return the mean deterministic return over seeds."""
    return fmean(cell.returns())


def draw_table_2(cells: Sequence[Cell]) -> Figure | None:
    """Draw our returns and the paper's as bars, with a panel for each row of Table 2 that has been run.

    Dots are single seeds. In tasks that define success, our bar is labelled with the share of successful episodes.

    Args:
        cells: Cells of any task and stage.

    Returns:
        The figure, or None if no row has been run.
    """
    rows = {place: row for place in PLACES if (row := compared(cells, place))}
    if not rows:
        return None
    run = methods(cell for row in rows.values() for cell in row.values())
    titles = TITLES | {name: title for name, title in run.items() if name not in TITLES}
    lines = -(-len(rows) // COLUMNS)
    columns = min(len(rows), COLUMNS)
    figure = new_figure(1.2 + 2.2 * columns, 0.5 + (0.5 + 0.27 * len(titles)) * lines)
    panels = figure.subplots(lines, columns, sharex=True, sharey=True, squeeze=False).flat
    for place, axes in zip(rows, panels, strict=False):
        draw_row(axes, place, rows[place], titles)
    for axes in list(panels)[len(rows) :]:
        axes.remove()
    keys = [Patch(color=COLOURS[0], label="ours"), Patch(color=FAINT, label="paper")]
    figure.legend(handles=keys, loc="outside upper center", ncols=2, frameon=False, fontsize=9, labelcolor=INK)
    return figure


def draw_row(axes: Axes, place: Place, by_method: Mapping[str, Cell], titles: Mapping[str, str]) -> None:
    """Draw a panel with two bars for each method, from top to bottom.

    Args:
        axes: Axes to draw on.
        place: Task and character.
        by_method: Our cells by the names of their methods.
        titles: Titles of all methods by name.
    """
    task, character = place
    for position, method in enumerate(titles):
        if method in by_method:
            cell = by_method[method]
            axes.barh(position - BAR / 2, average(cell), BAR, color=COLOURS[0])
            axes.plot(cell.returns(), [position - BAR / 2] * len(cell.by_seed), ".", color=INK, markersize=3)
            if "success" in cell.metrics:
                end = max(*cell.returns(), 0.0) + 0.03
                share = f"{cell.metrics['success']:.0%}"
                axes.text(end, position - BAR / 2, share, va="center", fontsize=7, color=INK)
        if (*place, method) in TABLE_2:
            axes.barh(position + BAR / 2, TABLE_2[*place, method].mean, BAR, color=FAINT)
    axes.set_title(f"{task}, {CHARACTERS.get(character, character)}", fontsize=9, color=INK)
    axes.set_yticks(range(len(titles)), titles.values())
    axes.set_ylim(len(titles) - 0.5, -0.5)
    axes.set_xticks([0.0, 0.5, 1.0])
    axes.grid(axis="x", color=GRID)
    axes.set_axisbelow(True)
    bare(axes)


def over_rows(cells: Sequence[Cell]) -> tuple[list[Place], dict[str, Estimate]]:
    """Return the rows of Table 2 in which every method was run, and each method's interquartile mean over them."""
    rows = {place: row for place in PLACES if (row := compared(cells, place))}
    names = methods(cell for row in rows.values() for cell in row.values())
    shared = [place for place, row in rows.items() if row.keys() == names.keys()]
    returns = {name: [rows[place][name].returns() for place in shared] for name in names if shared}
    return shared, {name: interquartile_mean(strata) for name, strata in returns.items()}


def draw_over_rows(cells: Sequence[Cell]) -> Figure | None:
    """Draw each method's interquartile mean, and the probability that a run of MCP is better than a run of the method.

    The means come from :func:`over_rows`; they are omitted if no row has all methods. The probability is computed over
    the rows that both methods have. Lines are 95 % bootstrap intervals, drawn if every row has at least two seeds.

    Args:
        cells: Cells of any task and stage.

    Returns:
        The figure, or None if MCP and another method share no row.
    """
    rows = [row for place in PLACES if "mcp" in (row := compared(cells, place)) and len(row) > 1]
    if not rows:
        return None
    run = methods(cell for row in rows for cell in row.values())
    shared, means = over_rows(cells)
    ahead = {
        name: probability_of_improvement([(f["mcp"].returns(), f[name].returns()) for f in rows if name in f])
        for name in run
        if name != "mcp"
    }
    figure = new_figure(7.5, 0.9 + 0.27 * len(run))
    panels = figure.subplots(1, 2 if means else 1, squeeze=False)[0]
    titles = {name: TITLES.get(name, title) for name, title in run.items()}
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
    axes.grid(axis="x", color=GRID)
    axes.set_xlabel(label, fontsize=9)
    bare(axes)


def describe(cells: Sequence[Cell]) -> str:
    """Return the numbers of the picture as text, for readers who cannot see it."""
    parts = []
    for place in PLACES:
        returns = [
            f"{TITLES.get(name, cell.title)} {average(cell):.3f}" for name, cell in compared(cells, place).items()
        ]
        if returns:
            parts.append(f"{place[0]} with the {CHARACTERS[place[1]]}: {', '.join(returns)}")
    return f"Normalised returns next to the paper's. {'; '.join(parts)}"
