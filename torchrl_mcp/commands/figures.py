"""The paper's Figures 5, 6 and 7 from trained networks, as PNG and SVG, their data as CSV."""

import argparse
import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torch import nn

from torchrl_mcp.analysis import checkpoints, exploration
from torchrl_mcp.analysis.curves import draw_curves, labelled_curves, learning_curves, write_curves
from torchrl_mcp.analysis.exploration import Exploration
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.analysis.holdout import Trajectories, draw_trajectories
from torchrl_mcp.analysis.walk_cycle import draw_walk_cycle
from torchrl_mcp.analysis.walks import action_rows, cycle_rows, primitive_rows, specialisation
from torchrl_mcp.report import sections
from torchrl_mcp.report.cell import Cell
from torchrl_mcp.report.comparison import cells
from torchrl_mcp.report.paper import CHARACTERS
from torchrl_mcp.report.results import Run, read_run
from torchrl_mcp.runs import policies
from torchrl_mcp.runs.tables import text_table

PAPER = """\
The paper (section 5.4) gives no numbers. It reports that weights "show a strong correlation to the phase of a walk
cycle", with a primitive for the left stance and one for the right, in all runs, and that mean actions "form distinct
clusters". Compare with the untrained networks: gates see state and reference, which have a phase of their own."""


def holdout(arguments: argparse.Namespace) -> None:
    """Draw Figure 5: learning curves on the held-out directions, and trajectories by target direction."""
    runs: dict[str, dict[str, list[Path]]] = {}
    for path in arguments.checkpoints:
        cfg = policies.policy_config(path)
        if cfg.task.name != "holdout":
            raise ValueError(f"{path} is of task={cfg.task.name}: Figure 5 is of task=holdout, give runs of that task")
        runs.setdefault(_label(cfg), {}).setdefault(cfg.stage.name, []).append(path)
    for label, stages in runs.items():
        panels: dict[str, Trajectories] = {}
        for stage in sorted(stages):
            panels |= checkpoints.trajectories(stages[stage][0], seed=arguments.seed)
        stem = arguments.output / f"holdout_{label.lower().replace(' ', '_').replace('-', '_')}"
        _save(draw_trajectories({f"{label} {name}": panel for name, panel in panels.items()}), stem)
        _write([row for name, panel in panels.items() for row in _ray_rows(name, panel)], stem)
    if transfers := _cells([path for stages in runs.values() for path in stages.get("transfer", [])]):
        curves = labelled_curves([(sections.row(cell).label, [run.path for run in cell.runs]) for cell in transfers])
        _save(draw_curves(curves), arguments.output / "holdout_curves")
        write_curves(curves, arguments.output / "holdout_curves.csv")


def curves(arguments: argparse.Namespace) -> None:
    """Draw the learning curves of runs in one figure."""
    lines = learning_curves({name: [path] for name, path in _named(arguments.checkpoints)})
    _save(draw_curves(lines), arguments.output / "curves")
    write_curves(lines, arguments.output / "curves.csv")


def explore(arguments: argparse.Namespace) -> None:
    """Draw Figure 6: paths of random exploration, by method."""
    panels, character = _explored(arguments)
    stem = arguments.output / f"exploration_{character}"
    title = CHARACTERS.get(character, character)
    title += f", {arguments.trajectories} times from the same state, seen from above"
    _save(exploration.draw_exploration(panels, title=title), stem)
    _write([{"panel": name, **row} for name, panel in panels.items() for row in exploration.path_rows(panel)], stem)
    numbers = [{"panel": name, **exploration.path_statistics(panel)} for name, panel in panels.items()]
    _write(numbers, stem, "summary")
    print(text_table(numbers))


def _explored(arguments: argparse.Namespace) -> tuple[dict[str, Exploration], str]:
    """Explorations by name, of every checkpoint and of noise, and the name of the character."""
    runs = [(name, *policies.restore(path, num_envs=1, seed=0)[:2]) for name, path in _named(arguments.checkpoints)]
    first = runs[0][1]
    if others := {cfg.character.name for _, cfg, _ in runs} - {first.character.name}:
        given = f"{first.character.name} and {', '.join(others)}"
        raise ValueError(f"checkpoints are of {given}: give those of one character")
    num = arguments.trajectories
    seed = arguments.seed
    std = first.get("action_std", first.character.action_std)
    env, start = checkpoints.ground(first, num, seconds=arguments.seconds, seed=seed)
    panels: dict[str, Exploration] = {}
    for name, cfg, agent in runs:
        explorer = checkpoints.explorer(cfg, agent, num, torch.Generator().manual_seed(seed))
        label = checkpoints.explorer_title(cfg)
        label = f"{label} ({name})" if label in panels else label
        panels[label] = exploration.explore(explorer, agent.parts["observation_normaliser"], env, start)
    generator = torch.Generator().manual_seed(seed)
    noise = exploration.action_noise(env.action_spec.shape[-1], std=std, generator=generator)
    panels[f"no primitives, noise of std {std:g}"] = exploration.explore(noise, nn.Identity(), env, start)
    return panels, first.character.name


def analyse(arguments: argparse.Namespace) -> None:
    """Draw Figure 7: weights over the walk cycle and mean actions of primitives; print their specialisation."""
    rows = []
    for name, path in _named(arguments.checkpoints):
        cfg = policies.policy_config(path)
        walk, untrained = checkpoints.walk_of(
            path, clip=arguments.clip, walkers=arguments.walkers, seconds=arguments.seconds, seed=arguments.seed
        )
        stem = arguments.output / f"primitives_{name}"
        title = f"{cfg.method.title}, {CHARACTERS.get(cfg.character.name, cfg.character.name)}"
        title += f", walking {arguments.clip or 'straight ahead'}"
        _save(draw_walk_cycle(walk, untrained, title=title), stem)
        _write(cycle_rows(walk), stem, "weights")
        _write(action_rows(walk), stem, "actions")
        _write(primitive_rows(walk), stem)
        shared = {"checkpoint": name, "character": cfg.character.name, "seed": cfg.seed, "strides": walk.strides}
        rows += [
            {**shared, "networks": networks, **numbers}
            for networks, numbers in (("trained", specialisation(walk)), ("untrained", untrained))
        ]
    _write(rows, arguments.output / "primitives")
    print(f"{text_table(rows)}\n{PAPER}")


def _ray_rows(name: str, panel: Trajectories) -> list[dict[str, object]]:
    return [
        {
            "panel": " ".join(name.split()),
            "direction": round(direction, 4),
            "step": step,
            "x": round(x, 3),
            "y": round(y, 3),
        }
        for direction, path in zip(panel.directions.tolist(), panel.positions.swapaxes(0, 1).tolist(), strict=True)
        for step, (x, y) in enumerate(path, start=1)
        if step % 4 == 0 and math.isfinite(x)
    ]


def _cells(folders: Sequence[Path]) -> list[Cell]:
    """Cells of run folders, as in the report."""
    runs = []
    for folder in folders:
        if not isinstance(run := read_run(folder), Run):
            raise ValueError(f"{folder}: {run.reason}; give run folders, which have learning curves")
        runs.append(run)
    return cells(runs)


def _label(cfg: DictConfig) -> str:
    """Title of a method, with its mixer and exploration if they are not standard."""
    details = []
    if cfg.method.standard.get("mixer") not in (None, cfg.mixer.name):
        details.append(cfg.mixer.name)
    exploration = cfg.get("exploration", {})
    explores = exploration and cfg.actor._target_ == exploration.actor._target_ and cfg.mixer.name == "multiplicative"
    if explores and cfg.stage.name == "transfer" and exploration.name == "action":
        details.append("over actions")
    return " ".join([cfg.method.title, *details])


def _named(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Paths with names for files: the shortest ends of the paths that are unique."""
    whole = [path.resolve().with_suffix("") if path.is_file() else path.resolve() for path in paths]
    for depth in range(1, max(len(path.parts) for path in whole) + 1):
        names = ["-".join(path.parts[-depth:]) for path in whole]
        if len(set(names)) == len(names):
            return list(zip(names, paths, strict=True))
    raise ValueError("a checkpoint is named twice: give each once")


def _save(figure: Figure, stem: Path) -> None:
    for path in save_figure(figure, stem):
        print(path)


def _write(rows: Sequence[Mapping[str, object]], stem: Path, part: str = "") -> None:
    path = stem.with_name(f"{stem.name}{part and '_'}{part}.csv")
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        for row in rows:
            writer.writerow({key: f"{x:.5g}" if isinstance(x, float) else x for key, x in row.items()})
    print(path)
