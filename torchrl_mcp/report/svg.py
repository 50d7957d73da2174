"""Converts figures to parts of a web page, which use the colours and the font of the page."""

import io
import re
from collections.abc import Mapping
from xml.etree import ElementTree

from matplotlib import rc_context
from matplotlib.figure import Figure

SVG = "http://www.w3.org/2000/svg"
XLINK = "http://www.w3.org/1999/xlink"

OMITTED = {f"{{{SVG}}}metadata", f"{{{SVG}}}style"}
"""Elements that are omitted, because they are the same in every figure or affect the whole page."""


def inline_svg(figure: Figure, name: str, description: str, colours: Mapping[str, str]) -> str:
    """Return a figure as an ``<svg>`` element for HTML, as wide as its container.

    Text stays text. Identifiers that nothing refers to are removed. All other identifiers are unique on the page,
    because they depend on ``name``.

    Args:
        figure: The figure.
        name: Name of the figure, unique on the page.
        description: Description for screen readers.
        colours: CSS colours by colours of the figure, such as ``{"#0072B2": "var(--line-1)"}``.
    """
    buffer = io.StringIO()
    with rc_context({"svg.hashsalt": name, "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", transparent=True, metadata={"Date": None})
    source = re.sub(r"font-family: [^;]*;", "", buffer.getvalue())
    for colour, replacement in colours.items():
        source = re.sub(colour, replacement, source, flags=re.IGNORECASE)
    root = ElementTree.fromstring(source)
    referenced = set(re.findall(r'(?:url\(|href=")#([\w.-]+)', source))
    for element in list(root.iter()):
        if element.get("id") not in referenced:
            element.attrib.pop("id", None)
        for child in list(element):
            if child.tag in OMITTED:
                element.remove(child)
    for size in ("width", "height"):
        del root.attrib[size]
    root.attrib |= {"role": "img", "aria-label": description}
    ElementTree.register_namespace("", SVG)
    ElementTree.register_namespace("xlink", XLINK)
    return ElementTree.tostring(root, encoding="unicode")
