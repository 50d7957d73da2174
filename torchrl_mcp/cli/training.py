"""What Hydra calls: a run, or a benchmark of many."""

import argparse
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig

from torchrl_mcp.cli.parsing import announce
from torchrl_mcp.training.run_folder import CONFIG

PROGRAM = "torchrl-mcp-train"


@hydra.main(version_base="1.3", config_path="pkg://torchrl_mcp.conf", config_name="train")
def run(cfg: DictConfig) -> float | None:
    """Train as ``cfg`` says, or continue ``cfg.resume``, and return the final return, which sweepers optimise."""
    announce(PROGRAM)
    from torchrl_mcp.cli.summary import final_return, summary
    from torchrl_mcp.runs import experiment

    try:
        folder = _resume(Path(cfg.resume)) if cfg.resume else experiment.train(cfg)
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
    """Return what a run that failed has left, and how to go on."""
    folder = Path(cfg.resume or cfg.run_dir)
    if not (folder / CONFIG).is_file():
        return "No run has begun: mend the cause, and give the same command again"
    return f"All up to the last checkpoint is safe in {folder}: go on with {PROGRAM} resume={folder}"


def run_benchmark(arguments: list[str]) -> None:
    """Run many runs, or what is left of them."""
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
        sys.exit(f"\n{PROGRAM}: interrupted; call it again to go on from here")


def _resume(folder: Path) -> Path:
    from torchrl_mcp.runs import experiment

    given = HydraConfig.get().overrides.task
    if ignored := [setting for setting in given if not setting.startswith("resume=")]:
        raise ValueError(f"a run goes on with the settings that it began with: leave out {' '.join(ignored)}")
    if experiment.is_complete(folder):
        print(f"{folder} is complete: nothing is left to do")
    return experiment.resume(folder)
