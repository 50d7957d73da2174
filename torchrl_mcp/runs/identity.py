"""The identity of a run: which settings make it a different run, and which only change how or where it is made.

A setting is written as its path in the configuration. A path includes all settings below it.
"""

import hashlib
import re
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from torchrl_mcp.runs.places import BUILTIN, digest, placeless


class Setting(NamedTuple):
    """What a setting says about a run. It holds for all settings below it.

    Attributes:
        identifies: Runs that differ in it are different runs, so a resumed run keeps it.
        named: It is in the name of the run folder.
        learnt: It affects what is learned: results of runs that differ in it are not averaged.
        pretraining: Pre-training uses it. If it does not, pre-training ignores or refuses it.
    """

    identifies: bool = True
    named: bool = True
    learnt: bool = True
    pretraining: bool = True


EXECUTION = Setting(identifies=False, named=False, learnt=False)
"""How or where a run is executed."""

SETTINGS = {
    **dict.fromkeys(("checkpoint_interval", "collector", "device", "keep_checkpoints", "logger"), EXECUTION),
    **dict.fromkeys(("num_threads", "progress_bar", "record_interval", "recorder", "resume"), EXECUTION),
    **dict.fromkeys(("run_dir", "run_root", "torch_threads"), EXECUTION),
    # A level each of the path of a run folder.
    **dict.fromkeys(("task", "character", "stage", "method"), Setting(named=False)),
    "seed": Setting(named=False, learnt=False),
    # The folder's name and the run's record have the content of the networks, see :func:`folder_name`.
    "pretrained": Setting(named=False, learnt=False, pretraining=False),
    "autocast": Setting(named=False, learnt=False),
    **dict.fromkeys(("evaluation.episodes", "evaluation.seed"), Setting(named=False, learnt=False)),
    # Of no effect on training, or environments of some stages only: ``task`` holds those of the stage.
    **dict.fromkeys(("benchmark", "evaluation", "imitation", "motions"), Setting(learnt=False)),
    **dict.fromkeys(("task.evaluation", "task.curriculum"), Setting(learnt=False)),
    "curriculum": Setting(learnt=False, pretraining=False),
    **dict.fromkeys(("budget.scratch", "budget.transfer", "exploration"), Setting(pretraining=False)),
    **dict.fromkeys(("goal_positions", "transfer", "waypoint"), Setting(pretraining=False)),
}
"""The settings that are not all of it: any other identifies a run, is in its name, is learned from, in both stages."""

SAME_RUN = frozenset(name for name, setting in SETTINGS.items() if not setting.identifies)
UNNAMED = frozenset(name for name, setting in SETTINGS.items() if not setting.named)
UNLEARNT = frozenset(name for name, setting in SETTINGS.items() if not setting.learnt)
TRANSFER_ONLY = frozenset(name for name, setting in SETTINGS.items() if not setting.pretraining)

PRETRAINING = frozenset({"imitation", "motions"})
"""Settings of :data:`UNLEARNT` that a transfer learns from if it keeps networks: those of their pre-training."""

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


def differences(held: Mapping[str, Any], wanted: Mapping[str, Any], ignored: Collection[str] = SAME_RUN) -> list[str]:
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
