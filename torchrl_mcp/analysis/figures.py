"""Style of all figures, a palette for colour-blind readers, and writing of files."""

from itertools import cycle, islice
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

# Okabe and Ito, "Color Universal Design", 2008, https://jfly.uni-koeln.de/color/, darkest contrasts first, and grey.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#999999")

# A cycle for angles. Orange is opposite blue and dark is opposite light, which all kinds of colour vision distinguish.
# Unlike matplotlib's cycles it has no colour too light for lines on white. The held-out quarter has the most contrast.
DIRECTIONS = LinearSegmentedColormap.from_list(
    "directions",
    ["#D55E00", "#E69F00", "#BFB24A", "#86BB9C", "#56B4E9", "#1C86D1", "#0B4F9E", "#4A2350", "#D55E00"],
)

INK = "#333333"
FAINT = "#DDDDDD"


def colours(num: int) -> list[str]:
    """Return a number of colours, for example for primitives; they repeat after the eighth."""
    return list(islice(cycle(COLOURS), num))


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, drawn by Agg, which needs no display."""
    figure = Figure(figsize=(width, height), layout="compressed", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def bare(axes: Axes) -> None:
    """Remove the frame of ``axes`` except faint lines on the left and below."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(FAINT)
    axes.tick_params(color=FAINT, labelcolor=INK, labelsize=9)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)


def save_figure(figure: Figure, stem: Path) -> tuple[Path, Path]:
    """Write ``figure`` as ``<stem>.png`` (200 dots per inch) and ``<stem>.svg``; same data, same bytes."""
    png, svg = stem.with_name(f"{stem.name}.png"), stem.with_name(f"{stem.name}.svg")
    stem.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(png, dpi=200)
    with rc_context({"svg.hashsalt": stem.name}):
        figure.savefig(svg, metadata={"Date": None})
    return png, svg
