"""Draws weights over the walk cycle, and mean actions of primitives, as in Figure 7."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.patheffects import withStroke

from torchrl_mcp.analysis.figures import GRID, INK, bare, colours, new_figure
from torchrl_mcp.analysis.specialisation import PHASE_BINS, stance_correlation
from torchrl_mcp.analysis.walks import STATES, Walk, cycle_rows, plane, specialisation


def draw_walk_cycle(walk: Walk, untrained: Mapping[str, float], *, title: str) -> Figure:
    """Draw weights over the walk cycle, and mean actions in the plane of their first two principal components.

    Args:
        walk: The walk.
        untrained: :func:`~torchrl_mcp.analysis.walks.specialisation` of untrained networks.
        title: Title of the figure.
    """
    rows = -(-walk.gates.shape[-1] // 2)
    figure = new_figure(9.2, 2.0 + 0.7 * max(rows, 4))
    figure.suptitle(title, fontsize=11, color=INK)
    left, right = figure.subfigures(1, 2, width_ratios=[1.2, 1.0], wspace=0.04, squeeze=False)[0]
    numbers = specialisation(walk)
    _draw_weights(left, walk)
    left.suptitle(
        f"Weights over {walk.strides} strides of {walk.seconds:.2f} s (line: mean; band: nine tenths)\n"
        f"The phase explains {numbers['phase']:.0%} of their variance; they swing by {numbers['swing']:.2f}\n"
        f"(untrained: {untrained['phase']:.0%}, {untrained['swing']:.2f})",
        fontsize=9,
        color=INK,
    )
    _draw_actions(right, walk)
    right.suptitle(
        f"Mean actions of the primitives in {min(STATES, len(walk.phases))} states of the walk\n"
        f"{numbers['between']:.0%} of variance between primitives, silhouette {numbers['silhouette']:.2f}\n"
        f"(untrained: {untrained['between']:.0%}, {untrained['silhouette']:.2f})",
        fontsize=9,
        color=INK,
    )
    return figure


def _draw_weights(figure: SubFigure, walk: Walk) -> None:
    num_primitives = walk.gates.shape[-1]
    rows = -(-num_primitives // 2)
    cells = cycle_rows(walk)
    alone = [row for row in cells if row["primitive"] == 1 and row["right_foot"] > 0.5 >= row["left_foot"]]
    grid = figure.subplots(rows + 1, 2, sharex=True, squeeze=False, height_ratios=[1.0] * rows + [0.55])
    palette = colours(num_primitives)
    stance = stance_correlation(walk.gates, walk.standing)
    for number, (axes, colour) in enumerate(zip(grid[:-1].T.flat, palette, strict=False), start=1):
        of_primitive = [row for row in cells if row["primitive"] == number]
        phase, mean, low, high = (
            np.array([row[key] for row in of_primitive]) for key in ("phase", "mean", "low", "high")
        )
        axes.broken_barh(_spans(alone), (-0.04, 1.08), color=GRID, linewidth=0)
        axes.fill_between(phase, low, high, color=colour, alpha=0.25, linewidth=0)
        axes.plot(phase, mean, color=colour, linewidth=1.8)
        axes.set(ylim=(-0.04, 1.04), yticks=[0, 1], xlim=(0, 1))
        label = f"primitive {number}, r = {stance[number - 1]:+.2f}".replace("-", "\N{MINUS SIGN}")
        axes.set_title(label, fontsize=8, color=INK, loc="left", pad=2)
        bare(axes)
    for axes in grid[:-1].T.flat[num_primitives:]:
        axes.set_visible(False)
    for axes in grid[-1]:
        _draw_feet(axes, cells)
    figure.supylabel("weight", fontsize=9, color=INK)
    figure.supxlabel(
        "phase of the stride; shaded: right foot alone\nr: correlation with left minus right stance",
        fontsize=9,
        color=INK,
    )


def _draw_feet(axes: Axes, cells: Sequence[Mapping[str, float]]) -> None:
    first = [row for row in cells if row["primitive"] == 1]
    for height, foot in enumerate(("right_foot", "left_foot")):
        spans = _spans([row for row in first if row[foot] > 0.5])
        axes.broken_barh(spans, (height + 0.15, 0.7), color=INK, linewidth=0)
    axes.set(ylim=(0, 2), yticks=[0.5, 1.5], xticks=[0, 0.25, 0.5, 0.75, 1])
    axes.set_yticklabels(["right foot", "left foot"])
    bare(axes)
    axes.spines["left"].set_visible(False)
    axes.tick_params(axis="both", length=0, labelsize=8)


def _spans(rows: Sequence[Mapping[str, float]]) -> list[tuple[float, float]]:
    """Return start and width of the bins of rows."""
    return [(row["phase"] - 0.5 / PHASE_BINS, 1 / PHASE_BINS) for row in rows]


def _draw_actions(figure: SubFigure, walk: Walk) -> None:
    axes = figure.subplots()
    scores, shares = plane(walk)
    for number, colour in enumerate(colours(scores.shape[1]), start=1):
        points = scores[:, number - 1]
        axes.scatter(points[:, 0], points[:, 1], s=6, color=colour, linewidths=0)
        # The label is at the outer edge of the cloud, because the origin is the mean of all clouds.
        outwards = points.mean(0) / np.linalg.norm(points.mean(0))
        axes.annotate(
            str(number),
            points[(points @ outwards).argmax()],
            xytext=9 * outwards,
            textcoords="offset points",
            color=colour,
            fontsize=11,
            fontweight="bold",
            ha="center",
            va="center",
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )
    axes.set_xlabel(f"principal component 1 ({shares[0]:.0%} of variance)", fontsize=9)
    axes.set_ylabel(f"principal component 2 ({shares[1]:.0%} of variance)", fontsize=9)
    axes.margins(0.08)
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(color=GRID)
    axes.set_axisbelow(True)
    bare(axes)
