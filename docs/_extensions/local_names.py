"""Docstrings name things as their module does, also what it imports from elsewhere or keeps without a description."""

import sys
from typing import Any

from docutils.nodes import Element
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment


def setup(app: Sphinx) -> dict[str, Any]:
    """Look for names where Sphinx has not found them."""
    app.connect("missing-reference", resolve)
    return {"parallel_read_safe": True}


def resolve(app: Sphinx, env: BuildEnvironment, node: pending_xref, text: Element) -> Element | None:
    """Return a link to what a name means in the module that uses it, plain text if that is not described anywhere."""
    head, _, rest = node["reftarget"].partition(".")
    module = sys.modules.get(node.get("py:module") or "")
    if node.get("refdomain") != "py" or not hasattr(module, head):
        return None
    meant = getattr(module, head)
    names = (getattr(meant, "__module__", ""), getattr(meant, "__qualname__", ""), rest)
    target = ".".join(filter(None, names))
    domain = env.domains.python_domain
    found = domain.resolve_xref(env, node["refdoc"], app.builder, node["reftype"], target, node, text)
    return text if found is None else found
