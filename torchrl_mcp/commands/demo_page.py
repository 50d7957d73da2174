"""The page of the demonstration: film, table, learning curves and the next commands."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from torchrl_mcp.training.run_folder import replacing

PAGE = "index.html"


def write_page(
    folder: Path,
    rows: Sequence[Mapping[str, str]],
    *,
    caption: str,
    film: str | None,
    curves: str,
    commands: Mapping[str, str],
) -> None:
    """Write ``index.html``.

    Args:
        folder: The folder of the demonstration.
        rows: Rows of the table, cells by column.
        caption: What the table compares.
        film: File of the film in ``folder``, or None without one.
        curves: File of the learning curves in ``folder``.
        commands: Next commands, by what each does.
    """
    environment = Environment(loader=PackageLoader("torchrl_mcp.report"), autoescape=True, undefined=StrictUndefined)
    context = {"rows": rows, "caption": caption, "film": film, "curves": curves, "commands": commands}
    with replacing(folder / PAGE) as partial:
        partial.write_text(environment.get_template("demo.html").render(context), encoding="utf-8")
