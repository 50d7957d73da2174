"""What identifies a run: which settings make it another run, and which only say how, where or from what it is made.

A setting is named by its path in the configuration. A path stands for all settings below it as well.
"""

from collections.abc import Collection, Mapping
from typing import Any

CONDUCT = frozenset(
    {
        *("checkpoint_interval", "collector", "device", "keep_checkpoints", "logger"),
        *("num_threads", "progress_bar", "record_interval", "recorder", "resume", "torch_threads"),
    }
)
"""How a run is carried out. They may change while it is interrupted."""

PLACES = frozenset({"pretrained", "run_dir", "run_root"})
"""Where a run lies, and where the parts that it transfers come from."""

LEVELS = ("task", "character", "stage", "method", "seed")
"""Settings that have a level of their own in the path of a run folder."""

UNNAMED = CONDUCT | PLACES | {*LEVELS, "autocast", "evaluation.episodes", "evaluation.seed"}
"""Settings that the name of a run folder leaves out: ``exclude_keys`` of ``conf/train.yaml``."""

ENVIRONMENTS = frozenset(
    {"benchmark", "evaluation", "imitation", "motions", "practice", "task.evaluation", "task.practice"}
)
"""What configures no training, or environments that only some stages have: what a stage has of them is in ``task``."""

UNLEARNT = CONDUCT | PLACES | ENVIRONMENTS | {"autocast", "seed"}
"""Settings that tell no runs apart where results are compared: runs that differ in them alone are averaged."""

TRANSFER_ONLY = frozenset(
    {"budget.scratch", "budget.transfer", "exploration", "practice", "pretrained", "transfer.freeze", "transfer.keep"}
)
"""Settings that make no difference to pre-training, or that it refuses."""

LEFT_OPEN = {"autocast": "auto"}
"""Values that leave a setting to the machine, so that any value agrees with them."""


def is_among(name: str, settings: Collection[str]) -> bool:
    """Tell whether a setting is one of ``settings``, or below one.

    >>> is_among("logger.logger_type", {"logger"}), is_among("loggers", {"logger"})
    (True, False)
    """
    return any(name == setting or name.startswith(f"{setting}.") for setting in settings)


def differences(held: Mapping[str, Any], wanted: Mapping[str, Any], ignored: Collection[str] = CONDUCT) -> list[str]:
    """Return the settings at the top of two configurations that make two runs of them.

    >>> differences({"seed": 0, "device": "cpu"}, {"seed": 1, "device": "cuda"})
    ['seed']
    """
    agreed = {*ignored, *(key for key, value in LEFT_OPEN.items() if wanted.get(key) == value)}
    keys = dict.fromkeys([*held, *wanted])
    return [key for key in keys if key not in agreed and held.get(key) != wanted.get(key)]
