"""Reads configurations from files, and checks which classes and functions they may call.

A configuration names classes and functions that are called. A checkpoint or run folder may come from a stranger.
Its configuration may therefore name only what the configurations of this library name, and what the user trusts.
"""

import pkgutil
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from glob import glob
from importlib.resources import files
from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from torchrl_mcp.runs import quoting
from torchrl_mcp.runs.settings import leaves
from torchrl_mcp.training.run_folder import CONFIG

LARGEST = 2**20
"""Most bytes of a configuration file. The configuration of a run has about ten thousand bytes."""

DEEPEST = 100
"""Deepest nesting of settings in a configuration file. In the configuration of a run, the depth is about five."""

GET_CLASS = "hydra.utils.get_class"
"""Hydra's function that returns a class, for configurations that pass a class as an argument."""


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The parser in C, which takes a tenth of the time of the one in Python, with an error for repeated names."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        mapping = super().construct_mapping(node, deep=deep)
        if len(mapping) < len(node.value):
            raise yaml.YAMLError("a name occurs twice")
        return mapping


_trusted: ContextVar[frozenset[str]] = ContextVar("trusted", default=frozenset())


@contextmanager
def trusting(names: Iterable[str]) -> Iterator[None]:
    """Trust further names in configurations from files during the block.

    Args:
        names: Names of classes and functions, and names of modules, which stand for everything that they define.
    """
    token = _trusted.set(_trusted.get() | set(names))
    try:
        yield
    finally:
        _trusted.reset(token)


def targets(config: Any) -> Iterator[str]:
    """Yield the names of all classes, functions and modules in a configuration, in their order."""
    settings = list(leaves(config))
    classes = {name.rpartition(".")[0] for name, value in settings if value == GET_CLASS}
    for name, value in settings:
        group, _, key = name.rpartition(".")
        if isinstance(value, str) and (key in ("module", "_target_") or (key == "path" and group in classes)):
            yield value


@cache
def library_names() -> frozenset[str]:
    """Return the names of all classes and functions in the files of ``conf``, except names that the user must give."""
    pattern = str(files("torchrl_mcp.conf").joinpath("**/*.yaml"))
    contents = (yaml.safe_load(Path(path).read_text(encoding="utf-8")) or {} for path in glob(pattern, recursive=True))
    settings = ({key: value for key, value in content.items() if key != "hydra"} for content in contents)
    names = (name for setting in settings for name in targets(setting))
    return frozenset(name for name in names if all(map(str.isidentifier, name.split("."))))


def require_trusted(config: Mapping[str, Any], source: Path) -> None:
    """Check, before anything is imported, that a configuration names only trusted classes and functions.

    Args:
        config: The configuration.
        source: The file of the configuration.

    Raises:
        ValueError: If a name is not trusted, or there is an interpolation, which could read environment variables.
    """
    if name := next((name for name in targets(config) if not _may_be_built(name)), None):
        raise ValueError(
            f"{source} would run {name}, which no configuration of this library names. If you trust the file and this "
            f"code, pass --trust {name.rpartition('.')[0] or name}"
        )
    if any("${" in f"{name}{value}" for name, value in leaves(config)):
        raise ValueError(
            f"{source} has been changed: it contains an interpolation, which training never writes. Do not use it"
        )


def trust_options(path: Path) -> list[str]:
    """Return the options ``--trust MODULE`` that commands need for the run with a configuration file."""
    names = [name for name in targets(read_config(path)) if name not in library_names()]
    modules = dict.fromkeys(name.rpartition(".")[0] or name for name in names)
    return [word for module in modules for word in ("--trust", module)]


def resuming(run: Path) -> str:
    """Return the command that continues the run in a folder."""
    return quoting.command("train", *trust_options(run / CONFIG), quoting.setting("resume", run))


def read_config(path: Path) -> dict[str, Any]:
    """Return the configuration in a YAML file, with unresolved interpolations.

    Raises:
        ValueError: If the file is not a configuration, is too large, contains YAML aliases or is nested too deeply.
        OSError: If the file cannot be read.
    """
    if path.stat().st_size > LARGEST:
        raise ValueError(f"{path} has more than {LARGEST} bytes: it cannot be a configuration")
    try:
        text = path.read_text(encoding="utf-8")
        _require_plain(text, path)
        config = yaml.load(text, _Loader)
    except (yaml.YAMLError, RecursionError, UnicodeDecodeError) as error:
        first = str(error).partition("\n")[0] or type(error).__name__
        raise ValueError(f"{path} is not a configuration: {first}") from error
    if not isinstance(config, dict):
        raise ValueError(f"{path} is not a configuration: it contains no settings")
    return config


def _require_plain(text: str, path: Path) -> None:
    """Check that loading a text needs neither much memory nor a deep stack, which the parser in C does not limit.

    Raises:
        ValueError: If the text has aliases, of which a few lines could expand to more than the memory, or is nested too
            deeply.
    """
    depth = 0
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"{path} has been changed: it contains YAML aliases, which training never writes")
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise ValueError(f"{path} is not a configuration: it is nested more than {DEEPEST} deep")


def _may_be_built(name: str) -> bool:
    """Return whether a configuration from a file may contain a name. Only trusted modules are imported."""
    trusted = _trusted.get()
    if name in library_names() | trusted:
        return True
    if not _is_in(name, trusted):
        return False
    try:
        # Trust does not extend to names that a trusted module imports from other modules.
        return _is_in(f"{pkgutil.resolve_name(name).__module__}.", trusted)
    except (ImportError, AttributeError, ValueError):
        return True  # a name that does not exist cannot be called


def _is_in(name: str, modules: Collection[str]) -> bool:
    return any(name.startswith(f"{module}.") for module in modules)
