"""The command line that all commands share. It imports neither torch nor MuJoCo nor Hydra, which take seconds."""

import argparse
import os
import sys

from torchrl_mcp import __version__


def new_parser(program: str, description: str, examples: str = "") -> argparse.ArgumentParser:
    """Return the parser of a command, which has ``--version``.

    Args:
        program: Name of the command.
        description: What it does, in a sentence.
        examples: What follows the options, printed as it is.
    """
    parser = argparse.ArgumentParser(
        prog=program, description=description, epilog=examples, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--version", action="version", version=f"{program} {__version__}")
    return parser


def find_own_modules() -> None:
    """Let Python find modules of the folder from which a command is called, after all others."""
    sys.path.append(os.getcwd())


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--trust``."""
    parser.add_argument(
        "--trust",
        action="append",
        default=[],
        metavar="MODULE",
        help="let the checkpoint's configuration build what this module of yours defines; repeatable. Without it a "
        "checkpoint runs no code but the library's",
    )


def take_trust(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the modules that a command line trusts, and the command line without them."""
    trusted, others, rest = [], [], iter(words)
    for word in rest:
        if word == "--trust":
            trusted.append(next(rest, ""))
        elif word.startswith("--trust="):
            trusted.append(word.removeprefix("--trust="))
        else:
            others.append(word)
    return trusted, others


def announce(program: str) -> None:
    """Say that a command is about to import its libraries, which takes seconds in which nothing else is to be seen."""
    print(f"{program} {__version__}: loading PyTorch and MuJoCo ...", file=sys.stderr, flush=True)
