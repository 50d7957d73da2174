"""``torchrl-mcp-train``: train a method on a task, as a single run, a Hydra multirun or a benchmark."""

import argparse
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchrl_mcp.commands.parsing import (
    add_trust,
    announce,
    choices,
    entry_point,
    find_own_modules,
    new_parser,
    own_settings,
    take_trust,
)
from torchrl_mcp.training.run_folder import CONFIG
from torchrl_mcp.training.workers import end_with_parent_while_starting, termination_as_interrupt

if TYPE_CHECKING:
    from hydra.errors import HydraException
    from omegaconf import DictConfig

end_with_parent_while_starting()  # before the imports that take a worker seconds

PROGRAM = "torchrl-mcp-train"

VALUED = (
    *("-cd", "--config-dir", "-cn", "--config-name", "-cp", "--config-path", "-c", "--cfg", "-p", "--package"),
    *("-i", "--info", "--experimental-rerun"),
)
"""Options of Hydra whose value is the next word."""


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Run the command line; if Hydra cannot compose it, print what to write instead."""
    trusted, words = take_trust(words)
    if answered := {"--help", "-h", "--version"} & set(words):
        parser().parse_args(sorted(answered))
    from hydra.errors import HydraException

    from torchrl_mcp.commands.suggestions import answer
    from torchrl_mcp.runs.trust import trusting

    if any(word.startswith(("-cd", "--config-dir")) for word in words):
        find_own_modules()
    is_benchmark = any(word.startswith("benchmark=") for word in words)
    try:
        with trusting(trusted), termination_as_interrupt():
            run_benchmark(words) if is_benchmark else run(words)
    except HydraException as error:
        is_sweep = is_benchmark or not {"-m", "--multirun"}.isdisjoint(words)
        several = None if is_sweep else "add --multirun to train with each"
        sys.exit(f"{PROGRAM}: {answer(error, words, several=several)}")
    except AttributeError:
        if __debug__:
            raise
        sys.exit(
            f"{PROGRAM}: Hydra cannot read ranges and choices without assertions: unset PYTHONOPTIMIZE, or drop -O"
        )


def run(words: list[str]) -> None:
    """Let Hydra run :func:`train` once or for a sweep, print the configuration, or complete a command line.

    Raises:
        HydraException: If Hydra cannot compose the configuration.
    """
    import hydra

    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra raises exceptions, instead of printing them
    # hydra.main takes its words from sys.argv alone; the function below it, which takes arguments, is private.
    former = sys.argv
    sys.argv = [PROGRAM, *for_hydra(words)]
    try:
        hydra.main(version_base="1.3", config_path="pkg://torchrl_mcp.conf", config_name="train")(train)()
    finally:
        sys.argv = former


def for_hydra(words: list[str]) -> list[str]:
    """Return a command line as Hydra's parser takes it: all settings in one row, before the options.

    ``--cfg hydra`` drops the run's settings, so that ``--resolve`` would fail at references to them. Printing the
    package ``hydra`` of all settings does not drop them.
    """
    options: list[str] = []
    settings: list[str] = []
    for before, word in pairwise(["", *words]):
        (options if word.startswith("-") or before in VALUED else settings).append(word)
    printed = "--cfg=hydra" in words or any(pair in (("--cfg", "hydra"), ("-c", "hydra")) for pair in pairwise(words))
    if "--resolve" in words and printed:
        options += ["--cfg", "all", "--package", "hydra"]  # argparse takes the last value of an option
    return settings + options


def train(cfg: "DictConfig") -> float | None:
    """Train as configured, or continue ``cfg.resume``, and return the final return, which sweepers optimise.

    A run of a sweep raises its errors, for :class:`~torchrl_mcp.commands.sweep.Sweep`, and continues if it has begun.
    """
    announce(PROGRAM)
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode

    in_sweep = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    with _interruptible() if in_sweep else _explained(cfg):
        from torchrl_mcp.report.summary import final_return, summary
        from torchrl_mcp.runs import experiment

        begin = experiment.train_or_resume if in_sweep else experiment.train
        folder = _resume(cfg) if cfg.resume else begin(cfg)
    print(summary(folder), flush=True)
    return final_return(folder)


def _resume(cfg: "DictConfig") -> Path:
    """Continue the run in ``cfg.resume`` with the few settings that a run can change."""
    from hydra.core.hydra_config import HydraConfig
    from hydra.core.override_parser.overrides_parser import OverridesParser

    from torchrl_mcp.runs import experiment, places, records
    from torchrl_mcp.runs.trust import read_config

    folder = Path(cfg.resume)
    overrides = OverridesParser.create().parse_overrides(list(HydraConfig.get().overrides.task))
    values: dict[str, Any] = {override.key_or_group: override.value() for override in overrides}
    del values["resume"]
    device = values.pop("device", None)
    total_frames = values.pop("training.total_frames", None)
    files = places.outside(read_config(folder / CONFIG)) if (folder / CONFIG).is_file() else {}
    moves = {name: str(value) for name, value in values.items() if name in files}
    fixed = values.keys() - moves.keys()
    if ignored := [str(override.input_line) for override in overrides if override.key_or_group in fixed]:
        changeable = ["device", "training.total_frames", *files]
        raise ValueError(
            f"a resumed run keeps its settings, except for {', '.join(changeable)}: leave out {' '.join(ignored)}"
        )
    if records.is_complete(folder) and total_frames is None:
        print(f"{folder} is complete: there is nothing left to do; training.total_frames=N makes it longer")
    return experiment.resume(folder, device=device, total_frames=total_frames, moves=moves)


def run_benchmark(words: list[str]) -> None:
    """Run a benchmark, or continue it.

    Raises:
        HydraException: If Hydra cannot compose the configuration.
    """
    parser = argparse.ArgumentParser(PROGRAM, add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd", type=Path)
    parser.add_argument("--multirun", "-m", action="store_true")  # changes nothing: a benchmark is many runs
    options, settings = parser.parse_known_args(words)
    if unknown := [setting for setting in settings if setting.startswith("-")]:
        sys.exit(f"{PROGRAM}: a benchmark takes settings and --config-dir, but not {' '.join(unknown)}")
    settings += own_settings(options.config_dir)
    announce(PROGRAM)
    from torchrl_mcp.runs import benchmark

    with _interruptible():
        benchmark.main(settings)


@contextmanager
def _explained(cfg: "DictConfig") -> Iterator[None]:
    """End the command with a sentence if its run fails or is interrupted, in development mode with a traceback."""
    if sys.flags.dev_mode:
        yield
        return
    from hydra.errors import HydraException

    try:
        yield
    except ValueError as error:
        sys.exit(f"{PROGRAM}: {error}")
    except HydraException as error:
        sys.exit(f"{PROGRAM}: {'; '.join(str(error).splitlines())}{_place(error)}")
    except (OSError, FloatingPointError) as error:
        sys.exit(f"{PROGRAM}: {error}. {_what_is_safe(cfg)}")
    except KeyboardInterrupt:
        sys.exit(f"\n{PROGRAM}: interrupted. {_what_is_safe(cfg)}")


def _place(error: "HydraException") -> str:
    """Return the last line of code outside of installed packages at which an error of Hydra was raised."""
    frames = traceback.extract_tb(error.__cause__.__traceback__) if error.__cause__ else []
    outside = [frame for frame in frames if "site-packages" not in frame.filename]
    return f" ({outside[-1].filename}, line {outside[-1].lineno})" if outside else ""


@contextmanager
def _interruptible() -> Iterator[None]:
    """End a sweep or benchmark that is interrupted."""
    try:
        yield
    except KeyboardInterrupt:
        sys.exit(f"\n{PROGRAM}: interrupted; repeat the command to continue")


def _what_is_safe(cfg: "DictConfig") -> str:
    """Return a sentence about the saved state of a failed run and how to continue."""
    folder = Path(cfg.resume or cfg.run_dir)
    if not (folder / CONFIG).is_file():
        return "No run has begun: fix the cause and repeat the command"
    from torchrl_mcp.runs.trust import resuming

    return f"The run is safe up to its last checkpoint in {folder}: go on with {resuming(folder)}"


GROUPS = {
    **dict.fromkeys(("method", "mixer", "gating", "primitives"), ""),
    "task": "imitation is for pre-training; holdout, gymnasium and torchrl for both stages; all others for transfer",
    "character": "the ant does holdout only, none is for gymnasium and torchrl, and all others do all other tasks",
    "stage": "transfer needs pretrained=, except for the method scratch",
    "preset": "fast learns best; paper has the values of Tables 5 to 11; comparison gives all methods equal steps",
    "benchmark": "many runs, of several methods",
    "exploration": "action samples the composite action, weights samples the gate; MCP uses weights at transfer",
    "curriculum": "none trains with the episodes of the evaluation, mixed also with easier ones",
    "motions": "reference motions of imitation",
    "imitation": "reward of imitation",
    "physics": "engine of training episodes; warp runs on a GPU, and needs device=cuda and torchrl-mcp[warp]",
    **dict.fromkeys(("collector", "optimizer"), ""),
    "logger": "where metrics go, beside metrics.csv",
}
"""Meaning of the groups of settings that a user chooses; a method chooses the other groups."""

SETTINGS = {
    "run_dir=FOLDER": "run folder (default: in run_root, named after the settings)",
    "seed=N": "seed of networks, environments and sampling",
    "pretrained=FOLDER": "run folder to transfer from, or builtin for networks that come with the library",
    "resume=FOLDER": "run folder to continue; device= and training.total_frames=N may change",
    "training.total_frames=N": "environment steps",
    "width=FACTOR": "width of hidden layers, as a share of the paper's",
    "device=cuda": "train networks on a GPU; for physics on the GPU, add physics=warp",
}

SWEEPS = """\
sweeps:
  --multirun trains with every combination of values: seed=0,1,2 or 'seed=range(0,3)'. The same command again skips
  complete runs, continues unfinished runs, and repeats failed ones.
  hydra/launcher=joblib, submitit_local: several runs at a time (pip install 'torchrl-mcp[launchers]')
  hydra/launcher=slurm: runs on a cluster (the same)
  hydra/launcher=ray_local, ray: runs by Ray (pip install 'torchrl-mcp[ray-launcher]')
  hydra/sweeper=optuna: search for the best return (pip install 'torchrl-mcp[optuna]')"""

EXAMPLES = f"""\
examples:
  {PROGRAM} method=scratch task=heading character=biped
  {PROGRAM} method=mcp task=heading character=humanoid stage=transfer pretrained=builtin
  {PROGRAM} --multirun method=scratch task=holdout stage=transfer seed=0,1,2
  {PROGRAM} --multirun method=scratch task=heading seed=0,1 hydra/launcher=joblib hydra.launcher.n_jobs=2
  {PROGRAM} benchmark=smoke
  {PROGRAM} task=heading method=scratch --cfg job        # every setting and its value
"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``--help``. Hydra parses everything else, but its import is too slow for ``--help``."""
    parser = new_parser(
        PROGRAM, "Train a method on a task, as a single run, a Hydra multirun or a benchmark.", _epilog()
    )
    parser.add_argument("settings", nargs="*", metavar="SETTING=VALUE", help="see below")
    parser.add_argument(
        "-m", "--multirun", action="store_true", help="train with every combination of values, such as seed=0,1,2"
    )
    parser.add_argument(
        "-cd",
        "--config-dir",
        metavar="FOLDER",
        help="folder of your own settings, whose modules may be in the working directory",
    )
    parser.add_argument("-c", "--cfg", choices=["job", "hydra", "all"], help="print the configuration without training")
    parser.add_argument("--resolve", action="store_true", help="with --cfg: print values in place of references")
    parser.add_argument(
        "-sc",
        "--shell-completion",
        action="store_true",
        help="complete names in a shell; install this with -sc install=bash",
    )
    add_trust(parser)
    parser.add_argument("--hydra-help", action="store_true", help="print Hydra's own options")
    return parser


def _epilog() -> str:
    groups: list[str] = []
    for group, meaning in GROUPS.items():
        groups += [f"  {group:13}{', '.join(choices(group))}", *([f"{'':15}{meaning}"] if meaning else [])]
    settings = [f"  {setting:25}{meaning}" for setting, meaning in SETTINGS.items()]
    return "\n".join(["choices:", *groups, "", "settings:", *settings, "", SWEEPS, "", EXAMPLES])


if __name__ == "__main__":
    main()
