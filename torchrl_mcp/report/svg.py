"""Figures as part of a web page, in the page's own colours and font."""

import io
import re
from collections.abc import Mapping
from xml.etree import ElementTree

from matplotlib import rc_context
from matplotlib.figure import Figure

SVG = "http://www.w3.org/2000/svg"
XLINK = "http://www.w3.org/1999/xlink"

LEFT_OUT = {f"{{{SVG}}}metadata", f"{{{SVG}}}style"}
"""Elements that would say the same in every figure, or speak to the whole page."""


def inline_svg(figure: Figure, name: str, description: str, colours: Mapping[str, str]) -> str:
    """Return a figure as an ``<svg>`` element for HTML, as wide as its container.

    Text stays text. Of the identifiers those remain that something refers to, which ``name`` keeps apart from those of
    other figures on the page.

    Args:
        figure: The figure.
        name: Its name, of which a page has one.
        description: What it shows, for those who do not see it.
        colours: What to put for colours of the figure, in CSS: ``{"#0072B2": "var(--line-1)"}``.
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
            if child.tag in LEFT_OUT:
                element.remove(child)
    for size in ("width", "height"):
        del root.attrib[size]
    root.attrib |= {"role": "img", "aria-label": description}
    ElementTree.register_namespace("", SVG)
    ElementTree.register_namespace("xlink", XLINK)
    return ElementTree.tostring(root, encoding="unicode")
