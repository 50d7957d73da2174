"""The demonstration: pre-train primitives, transfer them to unseen directions, and compare with scratch.

Two processes run in parallel, one for MCP and one for scratch, which gets as many steps as MCP's pre-training and
transfer together. All results are written to one folder, and results that are already there are reused.
"""

import json
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import cast

import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_mcp import __version__, analysis
from torchrl_mcp.evaluation.bars import bar
from torchrl_mcp.runs import build, experiment
from torchrl_mcp.runs.identity import PLACES, differences
from torchrl_mcp.runs.policies import evaluate_run, restore
from torchrl_mcp.runs.processes import start, ticks
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.bar import TrainingBar
from torchrl_mcp.training.checkpoint import FOLDER
from torchrl_mcp.training.run_folder import CONFIG, replacing, write_json
from torchrl_mcp.viewer.film import save_film

Runs = Mapping[str, DictConfig]

RUNS = {
    "pretrain": ["method=mcp", "stage=pretrain"],
    "transfer": ["method=mcp", "stage=transfer"],
    "scratch": ["method=scratch", "stage=transfer"],
}

# Panels of the picture: title, run, and stage whose directions are the ant's targets.
PANELS = {
    "seen": ("pre-training directions,\nas pre-trained", "pretrain", "pretrain"),
    "before": ("held-out directions,\nas pre-trained", "pretrain", "transfer"),
    "after": ("held-out directions,\nafter transfer", "transfer", "transfer"),
}
SPACING = math.radians(15)

FILM = "film.gif"
CONTENTS = """\
  results.md, results.json           the table, and all its numbers
  learning_curves.png, .svg, .csv    learning on the held-out directions
  trajectories.png, .svg             where the ant went, by target direction
  pretrain/, transfer/, scratch/     run folders: torchrl-mcp-evaluate {folder}/transfer"""


@dataclass(frozen=True)
class Policy:
    """A policy in the table of results.

    Attributes:
        label: Name in the table.
        path: Run folder or checkpoint file.
        steps: Environment steps of training on the held-out directions.
        pretraining_steps: Environment steps of pre-training on the other directions.
    """

    label: str
    path: Path
    steps: int
    pretraining_steps: int = 0


def run(folder: Path, overrides: Sequence[str]) -> None:
    """Train, evaluate and report in ``folder``, except for results that it already has.

    Raises:
        ValueError: If the settings contradict each other or the folder's, or a process fails.
    """
    began = time.monotonic()
    runs = {name: configure(folder / name, [*RUNS[name], *overrides]) for name in RUNS}
    runs["transfer"].pretrained = runs["pretrain"].run_dir
    require_early_checkpoint(runs)
    settings = runs["pretrain"].demo
    print(f"This takes about {settings.minutes} minutes on two cores. Everything lands in {folder}.")
    print("You may interrupt it: repeat the command to continue.", flush=True)
    show_progress([start(learn_and_transfer, folder, runs), start(learn_from_scratch, folder, runs)], folder, runs)
    print("\n" + report(folder, runs))
    filmed = film(folder, settings.film.seconds)
    print(f"\nAfter {(time.monotonic() - began) / 60:.1f} minutes everything is in {folder}:")
    print(f"{CONTENTS.format(folder=folder)}\n{filmed}")


def film(folder: Path, seconds: float) -> str:
    """Film the ant after transfer, unless there is a film, and return its line in the list of contents."""
    path = folder / FILM
    _, agent, env = restore(folder / "transfer", num_envs=1, seed=0)
    try:
        if not path.exists():
            save_film(agent.actor.policy, env, path, seconds=seconds)
    except RuntimeError as error:
        return f"  no film: {error}"
    return f"  {FILM:35}the ant runs in held-out directions"


def configure(folder: Path, overrides: Sequence[str]) -> DictConfig:
    """Return the configuration of the run in ``folder``.

    Raises:
        ValueError: If the folder holds a run with another configuration.
    """
    cfg = build.compose_run(*overrides)
    cfg.run_dir = str(folder)
    if not (folder / CONFIG).exists():
        return cfg
    held = experiment.run_config(folder)
    began, begins = (cast("dict", OmegaConf.to_container(one, resolve=True)) for one in (held, cfg))
    if differences(began, begins, PLACES):
        raise ValueError(f"{folder} holds a run with other settings: give another --output, or delete it")
    cfg.autocast = held.autocast  # the precision that the run chose
    return cfg


def require_early_checkpoint(runs: Runs) -> None:
    """Check that scratch writes a checkpoint after as many steps as transfer takes."""
    steps, scratch = _steps(runs["transfer"]), runs["scratch"]
    between = scratch.checkpoint_interval * scratch.training.frames_per_batch
    if steps % between and steps != _steps(scratch):
        raise ValueError(
            f"transfer ends after {steps} steps, and scratch has no checkpoint there to compare with, only one every "
            f"{between}: make budget.transfer a multiple of that, or checkpoint_interval smaller"
        )


def policies(folder: Path, runs: Runs) -> dict[str, Policy]:
    """Return the lines of the table."""
    pretraining, transfer, scratch = (_steps(runs[name]) for name in RUNS)
    early = folder / "scratch" / FOLDER / f"checkpoint-{transfer:012d}.torchrl"
    return {
        "before": Policy("MCP before transfer", folder / "pretrain", 0, pretraining),
        "after": Policy("MCP after transfer", folder / "transfer", transfer, pretraining),
        "scratch_early": Policy("scratch", early, transfer),
        "scratch": Policy("scratch", folder / "scratch", scratch),
    }


def learn_and_transfer(folder: Path, runs: Runs) -> None:
    """Pre-train MCP, transfer it, evaluate it before and after, and record its trajectories."""
    experiment.train_or_resume(runs["pretrain"])
    experiment.train_or_resume(runs["transfer"])
    for name in ("before", "after"):
        evaluate(folder, runs, name)
    for name in PANELS:
        record_trajectories(folder, runs, name)


def learn_from_scratch(folder: Path, runs: Runs) -> None:
    """Train scratch on the held-out directions, and evaluate it."""
    experiment.train_or_resume(runs["scratch"])
    for name in ("scratch_early", "scratch"):
        evaluate(folder, runs, name)


def evaluate(folder: Path, runs: Runs, name: str) -> None:
    """Evaluate one of the :func:`policies` on the held-out directions."""
    file, cfg = evaluation_file(folder, name), runs["transfer"]
    if file.exists():
        return
    path, directions = policies(folder, runs)[name].path, cfg.task.directions.transfer
    results = evaluate_run(path, episodes=cfg.demo.episodes, seed=cfg.demo.seed, directions=directions)
    write_json(results, file)


def record_trajectories(folder: Path, runs: Runs, name: str) -> None:
    """Record the trajectories of one of the ``PANELS``."""
    file, (_, run_name, stage) = trajectory_file(folder, name), PANELS[name]
    if file.exists():
        return
    cfg = runs[run_name]
    low, high = cfg.task.directions[stage]
    grid = torch.linspace(low, high, round((high - low) / SPACING) + 1)
    directions = grid.repeat_interleave(cfg.demo.paths.per_direction)
    _, agent, env = restore(
        Path(cfg.run_dir), num_envs=len(directions), seed=cfg.demo.seed, max_episode_steps=cfg.demo.paths.steps
    )
    with replacing(file) as partial:
        analysis.save_trajectories(analysis.play_directions(agent.actor.policy, env, directions), partial)


def show_progress(processes: Sequence[BaseProcess], folder: Path, runs: Runs) -> None:
    """Show the progress of training, then of evaluation, until both are done."""
    files = [evaluation_file(folder, name) for name in policies(folder, runs)]
    files += [trajectory_file(folder, name) for name in PANELS]
    total, done = sum(map(_steps, runs.values())), _steps_taken(folder, runs)
    moments = ticks(processes, interval=1.0)
    with TrainingBar(total, done) as shown:
        for _ in moments:
            before, done = done, _steps_taken(folder, runs)
            shown.advance(done - before, math.nan)
            if done == total:
                break
    with bar(len(files), "evaluation") as evaluated:
        for _ in moments:
            evaluated.update(sum(file.exists() for file in files) - evaluated.n)


def report(folder: Path, runs: Runs) -> str:
    """Write table and figures, and return the table."""
    cfg, lines = runs["transfer"], policies(folder, runs)
    results = {name: json.loads(evaluation_file(folder, name).read_text()) for name in lines}
    low, high = (math.degrees(angle) for angle in cfg.task.directions.transfer)
    table = _table(lines, results) + (
        f"\n\nNormalised return on directions from {low:.0f} to {high:.0f} degrees: mean of {cfg.demo.episodes} "
        "episodes and its 95 % interval. Steps are those of training on these directions, steps before those of "
        f"pre-training on the others. Seed {cfg.seed}, torchrl-mcp {__version__}."
    )
    details = {
        name: {"label": line.label, "steps": line.steps, "pretraining_steps": line.pretraining_steps, **results[name]}
        for name, line in lines.items()
    }
    with replacing(folder / "results.md") as partial:
        partial.write_text(table + "\n")
    write_json(details, folder / "results.json")
    groups = {"MCP, new gate": [folder / "transfer"], "scratch": [folder / "scratch"]}
    curves = analysis.learning_curves(groups, num_bins=20)
    analysis.write_curves(curves, folder / "learning_curves.csv")
    figure = analysis.draw_curves(curves, xlabel="environment steps on the held-out directions")
    analysis.save_figure(figure, folder / "learning_curves")
    panels = {PANELS[name][0]: analysis.load_trajectories(trajectory_file(folder, name)) for name in PANELS}
    analysis.save_figure(analysis.draw_trajectories(panels), folder / "trajectories")
    return table


def evaluation_file(folder: Path, name: str) -> Path:
    """Return the file of the evaluation of one of the :func:`policies`."""
    return folder / "evaluation" / f"{name}.json"


def trajectory_file(folder: Path, name: str) -> Path:
    """Return the file of the trajectories of one of the ``PANELS``."""
    return folder / "trajectories" / f"{name}.npz"


def _table(lines: Mapping[str, Policy], results: Mapping[str, Mapping[str, dict]]) -> str:
    """Return Markdown whose columns line up in a terminal."""
    rows = []
    for name, line in lines.items():
        scores = {
            mode: f"{numbers['normalised_return']:.3f} [{numbers['interval'][0]:.3f}, {numbers['interval'][1]:.3f}]"
            for mode, numbers in results[name].items()
        }
        steps = {"steps": f"{line.steps:,}", "steps before": f"{line.pretraining_steps:,}"}
        rows.append({"policy": line.label, **steps, **scores})
    return text_table(rows, markdown=True)


def _steps_taken(folder: Path, runs: Runs) -> int:
    """Environment steps of all runs so far."""
    tables = (analysis.read_metrics(folder / name) for name in runs)
    return sum(int(table[-1]["frames"]) for table in tables if table)


def _steps(cfg: DictConfig) -> int:
    """Environment steps of a run, rounded up to whole batches."""
    return math.ceil(cfg.training.total_frames / cfg.training.frames_per_batch) * cfg.training.frames_per_batch
