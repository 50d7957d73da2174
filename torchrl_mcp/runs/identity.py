"""The identity of a run: which settings make it a different run, and which only change how or where it is made.

A setting is written as its path in the configuration. A path includes all settings below it.
"""

import hashlib
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from torchrl_mcp.runs.places import BUILTIN, digest, placeless

CONDUCT = frozenset(
    {
        *("checkpoint_interval", "collector", "device", "keep_checkpoints", "logger"),
        *("num_threads", "progress_bar", "record_interval", "recorder", "resume", "torch_threads"),
    }
)
"""Settings of how a run is executed: they make no other run. A resumed run keeps its own, except for ``device``."""

PLACES = frozenset({"pretrained", "run_dir", "run_root"})
"""Settings of where a run is stored, and where its transferred parts come from.

They make no other run, but the content of ``pretrained`` does: see :mod:`torchrl_mcp.runs.places`.
"""

LEVELS = ("task", "character", "stage", "method", "seed")
"""Settings that are a level each of the path of a run folder."""

UNNAMED = CONDUCT | PLACES | {*LEVELS, "autocast", "evaluation.episodes", "evaluation.seed"}
"""Settings that are not in the name of a run folder, for the resolver ``unnamed`` of ``conf/train.yaml``."""

ENVIRONMENTS = frozenset(
    {"benchmark", "evaluation", "imitation", "motions", "curriculum", "task.evaluation", "task.curriculum"}
)
"""Settings that do not affect training, or environments of some stages only; ``task`` holds those of the stage."""

UNLEARNT = CONDUCT | PLACES | ENVIRONMENTS | {"autocast", "seed"}
"""Settings that are ignored when results are compared: runs that differ only in them are averaged."""

PRETRAINING = frozenset({"imitation", "motions"})
"""Settings of :data:`UNLEARNT` that a transfer learns from if it keeps networks: those of their pre-training."""

TRANSFER_ONLY = frozenset(
    {
        *("budget.scratch", "budget.transfer", "curriculum", "exploration", "goal_positions"),
        *("pretrained", "transfer", "waypoint"),
    }
)
"""Settings that pre-training ignores or refuses."""

LONGEST = 100
"""Most characters of a folder's name, below the 255 bytes of common file systems."""

LEFT_OPEN = {"autocast": "auto"}
"""Values that leave a setting to the machine: any other value counts as equal."""


def is_among(name: str, settings: Collection[str]) -> bool:
    """Return whether a setting is one of ``settings``, or below one.

    >>> is_among("logger.logger_type", {"logger"}), is_among("loggers", {"logger"})
    (True, False)
    """
    return any(name == setting or name.startswith(f"{setting}.") for setting in settings)


def differences(
    held: Mapping[str, Any], wanted: Mapping[str, Any], ignored: Collection[str] = CONDUCT | {"run_dir", "run_root"}
) -> list[str]:
    """Return the top-level settings in which two configurations differ, so that they are different runs.

    Paths of files and folders count as equal.

    >>> differences({"seed": 0, "device": "cpu"}, {"seed": 1, "device": "cuda"})
    ['seed']
    """
    agreed = {*ignored, *(key for key, value in LEFT_OPEN.items() if wanted.get(key) == value)}
    keys = [key for key in dict.fromkeys([*held, *wanted]) if key not in agreed]
    return [key for key in keys if placeless({key: held.get(key)}) != placeless({key: wanted.get(key)})]


def folder_name(overrides: str, pretrained: str | None) -> str:
    """Return the name of the folder of a run's settings, for the resolver ``folder_name`` of ``conf/train.yaml``.

    Args:
        overrides: The settings on the command line, as Hydra joins them.
        pretrained: Networks that the run begins with; those on the disk are named by their :func:`.places.digest`.

    >>> folder_name("preset-smoke", None)
    'preset-smoke'
    >>> folder_name("motions.path-../clips", None)
    'motions.path-..-clips'
    """
    if pretrained is not None and pretrained != BUILTIN:
        path = Path(pretrained)
        mark = digest(path) if path.exists() else _hash(pretrained)
        overrides = "_".join(filter(None, (overrides, f"pretrained-{mark}")))
    overrides = re.sub(r"[/\\]", "-", overrides)  # of paths
    if len(overrides.encode()) <= LONGEST:
        return overrides
    return f"{overrides.encode()[: LONGEST - 9].decode(errors='ignore')}-{_hash(overrides)}"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]
