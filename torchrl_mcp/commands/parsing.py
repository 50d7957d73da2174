"""What the commands share: entry points, parsers and options.

This module imports neither torch nor MuJoCo nor Hydra, which take seconds to import.
"""

import argparse
import math
import os
import select
import sys
import textwrap
from collections.abc import Callable, Iterator, Sequence
from functools import wraps
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol, cast

import yaml  # type: ignore[import-untyped]

from torchrl_mcp import __version__
from torchrl_mcp.runs.quoting import quoted

CHECKPOINT = "run folder (its newest checkpoint), checkpoint file, builtin:CHARACTER or builtin:CHARACTER-TASK"
"""Help of an argument that names a policy."""

BROKEN_PIPE = 141
"""Exit status of a program whose output nobody reads any more, as in a shell: 128 and the number of SIGPIPE."""

RESERVED = ("seed", "num_envs", "device", "episodes", "path")
"""Arguments of tasks that the commands pass, so that ``--task`` must not."""


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


class EntryPoint(Protocol):
    """A command as a function."""

    def __call__(self, words: Sequence[str] | None = None) -> None:
        """Run the command.

        Args:
            words: The command line after the name of the command, or None for that of this process.
        """


def entry_point(program: str, *errors: type[Exception]) -> Callable[[Callable[[list[str]], None]], EntryPoint]:
    """Return a decorator that makes a function of the words of a command line the entry point of a command.

    The command ends with a sentence if it is interrupted or its input is bad. In Python's development mode (``-X dev``)
    bad input ends it with a traceback. A reader that closes the command's output, such as ``head``, ends it silently.

    Args:
        program: Name of the command.
        errors: Errors, beside OSError, ValueError and YAML's, that are due to the command's input.
    """

    def decorate(main: Callable[[list[str]], None]) -> EntryPoint:
        @wraps(main)
        def run(words: Sequence[str] | None = None) -> None:
            try:
                try:
                    main(list(sys.argv[1:] if words is None else words))
                finally:
                    sys.stdout.flush()
            except KeyboardInterrupt:
                sys.exit(f"\n{program}: interrupted")
            except (OSError, ValueError, yaml.YAMLError, *errors) as error:
                if isinstance(error, BrokenPipeError) and _is_output_closed():
                    sys.exit(BROKEN_PIPE)
                if sys.flags.dev_mode:
                    raise
                if isinstance(error, yaml.YAMLError):
                    sys.exit(f"{program}: settings must be YAML: {' '.join(str(error).split())}")
                sys.exit(f"{program}: {error}")

        return run

    return decorate


def _is_output_closed() -> bool:
    """Return whether the reader of standard output is gone; if so, discard the output that is left."""
    pipe = sys.stdout.fileno()
    pipes = select.poll()
    pipes.register(pipe, 0)
    closed = any(event & select.POLLERR for _, event in pipes.poll(0))
    if closed:
        os.dup2(os.open(os.devnull, os.O_WRONLY), pipe)  # Python flushes again when it ends
    return closed


def announce(program: str) -> None:
    """Print that a command is importing its libraries, which takes seconds without other output."""
    print(f"{program} {__version__}: loading PyTorch and MuJoCo ...", file=sys.stderr, flush=True)


def find_own_modules() -> None:
    """Add the working directory to Python's module path, after everything but a clone of this library.

    A clone that is installed editable also offers the names ``envs`` and ``conf``.
    """
    if os.getcwd() in sys.path:
        return
    clone = str(Path(__file__).parents[2])
    is_last = clone in sys.path and Path(clone, "pyproject.toml").is_file()
    sys.path.insert(sys.path.index(clone) if is_last else len(sys.path), os.getcwd())


def own_settings(folder: Path | None) -> list[str]:
    """Return the settings by which Hydra finds a folder of the user's settings, and make the user's modules importable.

    Args:
        folder: The folder, or None for no settings.

    Raises:
        ValueError: If there is no such folder.
    """
    if folder is None:
        return []
    if not folder.is_dir():
        raise ValueError(f"there is no folder {folder}: correct --config-dir")
    find_own_modules()
    return [f"hydra.searchpath=[{quoted(f'file://{folder.resolve()}')}]"]


def own_module(name: str) -> str:
    """Return the name of a trusted module, after making the working directory's modules importable.

    Raises:
        ArgumentTypeError: If the text is not the name of a module.
    """
    if not all(part.isidentifier() for part in name.split(".")):
        raise argparse.ArgumentTypeError(f"{name!r} is not the name of a module: write --trust MODULE, such as walker")
    find_own_modules()
    return name


def count(text: str) -> int:
    """Return a number of at least 1."""
    return _whole(text, 1, None)


def index(text: str) -> int:
    """Return a number of at least 0."""
    return _whole(text, 0, None)


def seconds(text: str) -> float:
    """Return a duration."""
    try:
        duration = float(text)
    except ValueError:
        duration = 0.0
    if not 0 < duration < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} must be a duration: pass more than 0 seconds")
    return duration


def seed(text: str) -> int:
    """Return a seed that all generators take."""
    return _whole(text, 0, 2**32 - 1)


def port(text: str) -> int:
    """Return a port, 0 for any."""
    return _whole(text, 0, 65535)


def _whole(text: str, low: int, high: int | None) -> int:
    if not text.isdecimal() or int(text) < low or (high is not None and int(text) > high):
        limits = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise argparse.ArgumentTypeError(f"{text!r} must be a whole number {limits}")
    return int(text)


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--trust``."""
    parser.add_argument(
        "--trust",
        type=own_module,
        action="append",
        default=[],
        metavar="MODULE",
        help="allow the checkpoint's configuration to call classes and functions of this module of yours, which may be "
        "in the working directory; repeatable (default: a checkpoint runs only the library's code)",
    )


def take_trust(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the modules that a command line trusts, and the command line without them.

    Raises:
        ValueError: If ``--trust`` lacks the name of a module.
    """
    with_names, kept = _split_trust(words)
    try:
        return [own_module(name) for name in with_names], kept
    except argparse.ArgumentTypeError as error:
        raise ValueError(str(error)) from error


def _split_trust(words: list[str]) -> tuple[list[str], list[str]]:
    """Return the words that follow ``--trust``, and the other words."""
    trusted = []
    kept = []
    rest = iter(words)
    for word in rest:
        if word == "--trust":
            trusted.append(next(rest, ""))
        elif word.startswith("--trust="):
            trusted.append(word.removeprefix("--trust="))
        else:
            kept.append(word)
    return trusted, kept


def add_task(parser: argparse.ArgumentParser) -> None:
    """Add the option ``--task``, whose words :func:`task_settings` reads, and list its keys below the options."""
    parser.add_argument(
        "--task",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="argument of the task, listed below; repeatable",
    )
    lines = [f"{task}: {', '.join(names)}" for task, names in _task_arguments()]
    listed = "\n".join(textwrap.fill(line, 110, initial_indent="  ", subsequent_indent="    ") for line in lines)
    parser.epilog = f"arguments of the tasks (--task):\n{listed}\n\n{parser.epilog or ''}"


def task_settings(words: list[str]) -> dict[str, Any]:
    """Return the values of ``--task KEY=VALUE`` by key; a dot in a key leads to an entry of an argument.

    Raises:
        ValueError: If a word cannot be read, has no value, or names an argument that the command passes.
    """
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    if valueless := [word for word in words if "=" not in word]:
        raise ValueError(f"--task {valueless[0]} has no value: write --task {valueless[0]}=VALUE")
    try:
        config = OmegaConf.from_dotlist(words)
    except (OmegaConfBaseException, LookupError) as error:
        raise ValueError(f"--task {' '.join(words)} cannot be read: {' '.join(str(error).split())}") from error
    settings = cast("dict[str, Any]", OmegaConf.to_container(config))
    if unread := [name for name in RESERVED if name in settings]:
        raise ValueError(
            f"--task {unread[0]} would have no effect: use the options of this command, which --help lists"
        )
    return settings


def settings(name: str) -> dict[str, Any]:
    """Return the content of a file of ``conf``, ``train`` or ``task/heading``, as it is written."""
    return yaml.safe_load(files("torchrl_mcp.conf").joinpath(f"{name}.yaml").read_text(encoding="utf-8"))


def choices(group: str) -> list[str]:
    """Return the choices of a group of settings."""
    names = (file.name for file in files("torchrl_mcp.conf").joinpath(group).iterdir())
    return sorted(name.removesuffix(".yaml") for name in names if name.endswith(".yaml") and name != "base.yaml")


def _task_arguments() -> Iterator[tuple[str, list[str]]]:
    """Yield each task with its arguments, from its evaluation in ``conf/task``."""
    for name in choices("task"):
        content = settings(f"task/{name}")
        shared = [entry[1:].partition("@")[0] for entry in content["defaults"] if str(entry).startswith("/")]
        parts = [content.get("task", content), *map(settings, shared)]
        yield name, sorted(argument for part in parts for argument in part.get("evaluation", ()))
