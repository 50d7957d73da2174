"""Training by Hydra: one run, or a benchmark of many."""

import argparse
import sys
from itertools import pairwise
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig

from torchrl_mcp.cli.parsing import announce
from torchrl_mcp.training.run_folder import CONFIG

PROGRAM = "torchrl-mcp-train"


def run() -> None:
    """Let Hydra train, or print the configuration.

    ``--cfg hydra`` drops the run's settings, so that ``--resolve`` would fail at references to them. Printing a package
    of all settings does not drop them.
    """
    printed = any(pair in (("--cfg", "hydra"), ("-c", "hydra")) for pair in pairwise(sys.argv))
    if "--resolve" in sys.argv and (printed or "--cfg=hydra" in sys.argv):
        sys.argv += ["--cfg", "all", "--package", "hydra"]  # argparse takes the last value of an option
    train()


@hydra.main(version_base="1.3", config_path="pkg://torchrl_mcp.conf", config_name="train")
def train(cfg: DictConfig) -> float | None:
    """Train as configured, or continue ``cfg.resume``, and return the final return, which sweepers optimise."""
    announce(PROGRAM)
    from torchrl_mcp.cli.summary import final_return, summary
    from torchrl_mcp.runs import experiment

    try:
        folder = _resume(cfg) if cfg.resume else experiment.train(cfg)
    except (ValueError, FloatingPointError) as error:
        sys.exit(f"{PROGRAM}: {error}")
    except HydraException as error:
        sys.exit(f"{PROGRAM}: {'; '.join(str(error).splitlines())}")
    except OSError as error:
        sys.exit(f"{PROGRAM}: {error}. {_what_is_safe(cfg)}")
    except KeyboardInterrupt:
        sys.exit(f"\n{PROGRAM}: interrupted. {_what_is_safe(cfg)}")
    print(summary(folder), flush=True)
    return final_return(folder)


def _what_is_safe(cfg: DictConfig) -> str:
    """Return a sentence on the saved state of a failed run, and how to continue."""
    folder = Path(cfg.resume or cfg.run_dir)
    if not (folder / CONFIG).is_file():
        return "No run has begun: fix the cause and repeat the command"
    return f"The run is safe up to its last checkpoint in {folder}: go on with {PROGRAM} resume={folder}"


def run_benchmark(arguments: list[str]) -> None:
    """Run a benchmark, or continue it."""
    parser = argparse.ArgumentParser(PROGRAM, add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd", type=Path)
    options, settings = parser.parse_known_args(arguments)
    if unknown := [setting for setting in settings if setting.startswith("-")]:
        sys.exit(f"{PROGRAM}: a benchmark takes settings and --config-dir, but not {' '.join(unknown)}")
    if options.config_dir:
        settings.append(f"hydra.searchpath=[file://{options.config_dir.resolve()}]")
    announce(PROGRAM)
    from torchrl_mcp.runs import benchmark

    try:
        benchmark.main(settings)
    except HydraException as error:
        print(error, file=sys.stderr)
        sys.exit(1)
    except (OSError, ValueError) as error:
        sys.exit(f"{PROGRAM}: {error}")
    except KeyboardInterrupt:
        sys.exit(f"\n{PROGRAM}: interrupted; repeat the command to continue")


def _resume(cfg: DictConfig) -> Path:
    from torchrl_mcp.runs import experiment

    folder, given = Path(cfg.resume), HydraConfig.get().overrides.task
    device = cfg.device if any(setting.startswith("device=") for setting in given) else None
    if ignored := [setting for setting in given if not setting.startswith(("resume=", "device="))]:
        raise ValueError(f"a resumed run keeps its settings, except for the device: leave out {' '.join(ignored)}")
    if experiment.is_complete(folder):
        print(f"{folder} is complete: nothing is left to do")
    return experiment.resume(folder, device=device)
