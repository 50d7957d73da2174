"""Parsing that all commands share. It imports neither torch nor MuJoCo nor Hydra, which take seconds."""

import argparse
import os
import sys

from torchrl_mcp import __version__


def new_parser(program: str, description: str, examples: str = "") -> argparse.ArgumentParser:
    """Return the parser of a command, with ``--version``.

    Args:
        program: Name of the command.
        description: Description of the command in a sentence.
        examples: Text after the options, printed verbatim.
    """
    parser = argparse.ArgumentParser(
        prog=program, description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"{program} {__version__}")
    return parser


def find_own_modules() -> None:
    """Append the working directory to Python's module path."""
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())


def own_module(name: str) -> str:
    """Return the name of a trusted module, after making the working directory's modules importable."""
    find_own_modules()
    return name


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--trust``."""
    parser.add_argument(
        "--trust",
        type=own_module,
        action="append",
        default=[],
        metavar="MODULE",
        help="let the checkpoint's configuration call classes and functions of this module of yours, "
        "which may be in the working directory; repeatable. "
        "Without it, a checkpoint runs only the library's code",
    )


def take_trust(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the modules that a command line trusts, and the command line without them."""
    trusted, others, rest = [], [], iter(words)
    for word in rest:
        if word == "--trust":
            trusted.append(own_module(next(rest, "")))
        elif word.startswith("--trust="):
            trusted.append(own_module(word.removeprefix("--trust=")))
        else:
            others.append(word)
    return trusted, others


def announce(program: str) -> None:
    """Print that a command is importing its libraries, which takes seconds without other output."""
    print(f"{program} {__version__}: loading PyTorch and MuJoCo ...", file=sys.stderr, flush=True)
