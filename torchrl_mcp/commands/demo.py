"""The demonstration: a new gate over MCP's primitives and scratch learn the same task for the same steps, side by side.

Two processes train at once, one core each. All results are written to one folder, and what is already there is reused.
"""

import json
import math
import shlex
import time
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from torchrl_mcp import __version__, analysis
from torchrl_mcp.commands import export
from torchrl_mcp.commands.demo_page import write_page
from torchrl_mcp.runs import configuration, experiment, records
from torchrl_mcp.runs.policies import restore
from torchrl_mcp.runs.processes import start, ticks
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.bar import TrainingBar
from torchrl_mcp.training.run_folder import CONFIG, EVALUATION, NORMALISED_RETURN, read_metrics, replacing, write_json
from torchrl_mcp.viewer.film import save_films
from torchrl_mcp.viewer.page.folder import ABOUT
from torchrl_mcp.viewer.player import Player

Runs = Mapping[str, DictConfig]

HEADING = ["task=heading", "character=humanoid"]
RUNS = {
    "pretrain": ["method=mcp", "task=imitation", "character=humanoid", "stage=pretrain"],
    "mcp": ["method=mcp", *HEADING, "stage=transfer"],
    "scratch": ["method=scratch", *HEADING],
}
TITLES = {"pretrain": "primitives", "mcp": "MCP", "scratch": "scratch"}
BUILTIN_STEPS = 10_649_600
"""Environment steps of imitation of the humanoid's primitives that come with the library."""

OWN = ("character", "method", "preset", "pretrained", "run_dir", "stage", "task")
"""Settings that the demonstration makes itself."""

RECENT = 10
"""Iterations whose returns are averaged in the line of progress."""

FILM = "film.gif"
PAGE = "page"
CONTENTS = {
    "index.html": "all of it on one page",
    "results.md, results.json": "the table, and its numbers",
    "learning_curves.png, .svg, .csv": "both curves",
    FILM: "both side by side, under the same arrow",
    PAGE: "web page: the gate in any browser, with nothing installed there",
    "mcp/, scratch/": "run folders, for every other command",
}


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
    cores = [[cfg for name, cfg in runs.items() if name != "scratch"], [runs["scratch"]]]
    show_progress([start(learn, core) for core in cores], runs)
    page_writer = start(page, folder)  # on the other core, beside the film
    rows = results(runs)
    print("\n" + report(folder, runs, rows))
    made = {FILM: film(folder, runs)}
    page_writer.join()
    made[PAGE] = (folder / PAGE / ABOUT).exists()
    write_page(
        folder,
        table_rows(rows),
        caption=caption(runs, rows),
        film=FILM if made[FILM] else None,
        curves="learning_curves.svg",
        commands=commands(folder, runs),
    )
    print(f"\nAfter {(time.monotonic() - began) / 60:.1f} minutes, in {folder}:")
    for name, content in CONTENTS.items():
        if made.get(name, True):
            print(f"  {name:35}{content}")
    if made[PAGE]:
        served = shlex.join(["python", "-m", "http.server", "--directory", str(folder / PAGE)])
        print(f"open the page at http://localhost:8000 after\n    {served}")
    print("next:", *(f"  {what}:\n    {command}" for what, command in commands(folder, runs).items()), sep="\n")


def configure(folder: Path, overrides: Sequence[str], *, preset: str, pretrain: bool) -> dict[str, DictConfig]:
    """Return the configurations of the runs in ``folder``.

    Raises:
        ValueError: If the demonstration makes a setting itself, or the folder holds a run with another configuration.
    """
    for word in overrides:
        if word.lstrip("+~").partition("=")[0] in OWN:
            raise ValueError(f"the demonstration is of the humanoid's heading: use torchrl-mcp-train to set {word}")
    presets = dict.fromkeys(RUNS, f"preset={preset}") | {"pretrain": f"preset={preset}_pretrain"}
    runs = {
        name: configuration.compose_run(*words, presets[name], *overrides)
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


def _require_same(cfg: DictConfig, folder: Path) -> None:
    """Check that a run in ``folder``, if there is one, has the configuration, and take over its precision.

    Raises:
        ValueError: If the folder holds a run with another configuration.
    """
    if not (folder / CONFIG).exists():
        return
    cfg.autocast = records.run_config(folder).autocast
    if changed := records.changes(folder, configuration.planned(cfg).config):
        raise ValueError(f"{folder} holds a run that differs in {', '.join(changed)}: give another --output")


def introduction(runs: Runs, folder: Path) -> str:
    """Return what is going on, and how long it will take."""
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
        f"{first}\nThis takes about {minutes} minutes on two cores. You may interrupt it: repeat the command to "
        f"continue. Everything lands in {folder}."
    )


def remark(runs: Runs) -> str:
    """Return what the comparison is, and what it is not."""
    if "pretrain" in runs:
        return "Scratch had as many steps as pre-training and transfer together."
    return (
        f"MCP's primitives had {BUILTIN_STEPS / 1e6:.1f} million steps of imitation before, scratch none:\nwith 5.5 "
        "million steps of its own, scratch reaches 0.960."
    )


def learn(runs: Sequence[DictConfig]) -> None:
    """Train and evaluate runs, one after the other."""
    with redirect_stdout(StringIO()):  # one line of progress tells of both
        for cfg in runs:
            experiment.train_or_resume(cfg)


def show_progress(processes: Sequence[BaseProcess], runs: Runs) -> None:
    """Show one line of progress of all runs until they are trained, then until they are evaluated."""
    total = sum(map(_steps, runs.values()))
    done = sum(progress(cfg)[0] for cfg in runs.values())
    moments = ticks(processes, interval=1.0)
    with TrainingBar(total, done, estimate=False) as line:
        for _ in moments:
            now = {TITLES[name]: progress(cfg) for name, cfg in runs.items()}
            before, done = done, sum(steps for steps, _ in now.values())
            line.advance(done - before, ", ".join(f"{name} {value:.2f}" for name, (_, value) in now.items() if value))
            if done >= total:
                break
    print(f"Both play {runs['mcp'].evaluation.episodes} episodes, without and with exploration.", flush=True)
    for _ in moments:
        pass


def progress(cfg: DictConfig) -> tuple[int, float | None]:
    """Return the steps of a run, and its recent mean return once episodes of full length can have ended."""
    rows = read_metrics(Path(cfg.run_dir))
    if not rows:
        return 0, None
    task = cfg.task[cfg.stage.name]
    training = cfg.training
    full = training.num_envs * task.get("max_episode_steps", cfg.task.evaluation.max_episode_steps)
    recent = [row[NORMALISED_RETURN] for row in rows[-RECENT:] if row["frames"] > full]
    ended = [value for value in recent if math.isfinite(value)]
    return int(rows[-1]["frames"]), sum(ended) / len(ended) if ended else None


def results(runs: Runs) -> list[dict[str, Any]]:
    """Return the rows of the table."""
    rows = []
    for name in ("mcp", "scratch"):
        numbers = json.loads(Path(runs[name].run_dir, EVALUATION).read_text())
        before = 0 if name == "scratch" else _steps(runs["pretrain"]) if "pretrain" in runs else BUILTIN_STEPS
        rows.append({"policy": TITLES[name], "steps": _steps(runs[name]), "steps before": before, **numbers})
    return rows


def report(folder: Path, runs: Runs, rows: Sequence[Mapping[str, Any]]) -> str:
    """Write table, numbers and learning curves, and return the table with its caption."""
    table = f"{text_table(table_rows(rows), markdown=True)}\n\n{caption(runs, rows)}"
    with replacing(folder / "results.md") as partial:
        partial.write_text(table + "\n", encoding="utf-8")
    write_json({"rows": list(rows)}, folder / "results.json")
    curves = [learning_curve(folder, runs, name) for name in ("mcp", "scratch")]
    analysis.write_curves(curves, folder / "learning_curves.csv")
    analysis.save_figure(analysis.draw_curves(curves), folder / "learning_curves")
    return table


def learning_curve(folder: Path, runs: Runs, name: str) -> analysis.Curve:
    """Return the learning curve of a run, which begins after the steps of its pre-training here."""
    (curve,) = analysis.learning_curves({TITLES[name]: [folder / name]}, num_bins=20)
    before = _steps(runs["pretrain"]) if name == "mcp" and "pretrain" in runs else 0
    return replace(curve, frames=curve.frames + before)


def caption(runs: Runs, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the caption of the table."""
    return (
        f"Normalised return of {rows[0]['episodes']} episodes with its 95 % interval, and with exploration.\n"
        f"{remark(runs)} Seed {runs['mcp'].seed}, torchrl-mcp {__version__}."
    )


def table_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return :func:`results` as text."""
    return [
        {
            "policy": row["policy"],
            "steps": f"{row['steps']:,}",
            "steps before": f"{row['steps before']:,}",
            "return": "{:.3f} [{:.3f}, {:.3f}]".format(
                row["deterministic"]["normalised_return"], *row["deterministic"]["interval"]
            ),
            "exploring": f"{row['stochastic']['normalised_return']:.3f}",
            "falls": f"{row['deterministic']['terminated']:.0%}",
        }
        for row in rows
    ]


def film(folder: Path, runs: Runs) -> bool:
    """Film both policies under the same arrow, unless there is a film; return whether there is one.

    No episode ends, so that the arrow, which is drawn from one seed, stays the same for both.
    """
    path = folder / FILM
    seconds = runs["mcp"].demo.seconds
    if path.exists():
        return True
    players = {}
    for name in ("mcp", "scratch"):
        fixed = {**runs[name].evaluation.environment, "terminate_on_fall": False, "max_episode_steps": 10**6}
        _, agent, env = restore(folder / name, num_envs=1, seed=0, **fixed)
        players[f"{TITLES[name]}, {_steps(runs[name]):,} steps"] = Player(agent.actor.policy, env)
    try:
        save_films(players, path, seconds=seconds, width=320, height=240)
    except RuntimeError as error:
        print(f"no film: {error}")
        return False
    return True


def page(folder: Path) -> None:
    """Write a web page of the gate, unless there is one.

    It needs npm, and ONNX for Python; without them it prints the reason.
    """
    if (folder / PAGE / ABOUT).exists():
        return
    words = ["torchrl-mcp-export", str(folder / "mcp"), "--page", str(folder / PAGE)]
    try:
        export.page([folder / "mcp"], folder / PAGE, words=words)
    except ValueError as error:
        print(f"no web page: {error}", flush=True)


def commands(folder: Path, runs: Runs) -> dict[str, str]:
    """Return the next commands by what each does."""
    steer = {"steer it in the browser": shlex.join(["torchrl-mcp-play", str(folder / "mcp"), "--viewer", "web"])}
    if "pretrain" in runs:
        return steer
    train = "torchrl-mcp-train method=mcp task=heading character=humanoid stage=transfer pretrained=builtin"
    return {
        **steer,
        "train a gate yourself": f"{train} run_dir=runs/gate",
        "pre-train the primitives yourself": "torchrl-mcp-demo --pretrain",
    }


def _steps(cfg: DictConfig) -> int:
    """Environment steps of a run, rounded up to whole batches."""
    return math.ceil(cfg.training.total_frames / cfg.training.frames_per_batch) * cfg.training.frames_per_batch
