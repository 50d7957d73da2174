"""Defines which settings identify a run, and which only change how or where the run is executed.

A setting is written as its path in the configuration. A path includes all settings below it.
"""

import hashlib
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_mcp.runs.places import BUILTIN, digest, placeless


class Setting(NamedTuple):
    """The role of a setting, and of all settings below it.

    Attributes:
        identifies: Whether runs that differ in the setting are different runs. If so, a resumed run keeps the setting.
        named: Whether the name of the run folder contains the setting.
        learnt: Whether the setting affects learning. If so, results of runs that differ in it are not averaged.
        pretraining: Whether pre-training uses the setting. If not, pre-training ignores or refuses it.
    """

    identifies: bool = True
    named: bool = True
    learnt: bool = True
    pretraining: bool = True


EXECUTION = Setting(identifies=False, named=False, learnt=False)
"""The role of settings that only change how or where a run is executed."""

SETTINGS = {
    **dict.fromkeys(("checkpoint_interval", "collector", "device", "keep_checkpoints", "logger"), EXECUTION),
    **dict.fromkeys(("num_threads", "progress_bar", "record_interval", "recorder", "resume"), EXECUTION),
    **dict.fromkeys(("run_dir", "run_root", "torch_threads"), EXECUTION),
    # Each of these is a level of the path of a run folder.
    **dict.fromkeys(("task", "character", "stage", "method"), Setting(named=False)),
    "seed": Setting(named=False, learnt=False),
    # The content of the networks is part of the folder's name and of the run's record, see :func:`folder_name`.
    "pretrained": Setting(named=False, learnt=False, pretraining=False),
    "autocast": Setting(named=False, learnt=False),
    **dict.fromkeys(("evaluation.episodes", "evaluation.seed"), Setting(named=False, learnt=False)),
    # These have no effect on training, or concern the environments of one stage, which ``task`` also contains.
    **dict.fromkeys(("benchmark", "evaluation", "imitation", "motions"), Setting(learnt=False)),
    **dict.fromkeys(("task.evaluation", "task.curriculum"), Setting(learnt=False)),
    "curriculum": Setting(learnt=False, pretraining=False),
    **dict.fromkeys(("budget.scratch", "budget.transfer", "exploration"), Setting(pretraining=False)),
    **dict.fromkeys(("goal_positions", "transfer", "waypoint"), Setting(pretraining=False)),
}
"""The roles of settings. A setting that is missing here has all four: it is a ``Setting()``."""

SAME_RUN = frozenset(name for name, setting in SETTINGS.items() if not setting.identifies)
"""Settings that do not identify a run."""

UNNAMED = frozenset(name for name, setting in SETTINGS.items() if not setting.named)
"""Settings that the name of a run folder does not contain."""

UNLEARNT = frozenset(name for name, setting in SETTINGS.items() if not setting.learnt)
"""Settings that do not affect learning."""

TRANSFER_ONLY = frozenset(name for name, setting in SETTINGS.items() if not setting.pretraining)
"""Settings that pre-training does not use."""

PRETRAINING = frozenset({"imitation", "motions"})
"""Settings of :data:`UNLEARNT` that affect a transfer through the pre-training of the networks that it keeps."""

LONGEST = 100
"""Largest number of characters of a folder's name, below the 255 bytes of common file systems."""

AUTOMATIC = {"autocast": "auto"}
"""Values that let the machine choose a setting; every other value of the setting counts as equal to them."""


def is_among(name: str, settings: Collection[str]) -> bool:
    """Return whether a setting is one of ``settings``, or below one of them.

    >>> is_among("logger.logger_type", {"logger"}), is_among("loggers", {"logger"})
    (True, False)
    """
    return any(name == setting or name.startswith(f"{setting}.") for setting in settings)


def differences(saved: Mapping[str, Any], wanted: Mapping[str, Any], ignored: Collection[str] = SAME_RUN) -> list[str]:
    """Return the top-level settings that make two configurations different runs.

    Paths of files and folders count as equal.

    >>> differences({"seed": 0, "device": "cpu"}, {"seed": 1, "device": "cuda"})
    ['seed']
    """
    agreed = {*ignored, *(key for key, value in AUTOMATIC.items() if wanted.get(key) == value)}
    keys = [key for key in dict.fromkeys([*saved, *wanted]) if key not in agreed]
    return [key for key in keys if placeless({key: saved.get(key)}) != placeless({key: wanted.get(key)})]


def folder_name(overrides: str, pretrained: str | None) -> str:
    """Return the part of a run folder's path that names its settings, for the resolver ``folder_name`` in ``conf``.

    Args:
        overrides: The settings on the command line, as Hydra joins them.
        pretrained: Initial networks of the run; a file or folder is represented by its :func:`.places.digest`.

    >>> folder_name("preset-smoke", None)
    'preset-smoke'
    >>> folder_name("motions.path-../clips", None)
    'motions.path-..-clips'
    """
    if pretrained is not None and pretrained != BUILTIN:
        path = Path(pretrained)
        mark = digest(path) if path.exists() else _hash(pretrained)
        overrides = "_".join(filter(None, (overrides, f"pretrained-{mark}")))
    overrides = re.sub(r"[/\\]", "-", overrides)  # values may be paths
    if len(overrides.encode()) <= LONGEST:
        return overrides
    return f"{overrides.encode()[: LONGEST - 9].decode(errors='ignore')}-{_hash(overrides)}"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:8]
