"""``torchrl-mcp-train``: train a method on a task, alone, in a Hydra multirun, or as a benchmark of many."""

import argparse
import difflib
import sys
from pathlib import Path

import hydra
from hydra import compose, initialize_config_module
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp.runs import benchmark, build, experiment


@hydra.main(version_base="1.3", config_path="pkg://torchrl_mcp.conf", config_name="train")
def run(cfg: DictConfig) -> None:
    """Train as ``cfg`` says, or continue the run folder ``cfg.resume``."""
    try:
        folder = _resume(Path(cfg.resume)) if cfg.resume else experiment.train(cfg)
    except ValueError as error:
        sys.exit(f"torchrl-mcp-train: {error}")
    print(f"run folder: {folder}")


def run_benchmark(arguments: list[str]) -> None:
    """Run many runs, or what is left of them."""
    parser = argparse.ArgumentParser("torchrl-mcp-train", add_help=False, allow_abbrev=False)
    parser.add_argument("--config-dir", "-cd", type=Path)
    options, settings = parser.parse_known_args(arguments)
    if unknown := [setting for setting in settings if setting.startswith("-")]:
        sys.exit(f"torchrl-mcp-train: a benchmark takes settings and --config-dir, but not {' '.join(unknown)}")
    if options.config_dir:
        settings.append(f"hydra.searchpath=[file://{options.config_dir.resolve()}]")
    try:
        benchmark.main(settings)
    except HydraException as error:
        print(error, file=sys.stderr)
        sys.exit(1)
    except ValueError as error:
        sys.exit(f"torchrl-mcp-train: {error}")
    except KeyboardInterrupt:
        sys.exit("\ntorchrl-mcp-train: interrupted; call it again to go on from here")


def main() -> None:
    """Run the command line, and where it names an unknown setting say which one was perhaps meant."""
    arguments = [argument for argument in sys.argv[1:] if argument not in ("-m", "--multirun")]
    is_benchmark = any(argument.startswith("benchmark=") for argument in arguments)
    try:
        run_benchmark(arguments) if is_benchmark else run()
    except SystemExit as stop:
        if stop.code == 1:
            print(*suggestions(sys.argv[1:]), sep="\n", file=sys.stderr)
        raise


def suggestions(arguments: list[str]) -> list[str]:
    """Return a line for each argument ``key=value`` whose key no configuration has, with the nearest that exist."""
    try:
        overrides = OverridesParser.create().parse_overrides([a for a in arguments if not a.startswith("-")])
        with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
            groups = list(compose("train", return_hydra_config=True).hydra.runtime.choices)
            # A choice of method or preset brings settings of its own.
            chosen = [str(o.input_line) for o in overrides if o.key_or_group in groups and not o.is_sweep_override()]
            cfg = compose("train", chosen, return_hydra_config=True)
    except HydraException:
        return []
    settings = _keys(OmegaConf.to_container(cfg))
    unknown = [o.key_or_group for o in overrides if o.key_or_group not in {*groups, *settings} and not o.is_add()]
    return [
        f"{key!r} stands in no file, but it is an argument: write it with a plus, +{key}=..."
        if _is_argument(key, cfg)
        else f"{key!r} is no setting of this method; the nearest are: "
        + ", ".join(difflib.get_close_matches(key, {*groups, *settings}, n=3, cutoff=0.5) or sorted(groups))
        for key in unknown
    ]


def _resume(folder: Path) -> Path:
    given = HydraConfig.get().overrides.task
    if ignored := [setting for setting in given if not setting.startswith("resume=")]:
        raise ValueError(f"a run goes on with the settings that it began with: leave out {' '.join(ignored)}")
    if experiment.is_complete(folder):
        print(f"{folder} is complete: nothing is left to do")
    return experiment.resume(folder)


def _is_argument(key: str, cfg: DictConfig) -> bool:
    """Tell whether a setting is an argument of what its group makes."""
    group, _, name = key.rpartition(".")
    made = group and OmegaConf.select(cfg, f"{group}._target_")
    return bool(made) and name in build.arguments(made)


def _keys(tree: object, prefix: str = "") -> list[str]:
    if not isinstance(tree, dict):
        return []
    return [name for key, value in tree.items() for name in (f"{prefix}{key}", *_keys(value, f"{prefix}{key}."))]


if __name__ == "__main__":
    main()
