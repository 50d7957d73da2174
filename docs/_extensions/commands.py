"""The page of all commands with all their options, ``commands.md``, made of their parsers when Sphinx starts."""

import argparse
import re
import tomllib
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "commands.md"


def setup(app: Sphinx) -> dict[str, Any]:
    """Write the page before pages are read."""
    app.connect("builder-inited", lambda _: write())
    return {"parallel_read_safe": True}


def write() -> None:
    """Write the page, if it has changed."""
    if not PAGE.exists() or PAGE.read_text() != page():
        PAGE.write_text(page())


def page() -> str:
    """Return the page, in Markdown."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    parts = ["# Commands", "Generated from the commands themselves; each shows the same with `--help`."]
    for name, target in scripts.items():
        parts += section(import_module(target.partition(":")[0]).parser(), f"## {name}")
    return "\n\n".join(parts) + "\n"


def section(parser: argparse.ArgumentParser, heading: str) -> Iterator[str]:
    """Yield the paragraphs about a command and its subcommands."""
    yield heading
    if parser.description:
        yield parser.description
    rows = [f"| {name(action)} | {meaning(action)} |" for action in parser._actions if shown(action)]
    if rows:
        yield "\n".join(["| argument | |", "|---|---|", *rows])
    if parser.epilog:
        yield f"```text\n{parser.epilog.rstrip()}\n```"
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            helps = {choice.dest: choice.help for choice in action._choices_actions}
            for command, subparser in action.choices.items():
                subparser.description = subparser.description or f"{helps[command][:1].upper()}{helps[command][1:]}."
                yield from section(subparser, f"### {parser.prog} {command}")


def shown(action: argparse.Action) -> bool:
    """Whether an argument is not one that all commands have, or the choice of a subcommand."""
    return not isinstance(action, argparse._HelpAction | argparse._VersionAction | argparse._SubParsersAction)


def name(action: argparse.Action) -> str:
    """Return how an argument is written."""
    value = action.metavar or (action.dest.upper() if action.nargs != 0 else "")
    if action.choices:
        value = "{" + ",".join(map(str, action.choices)) + "}"
    words = ", ".join(action.option_strings)
    return f"`{' '.join(filter(None, [words, value if action.nargs != 0 else '']))}`"


def meaning(action: argparse.Action) -> str:
    """Return the help of an argument for a cell of a table."""
    text = ((action.help or "") % vars(action)).replace("|", r"\|")
    return re.sub(r"(?<![`\w/])(--?[a-z][a-z-]*(?:=[\w-]+| \w+=\w+)?)", r"`\1`", text)
