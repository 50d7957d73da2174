"""What our docstrings and classes have and Sphinx would take for something else."""

import inspect
import re
from contextlib import suppress
from itertools import groupby
from typing import Any, get_type_hints

from docutils import nodes
from sphinx.application import Sphinx

BEFORE_NAPOLEON = 400


def setup(app: Sphinx) -> dict[str, Any]:
    """Prepare docstrings before they are parsed."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-docstring", prepare, priority=BEFORE_NAPOLEON)
    app.connect("autodoc-skip-member", plain_types)
    app.connect("autodoc-process-signature", constructor)
    app.connect("doctree-read", without_object)
    return {"parallel_read_safe": True}


def prepare(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Change the ``lines`` of a docstring in place.

    Markdown tables become list-tables. Where a value is described, Napoleon takes what stands before a colon in the
    first line for its type, unless nothing follows: the line is broken there.
    """
    if what in ("attribute", "data", "property") and lines:
        lines[:1] = re.sub(r"^((?:[^`:]|`[^`]*`)*:) ", r"\1\n", lines[0]).split("\n")
    converted: list[str] = []
    for is_table, group in groupby(lines, key=lambda line: line.lstrip().startswith("|")):
        block = list(group)
        converted += list_table(block) if is_table else block
    lines[:] = converted


def plain_types(app: Sphinx, what: str, name: str, obj: Any, *_: Any) -> None:
    """Leave out the rules in the types of parameters and fields, whose words Sphinx would take for names.

    This happens when autodoc asks whether to skip a member: later, it has already read the types of some classes.
    """
    owners = list(obj.__mro__) if inspect.isclass(obj) else []
    functions = [vars(owner).get("__init__") for owner in owners] or [obj]
    functions = [function for function in functions if inspect.isfunction(function)]
    for annotated in (*owners, *functions, *map(inspect.unwrap, functions)):
        with suppress(NameError, TypeError, AttributeError):
            types = get_type_hints(annotated)
            annotated.__annotations__ = {key: types[key] for key in inspect.get_annotations(annotated)}


def constructor(
    app: Sphinx, what: str, name: str, obj: Any, options: object, signature: str | None, returns: str | None
) -> tuple[str | None, str | None]:
    """Return a class's own arguments where TorchRL's metaclasses hide them."""
    if what != "class" or signature != "(*args, **kwargs)":
        return signature, returns
    parameters = list(inspect.signature(obj.__init__).parameters.values())[1:]
    bare = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in parameters]
    return str(inspect.Signature(bare)), None


def without_object(app: Sphinx, document: nodes.document) -> None:
    """Leave out that a class derives from what all classes derive from."""
    for paragraph in list(document.findall(nodes.paragraph)):
        if paragraph.astext() == "Bases: object":
            paragraph.parent.remove(paragraph)


def list_table(rows: list[str]) -> list[str]:
    """Return the lines of a list-table for those of a Markdown table: a header, a rule and rows."""
    indent = rows[0][: len(rows[0]) - len(rows[0].lstrip())]
    header, _, *body = ([cell.strip() for cell in row.strip().strip("|").split("|")] for row in rows)
    lines = [".. list-table::", "   :header-rows: 1", ""]
    for cells in (header, *body):
        lines += [f"   {'  -' if column else '* -'} {cell}".rstrip() for column, cell in enumerate(cells)]
    return [indent + line if line else "" for line in ["", *lines, ""]]
