"""Defines the style of all figures, with colours for colour-blind readers, and writes figures to files."""

from itertools import cycle, islice
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

# Okabe and Ito, "Color Universal Design", 2008, https://jfly.uni-koeln.de/color/, strongest contrasts first, then grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999999")

# A cycle of colours for angles. Orange is opposite to blue, and dark is opposite to light, so that all kinds of colour
# vision distinguish them. Unlike matplotlib's cycles, it has no colour that is too light for lines on white. The
# held-out quarter has the strongest contrast.
DIRECTIONS = LinearSegmentedColormap.from_list(
    "directions",
    ["#D55E00", "#E69F00", "#BFB24A", "#86BB9C", "#56B4E9", "#1C86D1", "#0B4F9E", "#4A2350", "#D55E00"],
)

INK = "#333333"
FAINT = "#DDDDDD"
GRID = "#EEEEEE"


def colours(num: int) -> list[str]:
    """Return ``num`` colours, for example for primitives; the colours repeat after the eighth."""
    return list(islice(cycle(COLOURS), num))


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, which is drawn by Agg and needs no display."""
    figure = Figure(figsize=(width, height), layout="compressed", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def bare(axes: Axes) -> None:
    """Remove the frame of ``axes`` except for faint lines on the left and at the bottom."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(color=FAINT, labelcolor=INK, labelsize=9)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)


def save_figure(figure: Figure, stem: Path) -> tuple[Path, Path]:
    """Write ``figure`` as ``<stem>.png`` (200 dots per inch) and ``<stem>.svg``; equal data give equal bytes."""
    png = stem.with_name(f"{stem.name}.png")
    svg = stem.with_name(f"{stem.name}.svg")
    stem.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(png, dpi=200)
    with rc_context({"svg.hashsalt": stem.name}):
        figure.savefig(svg, metadata={"Date": None})
    return png, svg
