"""The identity of a run: which settings make it a different run, and which only change how or where it is made.

A setting is written as its path in the configuration. A path includes all settings below it.
"""

from collections.abc import Collection, Mapping
from typing import Any

CONDUCT = frozenset(
    {
        *("checkpoint_interval", "collector", "device", "keep_checkpoints", "logger"),
        *("num_threads", "progress_bar", "record_interval", "recorder", "resume", "torch_threads"),
    }
)
"""Settings of how a run is executed: they make no other run. A resumed run keeps its own, except for ``device``."""

PLACES = frozenset({"pretrained", "run_dir", "run_root"})
"""Settings of where a run is stored, and where its transferred parts come from."""

LEVELS = ("task", "character", "stage", "method", "seed")
"""Settings that are a level each of the path of a run folder."""

UNNAMED = CONDUCT | PLACES | {*LEVELS, "autocast", "evaluation.episodes", "evaluation.seed"}
"""Settings that are not in the name of a run folder: ``exclude_keys`` of ``conf/train.yaml``."""

ENVIRONMENTS = frozenset(
    {"benchmark", "evaluation", "imitation", "motions", "curriculum", "task.evaluation", "task.curriculum"}
)
"""Settings that do not affect training, or environments of some stages only; ``task`` holds those of the stage."""

UNLEARNT = CONDUCT | PLACES | ENVIRONMENTS | {"autocast", "seed"}
"""Settings that are ignored when results are compared: runs that differ only in them are averaged."""

TRANSFER_ONLY = frozenset(
    {"budget.scratch", "budget.transfer", "exploration", "curriculum", "pretrained", "transfer.freeze", "transfer.keep"}
)
"""Settings that pre-training ignores or refuses."""

LEFT_OPEN = {"autocast": "auto"}
"""Values that leave a setting to the machine: any other value counts as equal."""


def is_among(name: str, settings: Collection[str]) -> bool:
    """Return whether a setting is one of ``settings``, or below one.

    >>> is_among("logger.logger_type", {"logger"}), is_among("loggers", {"logger"})
    (True, False)
    """
    return any(name == setting or name.startswith(f"{setting}.") for setting in settings)


def differences(held: Mapping[str, Any], wanted: Mapping[str, Any], ignored: Collection[str] = CONDUCT) -> list[str]:
    """Return the top-level settings in which two configurations differ, so that they are different runs.

    >>> differences({"seed": 0, "device": "cpu"}, {"seed": 1, "device": "cuda"})
    ['seed']
    """
    agreed = {*ignored, *(key for key, value in LEFT_OPEN.items() if wanted.get(key) == value)}
    keys = dict.fromkeys([*held, *wanted])
    return [key for key in keys if key not in agreed and held.get(key) != wanted.get(key)]
