"""Training by Hydra: one run, a sweep, or a benchmark of many."""

import argparse
import os
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig

from torchrl_mcp.commands import announce
from torchrl_mcp.runs import places, quoting
from torchrl_mcp.runs.trust import read_config, resuming
from torchrl_mcp.training.run_folder import CONFIG

PROGRAM = "torchrl-mcp-train"

FULL_ERROR = "HYDRA_FULL_ERROR"
"""Environment variable by which Hydra raises exceptions, instead of printing them."""


def run() -> None:
    """Let Hydra train, or print the configuration.

    ``--cfg hydra`` drops the run's settings, so that ``--resolve`` would fail at references to them. Printing a package
    of all settings does not drop them.

    Raises:
        HydraException: If Hydra cannot compose the configuration.
    """
    printed = any(pair in (("--cfg", "hydra"), ("-c", "hydra")) for pair in pairwise(sys.argv))
    if "--resolve" in sys.argv and (printed or "--cfg=hydra" in sys.argv):
        sys.argv += ["--cfg", "all", "--package", "hydra"]  # argparse takes the last value of an option
    os.environ[FULL_ERROR] = "1"
    train()


@hydra.main(version_base="1.3", config_path="pkg://torchrl_mcp.conf", config_name="train")
def train(cfg: DictConfig) -> float | None:
    """Train as configured, or continue ``cfg.resume``, and return the final return, which sweepers optimise.

    A run of a sweep raises what goes wrong, and is continued if it has begun.
    """
    announce(PROGRAM)
    in_sweep = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    with _interruptible() if in_sweep else _explained(cfg):
        from torchrl_mcp.commands.summary import final_return, summary
        from torchrl_mcp.runs import experiment

        begin = experiment.train_or_resume if in_sweep else experiment.train
        folder = _resume(cfg) if cfg.resume else begin(cfg)
    print(summary(folder), flush=True)
    return final_return(folder)


@contextmanager
def _explained(cfg: DictConfig) -> Iterator[None]:
    """End the command with a sentence if its run fails or is interrupted, in development mode with a traceback."""
    if sys.flags.dev_mode:
        yield
        return
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


def _place(error: HydraException) -> str:
    """Return the last line of code, outside of installed packages, of the error that Hydra tells of."""
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


def _what_is_safe(cfg: DictConfig) -> str:
    """Return a sentence on the saved state of a failed run, and how to continue."""
    folder = Path(cfg.resume or cfg.run_dir)
    if not (folder / CONFIG).is_file():
        return "No run has begun: fix the cause and repeat the command"
    return f"The run is safe up to its last checkpoint in {folder}: go on with {resuming(folder)}"


def run_benchmark(arguments: list[str]) -> None:
    """Run a benchmark, or continue it.

    Raises:
        HydraException: If Hydra cannot compose the configuration.
    """
    parser = argparse.ArgumentParser(PROGRAM, add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd", type=Path)
    options, settings = parser.parse_known_args(arguments)
    if unknown := [setting for setting in settings if setting.startswith("-")]:
        sys.exit(f"{PROGRAM}: a benchmark takes settings and --config-dir, but not {' '.join(unknown)}")
    if options.config_dir and not options.config_dir.is_dir():
        sys.exit(f"{PROGRAM}: there is no folder {options.config_dir}: correct --config-dir")
    if options.config_dir:
        settings.append(f"hydra.searchpath=[{quoting.quoted(f'file://{options.config_dir.resolve()}')}]")
    announce(PROGRAM)
    from torchrl_mcp.runs import benchmark

    with _interruptible():
        benchmark.main(settings)


def _resume(cfg: DictConfig) -> Path:
    """Continue the run in ``cfg.resume`` with the few settings that a run can change."""
    from torchrl_mcp.runs import experiment, records

    folder = Path(cfg.resume)
    given = HydraConfig.get().overrides.task
    overrides = OverridesParser.create().parse_overrides(list(given))
    values: dict[str, Any] = {override.key_or_group: override.value() for override in overrides}
    del values["resume"]
    device = values.pop("device", None)
    total_frames = values.pop("training.total_frames", None)
    files = places.outside(read_config(folder / CONFIG)) if (folder / CONFIG).is_file() else {}
    moves = {name: str(value) for name, value in values.items() if name in files}
    if ignored := [str(override.input_line) for override in overrides if override.key_or_group in {*values} - {*moves}]:
        changeable = ["device", "training.total_frames", *files]
        raise ValueError(
            f"a resumed run keeps its settings, except for {', '.join(changeable)}: leave out {' '.join(ignored)}"
        )
    if records.is_complete(folder) and total_frames is None:
        print(f"{folder} is complete: there is nothing left to do; training.total_frames=N makes it longer")
    return experiment.resume(folder, device=device, total_frames=total_frames, moves=moves)
