"""Draws learning curves over several seeds, as in Figures 4 and 5 (left), from the metrics of run folders."""

import csv
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle, product
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter
from numpy.typing import NDArray

from torchrl_mcp.analysis.figures import COLOURS, GRID, INK, bare, new_figure
from torchrl_mcp.training.run_folder import NORMALISED_RETURN, read_metrics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """A quantity as a function of environment steps, over the seeds of one method.

    Attributes:
        label: Name of the method.
        frames: Environment steps, ``(T,)``.
        mean: Mean over seeds, ``(T,)``.
        low: Minimum over seeds, ``(T,)``.
        high: Maximum over seeds, ``(T,)``.
        seeds: Number of seeds.
    """

    label: str
    frames: Array
    mean: Array
    low: Array
    high: Array
    seeds: int


def learning_curves(
    groups: Mapping[str, Sequence[Path]], *, quantity: str = NORMALISED_RETURN, num_bins: int = 50
) -> list[Curve]:
    """Return one curve per group on a common grid of steps, up to the last step that all seeds of the group reached.

    The steps up to the last value of the longest run are divided into ``num_bins`` equal bins. The value of a run in a
    bin is the mean of its rows, weighted by ``episode/count`` if the quantity is a mean over episodes. Bins in which no
    episode ends are interpolated. The last bin of a run is omitted if the run covers less than half of it. A bin should
    have at least as many steps as one episode in all environments: shorter bins may contain only early failures.

    Args:
        groups: Run folders, one per seed, by the labels of their curves.
        quantity: A column of ``metrics.csv``.
        num_bins: Number of bins.

    Raises:
        ValueError: If a run lacks the column, or a group has no run.
    """
    runs = {label: [_points(Path(folder), quantity) for folder in folders] for label, folders in groups.items()}
    if empty := [label for label, points in runs.items() if not points]:
        raise ValueError(f"groups {empty} have no run folders: omit these groups, or list their runs")
    longest = max(points[0].max() for group in runs.values() for points in group)
    edges = np.linspace(0.0, longest, num_bins + 1)
    return [_curve(label, [_binned(*points, edges) for points in group], edges) for label, group in runs.items()]


def labelled_curves(groups: Sequence[tuple[str, Sequence[Path]]]) -> list[Curve]:
    """Return :func:`learning_curves` of groups with labels, some of which may be equal."""
    curves = learning_curves({str(number): folders for number, (_, folders) in enumerate(groups)})
    return [replace(curve, label=label) for curve, (label, _) in zip(curves, groups, strict=True)]


def write_curves(curves: Sequence[Curve], path: Path) -> None:
    """Write curves as CSV: one row per label and bin, with ``frames``, ``mean``, ``low``, ``high`` and ``seeds``."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["label", "frames", "mean", "low", "high", "seeds"])
        for curve in curves:
            for row in zip(curve.frames, curve.mean, curve.low, curve.high, strict=True):
                writer.writerow([curve.label, *map(float, row), curve.seeds])


def draw_curves(
    curves: Sequence[Curve], *, xlabel: str = "environment steps", ylabel: str = "normalised return"
) -> Figure:
    """Draw curves as lines, each with the range of its seeds as a band around it, and a legend above."""
    for columns in (2, 1):  # labels may be too long for two columns
        figure = new_figure(6.4, 3.2 + 0.2 * math.ceil(len(curves) / columns))
        plot_curves(figure.add_subplot(), curves, xlabel=xlabel, ylabel=ylabel)
        style = {"frameon": False, "fontsize": 9, "labelcolor": INK}
        labels = [_legend(curve) for curve in curves]
        legend = figure.legend(figure.axes[0].lines, labels, loc="outside upper center", ncols=columns, **style)
        figure.draw_without_rendering()
        if legend.get_window_extent().width <= figure.bbox.width:
            break
    return figure


def plot_curves(
    axes: Axes,
    curves: Sequence[Curve],
    styles: Iterable[Mapping[str, Any]] = (),
    *,
    xlabel: str = "environment steps",
    ylabel: str = "normalised return",
) -> None:
    """Plot curves as lines, each with the range of its seeds as a band around it; a single point is a dot.

    Args:
        axes: Axes to draw on.
        curves: The curves.
        styles: Matplotlib's ``color`` and other properties of each line, by default the colours of all figures.
        xlabel: Label of the steps.
        ylabel: Label of the quantity.
    """
    # When the colours repeat, dashes distinguish the lines.
    lines = cycle(product(("-", "--", ":"), COLOURS))
    styles = styles or ({"color": colour, "linewidth": 2, "linestyle": line} for line, colour in lines)
    for curve, style in zip(curves, styles, strict=False):
        axes.fill_between(curve.frames, curve.low, curve.high, color=style["color"], alpha=0.2, linewidth=0)
        marker = "o" if len(curve.frames) == 1 else None
        axes.plot(curve.frames, curve.mean, label=_legend(curve), marker=marker, solid_capstyle="round", **style)
    axes.set(xlabel=xlabel, ylabel=ylabel, xlim=(0, None))
    lowest = min(curve.low.min(initial=0.0) for curve in curves)
    bottom, top = axes.get_ylim()
    axes.set_ylim(min(0.0, bottom) if lowest < 0 else 0.0, max(0.0, top))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(axis="y", color=GRID)
    axes.set_axisbelow(True)
    bare(axes)


def _legend(curve: Curve) -> str:
    return f"{curve.label} ({curve.seeds} seeds)" if curve.seeds > 1 else curve.label


def _points(run: Path, quantity: str) -> tuple[Array, Array, Array]:
    """Return steps, values and weights of the rows with a finite quantity, each ``(R,)``."""
    rows = read_metrics(run)
    if not rows:
        raise ValueError(f"{run} has no metrics.csv with a row: pass a run folder in which an iteration has ended")
    if quantity not in rows[0]:
        raise ValueError(f"{run} has no column {quantity!r} in metrics.csv: use one of its columns, {sorted(rows[0])}")
    weight = "episode/count" if quantity.startswith("episode/") else None
    points = [(row["frames"], row[quantity], row[weight] if weight else 1.0) for row in rows]
    points = [point for point in points if math.isfinite(point[1])]
    if not points:
        raise ValueError(f"{run} has no finite {quantity!r} yet: wait until episodes of full length have ended")
    frames, values, weights = np.array(points).T
    return frames, values, weights


def _binned(frames: Array, values: Array, weights: Array, edges: Array) -> Array:
    """Return weighted means in the bins ``(edges[i], edges[i + 1]]``, which are NaN outside the run."""
    num_bins = len(edges) - 1
    index = np.searchsorted(edges, frames, side="left").clip(1, num_bins) - 1
    total = np.bincount(index, weights * values, minlength=num_bins)
    mass = np.bincount(index, weights, minlength=num_bins)
    bins = np.arange(num_bins)
    full = mass > 0
    last = index.max()  # omitted if the run covers less than half of this bin
    if full[:last].any() and frames.max() < (edges[last] + edges[last + 1]) / 2:
        full[last] = False
    return np.interp(bins, bins[full], total[full] / mass[full], left=np.nan, right=np.nan)


def _curve(label: str, seeds: Sequence[Array], edges: Array) -> Curve:
    stacked = np.stack(seeds)
    complete = np.isfinite(stacked).all(0)
    middle = (edges[1:] + edges[:-1])[complete] / 2
    values = stacked[:, complete]
    return Curve(label, middle, values.mean(0), values.min(0), values.max(0), len(seeds))
