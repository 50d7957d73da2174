"""Pages of the repository, shown here too: their links are relative to where they stand there."""

import re
from os.path import normpath, relpath
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

PAGES = {
    "../README.md": "/index.md",
    "../benchmarks/README.md": "/benchmarks.md",
    "../CONTRIBUTING.md": "/contributing.md",
    "../CHANGELOG.md": "/changelog.md",
}
"""Where each of them is shown, relative to this folder."""

LINK = re.compile(r"(?<=\]\()(?![a-z]+:|#|/)([^)#\s]+)(#[^)\s]*)?(?=\))")


def setup(app: Sphinx) -> dict[str, Any]:
    """Correct links as pages are included."""
    app.connect("include-read", correct)
    return {"parallel_read_safe": True}


def correct(app: Sphinx, path: Path, page: str, content: list[str]) -> None:
    """Replace the links in an included page, in place: to where a page is shown, or to the file itself."""

    def replacement(match: re.Match[str]) -> str:
        target = normpath(path.parent / match[1])
        shown = target.removeprefix("../docs/") if target.startswith("../docs/") else relpath(target, ".")
        return PAGES.get(target, f"/{shown}") + (match[2] or "")

    content[0] = LINK.sub(replacement, content[0])
