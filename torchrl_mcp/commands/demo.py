"""``torchrl-mcp-demo``: train a new gate over MCP's primitives and a network from scratch, with equal steps.

Both runs train at once, in a process each. All results are written to one folder, and complete results are reused.
"""

import argparse
import math
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_mcp import __version__
from torchrl_mcp.commands.export import write_page
from torchrl_mcp.commands.parsing import announce, entry_point, new_parser
from torchrl_mcp.commands.report import write_report
from torchrl_mcp.runs.processes import start, ticks
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, read_json

if TYPE_CHECKING:
    from omegaconf import DictConfig

    Runs = Mapping[str, DictConfig]

PROGRAM = "torchrl-mcp-demo"

HEADING = ["task=heading", "character=humanoid"]
RUNS = {
    "pretrain": ["method=mcp", "task=imitation", "character=humanoid", "stage=pretrain"],
    "mcp": ["method=mcp", *HEADING, "stage=transfer"],
    "scratch": ["method=scratch", *HEADING],
}
"""Settings of each run. This is not a file of ``conf/benchmark``, because the runs have budgets of their own."""

TITLES = {"mcp": "MCP", "scratch": "scratch"}
BUILTIN_STEPS = 10_649_600
"""Environment steps of imitation of the humanoid's primitives that come with the library."""

FIXED = ("character", "method", "preset", "pretrained", "run_dir", "stage", "task")
"""Settings that the demonstration makes itself."""

FILM = "film.gif"
PAGE = "page"
CONTENTS = {
    "report.html, report.md": "both runs beside the paper's returns, with learning curves",
    FILM: "both policies side by side under the same arrow; the bars are MCP's gates",
    PAGE: "web page: the gate in any browser, without an installation",
    "mcp, scratch": "run folders, for all other commands",
}


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Run or continue the demonstration."""
    arguments = parser().parse_args(words)
    announce(PROGRAM)
    from hydra.errors import HydraException

    from torchrl_mcp.commands.suggestions import answer

    preset = "demo_smoke" if arguments.smoke else "demo"
    output = arguments.output or Path("runs", "demo-pretrain" if arguments.pretrain else "demo")
    try:
        run(output, arguments.overrides, preset=preset, pretrain=arguments.pretrain)
    except HydraException as error:
        sys.exit(f"{PROGRAM}: {answer(error, arguments.overrides)}")
    except KeyboardInterrupt:
        sys.exit(f"\n{PROGRAM}: interrupted; repeat the command to continue")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = new_parser(
        PROGRAM, "Train a new gate that steers a humanoid, and a network from scratch with the same number of steps."
    )
    parser.add_argument(
        "overrides",
        nargs="*",
        metavar="SETTING=VALUE",
        help="settings of all runs, as for torchrl-mcp-train, such as seed=1",
    )
    parser.add_argument("--output", type=Path, help="folder (default runs/demo, or runs/demo-pretrain)")
    parser.add_argument("--pretrain", action="store_true", help="also train the primitives, which takes longer")
    parser.add_argument("--smoke", action="store_true", help="only test whether the demonstration runs, in seconds")
    return parser


def run(folder: Path, overrides: Sequence[str], *, preset: str = "demo", pretrain: bool = False) -> None:
    """Train, evaluate and report in ``folder``, except for results that it already has.

    Args:
        folder: The folder of the demonstration.
        overrides: Settings of all runs, as for ``torchrl-mcp-train``.
        preset: Preset of the runs; that of pre-training is ``<preset>_pretrain``.
        pretrain: Train the primitives too. Scratch then has as many steps as both stages together.

    Raises:
        ValueError: If the settings contradict each other or the folder's, or a process fails.
    """
    began = time.monotonic()
    runs = configure(folder, overrides, preset=preset, pretrain=pretrain)
    print(introduction(runs, folder), flush=True)
    train(folder, runs)
    print(f"\n{table(runs)}")
    page_writer = start(export_page, folder)  # beside the film, because a core is free
    has_film = film(folder, runs)
    write_report([folder / name for name in runs], folder)
    page_writer.join()
    absent = [name for name, made in ((FILM, has_film), (PAGE, _has_page(folder))) if not made]
    print(f"\nAfter {(time.monotonic() - began) / 60:.1f} minutes, in {folder}:")
    for name, content in CONTENTS.items():
        if name not in absent:
            print(f"  {name:26}{content}")
    print("next:", *(f"  {what}:\n    {command}" for what, command in commands(folder, runs).items()), sep="\n")


def configure(folder: Path, overrides: Sequence[str], *, preset: str, pretrain: bool) -> "dict[str, DictConfig]":
    """Return the configurations of the runs in ``folder``.

    Raises:
        ValueError: If the demonstration makes a setting itself, or the folder holds a run with another configuration.
    """
    from torchrl_mcp.runs.configuration import compose_run

    for word in overrides:
        if word.lstrip("+~").partition("=")[0] in FIXED:
            raise ValueError(f"the demonstration is of the humanoid's heading: use torchrl-mcp-train to set {word}")
    presets = dict.fromkeys(RUNS, f"preset={preset}") | {"pretrain": f"preset={preset}_pretrain"}
    runs = {
        name: compose_run(*words, presets[name], *overrides)
        for name, words in RUNS.items()
        if pretrain or name != "pretrain"
    }
    if not runs["mcp"].evaluation.episodes:
        raise ValueError("evaluation.episodes=0: the demonstration compares returns of episodes, give at least 1")
    runs["mcp"].pretrained = str(folder / "pretrain") if pretrain else "builtin"
    if pretrain:
        runs["scratch"].training.total_frames += runs["pretrain"].training.total_frames
    for name, cfg in runs.items():
        cfg.run_dir = str(folder / name)
        _require_same(cfg, folder / name)
    return runs


def _require_same(cfg: "DictConfig", folder: Path) -> None:
    """Check that a run in ``folder``, if there is one, has the configuration, and take over its precision.

    Raises:
        ValueError: If the folder holds a run with another configuration.
    """
    if not (folder / CONFIG).exists():
        return
    from torchrl_mcp.runs import configuration, records

    cfg.autocast = records.run_config(folder).autocast
    if changed := records.changes(folder, configuration.planned(cfg).config):
        raise ValueError(f"{folder} holds a run that differs in {', '.join(changed)}: give another --output")


def introduction(runs: "Runs", folder: Path) -> str:
    """Return a text about the runs and their duration."""
    minutes = runs.get("pretrain", runs["mcp"]).demo.minutes
    if "pretrain" in runs:
        first = (
            f"Primitives first imitate walks for {_steps(runs['pretrain']):,} steps; then a gate over them learns to "
            f"steer the humanoid in {_steps(runs['mcp']):,}. Scratch has as many steps as both."
        )
    else:
        first = (
            f"A gate over MCP's eight primitives, and scratch, each learn in {_steps(runs['mcp']):,} steps to walk "
            f"the humanoid\nwhere an arrow points. {remark(runs)}"
        )
    return (
        f"{first}\nThis takes about {minutes} minutes on two cores. If you interrupt it, repeat the command to "
        f"continue. All results are written to {folder}."
    )


def remark(runs: "Runs") -> str:
    """Return how far the comparison is a fair one."""
    if "pretrain" in runs:
        return "Scratch had as many steps as pre-training and transfer together."
    return (
        f"MCP's primitives had {BUILTIN_STEPS / 1e6:.1f} million steps of imitation before, scratch none:\nwith 5.5 "
        "million steps of its own, scratch reaches 0.960."
    )


def train(folder: Path, runs: "Runs") -> None:
    """Train and evaluate the runs in two processes, and show their progress.

    Raises:
        ValueError: If a process fails.
    """
    from torchrl_mcp.runs.status import overview

    gate = [cfg for name, cfg in runs.items() if name != "scratch"]
    with overview(folder, {Path(cfg.run_dir).absolute(): cfg.training.total_frames for cfg in runs.values()}):
        for _ in ticks([start(learn, gate), start(learn, [runs["scratch"]])], interval=1.0):
            pass


def learn(runs: "Sequence[DictConfig]") -> None:
    """Train and evaluate runs, one after the other, with logs in their folders."""
    from torchrl_mcp.runs import benchmark

    for cfg in runs:
        benchmark.run(cfg)


def table(runs: "Runs") -> str:
    """Return a table of the evaluations, with a caption."""
    from torchrl_mcp.runs.tables import text_table

    rows = []
    for name in ("mcp", "scratch"):
        evaluation = read_json(Path(runs[name].run_dir, EVALUATION))
        deterministic = evaluation["deterministic"]
        low, high = deterministic["interval"]
        rows.append(
            {
                "policy": TITLES[name],
                "steps": f"{_steps(runs[name]):,}",
                "steps before": f"{_steps_before(name, runs):,}",
                "return": f"{deterministic['normalised_return']:.3f} [{low:.3f}, {high:.3f}]",
                "exploring": f"{evaluation['stochastic']['normalised_return']:.3f}",
                "falls": f"{deterministic['terminated']:.0%}",
            }
        )
    return (
        f"{text_table(rows)}\n\n"
        f"Normalised return of {evaluation['episodes']} episodes with its 95 % interval, and with exploration.\n"
        f"{remark(runs)} Seed {runs['mcp'].seed}, torchrl-mcp {__version__}."
    )


def film(folder: Path, runs: "Runs") -> bool:
    """Film both policies under the same arrow, unless there is a film; return whether there is one.

    No episode ends, so that the arrow, which is drawn from one seed, stays the same for both.
    """
    from torchrl_mcp.runs.policies import restore
    from torchrl_mcp.viewer.film import save_films
    from torchrl_mcp.viewer.player import Player

    if (folder / FILM).exists():
        return True
    players = {}
    for name, title in TITLES.items():
        endless = {**runs[name].evaluation.environment, "terminate_on_fall": False, "max_episode_steps": 10**6}
        _, agent, env = restore(folder / name, num_envs=1, seed=0, **endless)
        players[f"{title}, {_steps(runs[name]):,} steps"] = Player(agent.actor.policy, env)
    try:
        save_films(players, folder / FILM, seconds=runs["mcp"].demo.seconds, width=320, height=240)
    except RuntimeError as error:
        print(f"no film: {error}")
        return False
    return True


def export_page(folder: Path) -> None:
    """Write a web page of the gate, unless there is one.

    This needs npm, and ONNX for Python. Without them it prints the reason.
    """
    if _has_page(folder):
        return
    gate = folder / "mcp"
    page = folder / PAGE
    try:
        write_page([gate], page, command=shlex.join(["torchrl-mcp-export", str(gate), "--page", str(page)]))
    except ValueError as error:
        print(f"no web page: {error}", flush=True)


def _has_page(folder: Path) -> bool:
    from torchrl_mcp.viewer.page.folder import ABOUT

    return (folder / PAGE / ABOUT).exists()


def commands(folder: Path, runs: "Runs") -> dict[str, str]:
    """Return the next commands by what each does."""
    listed = {"steer it in the browser": shlex.join(["torchrl-mcp-play", str(folder / "mcp"), "--viewer", "web"])}
    if _has_page(folder):
        served = ["python", "-m", "http.server", "--directory", str(folder / PAGE)]
        listed["open the web page at http://localhost:8000"] = shlex.join(served)
    if "pretrain" not in runs:
        listed["train a gate yourself"] = (
            "torchrl-mcp-train method=mcp task=heading character=humanoid stage=transfer pretrained=builtin "
            "run_dir=runs/gate"
        )
        listed["pre-train the primitives yourself"] = "torchrl-mcp-demo --pretrain"
    return listed


def _steps(cfg: "DictConfig") -> int:
    """Return the environment steps of a run, rounded up to whole batches."""
    return math.ceil(cfg.training.total_frames / cfg.training.frames_per_batch) * cfg.training.frames_per_batch


def _steps_before(name: str, runs: "Runs") -> int:
    """Return the environment steps of the pre-training of a run."""
    if name == "scratch":
        return 0
    return _steps(runs["pretrain"]) if "pretrain" in runs else BUILTIN_STEPS


if __name__ == "__main__":
    main()
