"""Composes the parts of a report: tables of cells with their learning curves."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from statistics import fmean
from typing import Any

from torchrl_mcp.analysis.curves import labelled_curves, plot_curves
from torchrl_mcp.analysis.figures import COLOURS, FAINT, GRID, INK, colours, new_figure
from torchrl_mcp.report.cell import Cell
from torchrl_mcp.report.comparison import ablations, caveats, methods
from torchrl_mcp.report.paper import CHARACTERS
from torchrl_mcp.report.svg import inline_svg
from torchrl_mcp.report.usage import diagnostics, usage, verdict

LINES = {colour: f"var(--line-{number})" for number, colour in enumerate(COLOURS, start=1)}
"""CSS colours of lines by the colours of figures."""

PAGE_COLOURS = LINES | {INK: "currentColor", FAINT: "var(--rule)", GRID: "var(--faint-rule)"}
"""CSS colours by all colours of figures."""

DASHES = {"-": "none", "--": "7 3", ":": "2 3", "-.": "7 3 2 3"}
"""Line styles of SVG by the equivalent styles of matplotlib."""

ABLATIONS = {
    "num_primitives": (
        "Number of primitives",
        "The gate weighs this number of primitives, which the paper varies in Table 4.",
    ),
    "trained": (
        "Gate alone, or gate and primitives",
        "Transfer trains the gate alone, or also the primitives. The paper compares both in Figure 8.",
    ),
    "mixer": ("Mixer", "Multiplicative composition of primitives (Eq. 3), or additive (Eq. 1)."),
    "exploration": ("Exploration", "Over actions (Eq. 4), or over the weights of primitives (Section 5.3)."),
    "curriculum": (
        "Curriculum",
        "Episodes and rewards of training may differ from the paper's. Evaluations always use the paper's.",
    ),
}
"""Title and explanation of each ablation, by its setting."""

SETTING_WORDS = {
    "preset": "preset {}",
    "total_frames": "{:,} steps",
    "num_primitives": "{} primitives",
    "num_options": "{} options",
    "latent_dim": "{} latent variables",
    "trained": "trained: {}",
    "gate": "{} gate",
    "mixer": "{} mixer",
    "exploration": "exploration: {}",
    "curriculum": "curriculum: {}",
    "symmetry": "symmetry: {}",
    "pretrained": "{} pre-training",
}
"""Words for the values of settings."""

DIAGNOSTICS = {
    "gates": (
        "Gates",
        {
            "effective_primitives": "Effective primitives",
            "sum": "Sum of weights",
            "saturation": "Saturated",
            "entropy": "Entropy, nats",
        },
    ),
    "options": (
        "Options",
        {"effective_options": "Effective options", "begin_rate": "Begin rate", "duration": "Duration, steps"},
    ),
}
"""Title of each table of diagnostics, and the titles of its columns."""


@dataclass(frozen=True)
class Row:
    """A cell with its name in a table, and with its differences from cells of the same name."""

    cell: Cell
    name: str
    variant: str = ""

    @property
    def label(self) -> str:
        """Name and variant in one line."""
        return f"{self.name}, {self.variant}" if self.variant else self.name


@dataclass(frozen=True)
class Line:
    """An entry of a legend: a label, and the style of the line in CSS."""

    label: str
    colour: str
    dashes: str


@dataclass(frozen=True)
class Plot:
    """Learning curves, their legend, and the labels of rows that have too few episodes for a curve."""

    svg: str
    lines: Sequence[Line]
    without: Sequence[str]


@dataclass(frozen=True)
class Section:
    """Cells that are compared with each other; ``kind`` is the heading of their column."""

    title: str
    rows: Sequence[Row]
    plot: Plot | None = None
    kind: str = "Method"

    @property
    def caveats(self) -> list[str]:
        """Differences between the cells besides their methods."""
        return caveats([row.cell for row in self.rows])

    @property
    def remarks(self) -> dict[str, list[str]]:
        """Labels of the rows to which a remark applies, by remark."""
        labels: dict[str, list[str]] = {}
        for row in self.rows:
            for remark in row.cell.remarks:
                labels.setdefault(remark, []).append(row.label)
        return labels

    @property
    def metrics(self) -> list[str]:
        """Names of the metrics of the task."""
        return list(dict.fromkeys(name for row in self.rows for name in row.cell.metrics))

    @property
    def has_reported(self) -> bool:
        """Whether the paper reports a number for one of the cells."""
        return any(row.cell.reported for row in self.rows)

    @property
    def has_reach(self) -> bool:
        """Whether one of the tasks computes the returns of standing still and of an ideal player."""
        return any(row.cell.reach for row in self.rows)

    def is_best(self, cell: Cell, mode: str) -> bool:
        """Return whether a cell has the highest mean, if at least two cells have a mean."""
        means = [fmean(returns) for row in self.rows if (returns := row.cell.returns(mode))]
        cell_returns = cell.returns(mode)
        return bool(cell_returns) and len(means) > 1 and fmean(cell_returns) == max(means)


@dataclass(frozen=True)
class Chapter:
    """An ablation: one section for each task, character and method."""

    title: str
    explanation: str
    sections: Sequence[Section]


def place_title(place: tuple[str, str]) -> str:
    """Return ``Dribble: T-Rex`` for ``("dribble", "trex")``."""
    task, character = place
    return f"{task.capitalize()}: {CHARACTERS.get(character, character)}"


def method_colours(cells: Sequence[Cell]) -> dict[str, str]:
    """Return the colours of methods by the names of the methods."""
    names = methods(cells)
    return dict(zip(names, colours(len(names)), strict=True))


def row(cell: Cell) -> Row:
    """Return a row with the title of the cell's method, and the settings that differ from the method's standard."""
    standard = cell.runs[0].standard
    settings = {name: value for name, value in {**cell.variations, **cell.settings}.items() if value is not None}
    different = {name: value for name, value in settings.items() if name not in standard or value != standard[name]}
    words = (SETTING_WORDS.get(name, f"{name}={{}}").format(value) for name, value in different.items())
    return Row(cell, cell.title, ", ".join(words))


def task_sections(cells: Sequence[Cell], names: Iterator[str], palette: Mapping[str, str]) -> list[Section]:
    """Return a section per task and character, as in Figures 4 and 9.

    The table contains all cells; the plot omits the cells of ablations.

    Args:
        cells: Cells of one stage.
        names: Names of plots, unique on the page.
        palette: Colours of methods by the names of the methods.
    """
    ablated = {id(cell) for setting in ABLATIONS for part in ablations(cells, setting) for cell in part.cells}
    sections = []
    for place in dict.fromkeys(cell.place for cell in cells):
        rows = [row(cell) for cell in cells if cell.place == place]
        drawn = [r for r in rows if r.cell.is_standard or id(r.cell) not in ablated]
        title = place_title(place)
        sections.append(Section(title, rows, plot(title, drawn, _styles(drawn, palette), next(names))))
    return sections


def ablation_chapters(cells: Sequence[Cell], names: Iterator[str]) -> list[Chapter]:
    """Return the ablations for which at least two cells can be compared."""
    chapters = []
    for setting, (title, explanation) in ABLATIONS.items():
        sections = []
        for part in ablations(cells, setting):
            first = part.cells[0]
            heading = f"{place_title(first.place)}, {first.title}, {first.stage}"
            rows = [Row(cell, SETTING_WORDS[setting].format(cell.choices[setting])) for cell in part.cells]
            styles = [{"color": colour, "linestyle": "-"} for colour in colours(len(rows))]
            drawn = plot(f"{title}, {heading}", rows, styles, next(names))
            sections.append(Section(heading, rows, drawn, kind="Setting"))
        if sections:
            chapters.append(Chapter(title, explanation, sections))
    return chapters


def diagnostic_tables(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return the tables of diagnostics of gates and options, with a row for every cell that has diagnostics."""
    tables = []
    for group, (title, columns) in DIAGNOSTICS.items():
        rows = [
            {
                "row": row(cell),
                "numbers": numbers,
                "usage": [(run.seed, usage(run, group)) for run in cell.complete],
                "verdicts": [(run.seed, problem) for run in cell.complete if (problem := verdict(run, group))],
            }
            for cell in cells
            if (numbers := diagnostics(cell, group))
        ]
        if rows:
            tables.append({"title": title, "columns": columns, "rows": rows})
    return tables


def plot(title: str, rows: Sequence[Row], styles: Iterable[Mapping[str, str]], name: str) -> Plot | None:
    """Draw the learning curves of rows, or return None if no episode has ended.

    Args:
        title: Common title of the rows.
        rows: The rows.
        styles: ``color`` and ``linestyle`` of each row.
        name: Name of the plot, unique on the page.
    """
    groups = [
        ([run.path for run in r.cell.runs if run.has_episodes], r.label, s) for r, s in zip(rows, styles, strict=True)
    ]
    drawn = [group for group in groups if group[0]]
    if not drawn:
        return None
    figure = new_figure(4.8, 2.8)
    curves = labelled_curves([(label, paths) for paths, label, _ in drawn])
    empty = [label for curve, (_, label, _) in zip(curves, drawn, strict=True) if not len(curve.frames)]
    plot_curves(figure.add_subplot(), curves, [{**style, "linewidth": 1.5} for *_, style in drawn])
    labels = "; ".join(curve.label for curve in curves)
    svg = inline_svg(figure, name, f"{title}: normalised return over environment steps of {labels}", PAGE_COLOURS)
    lines = [Line(label, LINES[style["color"]], DASHES[style["linestyle"]]) for _, label, style in drawn]
    return Plot(svg, lines, [*(label for paths, label, _ in groups if not paths), *empty])


def _styles(rows: Sequence[Row], palette: Mapping[str, str]) -> Iterator[dict[str, str]]:
    """Yield colour and line style of rows: a method has one colour, and rows of one colour differ in line style."""
    line_styles: dict[str, Iterator[str]] = {}
    for r in rows:
        colour = palette[r.cell.method]
        yield {"color": colour, "linestyle": next(line_styles.setdefault(colour, cycle(DASHES)))}
