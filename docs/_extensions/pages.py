"""Pages that run a policy in the browser: the directive ``page``, whose arguments are built-in networks."""

import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.util.docutils import SphinxDirective

LOGGER = logging.getLogger(__name__)
SOURCES = Path(__file__).parents[2] / "torchrl_mcp" / "viewer" / "page"


def setup(app: Sphinx) -> dict[str, Any]:
    """Add the directive, and the script that opens a page in place of its picture."""
    app.add_directive("page", Page)
    app.add_js_file("pages.js")
    return {"parallel_read_safe": False}


class Page(SphinxDirective):
    """A link to the page of built-in networks; the picture before it becomes the page at a click.

    Where npm or ONNX is missing, it shows the command that makes the page.
    """

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Write the page, unless the site has it."""
        first, *others = shlex.split(self.arguments[0])
        name = first.rpartition(":")[2]
        command = ["torchrl-mcp-export", first, *(f"--gate={other}" for other in others), f"--page={name}"]
        folder = Path(self.env.app.outdir) / "pages" / name
        if self.env.app.builder.format != "html" or not written(command, folder):
            return [nodes.literal_block("", shlex.join(command), language="bash")]
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6
        link = f'<p><a class="live-page" href="pages/{name}/index.html">Run it here ({size:.0f} MB)</a></p>'
        return [nodes.raw("", link, format="html")]


def written(command: list[str], folder: Path) -> bool:
    """Return whether the site has the page of a command, after trying to write it."""
    about = folder / "page.json"
    newest = max(file.stat().st_mtime for file in SOURCES.rglob("*"))
    same = about.exists() and json.loads(about.read_text())["command"] == shlex.join(command)
    if same and about.stat().st_mtime > newest:
        return True
    folder.parent.mkdir(parents=True, exist_ok=True)
    export = [sys.executable, "-m", "torchrl_mcp.commands.export", *command[1:]]
    done = subprocess.run(export, cwd=folder.parent, capture_output=True, text=True)
    if done.returncode:
        LOGGER.info("no page %s: %s", folder.name, done.stderr.strip().splitlines()[-1])
    return done.returncode == 0
