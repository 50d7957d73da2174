"""``torchrl-mcp-train``: train a method on a task, as a single run, a Hydra multirun or a benchmark."""

import argparse
import sys
from itertools import pairwise

from torchrl_mcp.cli.parsing import add_trust, choices, explained, find_own_modules, new_parser, take_trust
from torchrl_mcp.training.workers import end_with_parent_while_starting, termination_as_interrupt

end_with_parent_while_starting()  # before the imports that take a worker seconds

PROGRAM = "torchrl-mcp-train"

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
"""Groups of settings for the command line and what they say; the choices of other groups come with a method."""

SETTINGS = {
    "run_dir=FOLDER": "run folder (default: in run_root, named after the settings)",
    "seed=N": "seed of networks, environments and sampling",
    "pretrained=FOLDER": "run folder to transfer from, or builtin for networks that come with the library",
    "resume=FOLDER": "run folder to continue; device= and training.total_frames=N may change",
    "training.total_frames=N": "environment steps",
    "width=FACTOR": "width of hidden layers, as a share of the paper's",
    "device=cuda": "train networks on a GPU; for physics on the GPU, add physics=warp",
}

VALUED = (
    *("-cd", "--config-dir", "-cn", "--config-name", "-cp", "--config-path", "-c", "--cfg", "-p", "--package"),
    *("-i", "--info", "--experimental-rerun"),
)
"""Options whose value is the next word."""

EXAMPLES = f"""\
examples:
  {PROGRAM} method=scratch task=heading character=biped
  {PROGRAM} method=mcp task=heading character=humanoid stage=transfer pretrained=builtin
  {PROGRAM} --multirun method=scratch task=holdout stage=transfer seed=0,1,2
  {PROGRAM} --multirun method=scratch task=heading seed=0,1 hydra/launcher=joblib hydra.launcher.n_jobs=2
  {PROGRAM} benchmark=smoke
  {PROGRAM} task=heading method=scratch --cfg job        # every setting and its value
"""


@explained(PROGRAM)
def main() -> None:
    """Run the command line; if Hydra cannot compose it, say what to write instead."""
    trusted, words = take_trust(sys.argv[1:])
    if answered := {"--help", "-h", "--version"} & set(words):
        parser().parse_args(sorted(answered))
    from hydra.errors import HydraException

    from torchrl_mcp.commands.suggestions import answer
    from torchrl_mcp.commands.train import run, run_benchmark
    from torchrl_mcp.runs.trust import trusting

    if any(word.startswith(("-cd", "--config-dir")) for word in words):
        find_own_modules()
    sys.argv[1:] = options_last(words)
    arguments = [word for word in words if word not in ("-m", "--multirun")]
    is_benchmark = any(argument.startswith("benchmark=") for argument in arguments)
    try:
        with trusting(trusted), termination_as_interrupt():
            run_benchmark(arguments) if is_benchmark else run()
    except HydraException as error:
        several = None if is_benchmark or arguments != words else "add --multirun to train with each"
        sys.exit(f"{PROGRAM}: {answer(error, words, several=several)}")
    except AttributeError:
        if __debug__:
            raise
        sys.exit(
            f"{PROGRAM}: Hydra cannot read ranges and choices without assertions: unset PYTHONOPTIMIZE, or drop -O"
        )


def options_last(words: list[str]) -> list[str]:
    """Return a command line with its settings before its options, since Hydra's parser takes them in one row."""
    options: list[str] = []
    settings: list[str] = []
    for before, word in pairwise(["", *words]):
        (options if word.startswith("-") or before in VALUED else settings).append(word)
    return settings + options


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``--help``. Hydra parses all else, but its import is too slow for ``--help``."""
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


SWEEPS = """\
sweeps:
  --multirun trains with every combination of values: seed=0,1,2 or 'seed=range(0,3)'. The same command again skips
  complete runs, continues unfinished runs, and repeats failed ones.
  hydra/launcher=joblib, submitit_local: several runs at a time (pip install 'torchrl-mcp[launchers]')
  hydra/launcher=slurm: runs on a cluster (the same)
  hydra/launcher=ray_local, ray: runs by Ray (pip install 'torchrl-mcp[ray-launcher]')
  hydra/sweeper=optuna: search for the best return (pip install 'torchrl-mcp[optuna]')"""


def _epilog() -> str:
    groups: list[str] = []
    for group, meaning in GROUPS.items():
        groups += [f"  {group:13}{', '.join(choices(group))}", *([f"{'':15}{meaning}"] if meaning else [])]
    settings = [f"  {setting:25}{meaning}" for setting, meaning in SETTINGS.items()]
    return "\n".join(["choices:", *groups, "", "settings:", *settings, "", SWEEPS, "", EXAMPLES])


if __name__ == "__main__":
    main()
