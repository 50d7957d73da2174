"""``torchrl-mcp-figures``: the paper's Figures 5, 6 and 7 from trained networks, as PNG and SVG, their data as CSV."""

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from torchrl_mcp.commands.parsing import add_trust, announce, count, entry_point, new_parser, seconds, seed
from torchrl_mcp.report.paper import CHARACTERS
from torchrl_mcp.runs.builtin import PREFIX, locate

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from omegaconf import DictConfig

    from torchrl_mcp.analysis.exploration import Exploration
    from torchrl_mcp.analysis.holdout import Trajectories
    from torchrl_mcp.report.cell import Cell

PROGRAM = "torchrl-mcp-figures"

EXAMPLES = f"""\
A CHECKPOINT is a run folder (its newest checkpoint), a checkpoint file, or {PREFIX}CHARACTER, a network that comes with
the library.

examples:
  {PROGRAM} curves runs/first runs/second                       # learning curves in one figure
  {PROGRAM} holdout runs/holdout/*                              # Figure 5
  {PROGRAM} exploration {PREFIX}humanoid runs/latent-humanoid   # Figure 6
  {PROGRAM} primitives {PREFIX}biped {PREFIX}humanoid           # Figure 7
"""

PAPER = """\
The paper (section 5.4) gives no numbers. It reports that weights "show a strong correlation to the phase of a walk
cycle", with a primitive for the left stance and one for the right, in all runs, and that mean actions "form distinct
clusters". Compare with the untrained networks: gates see state and reference, which have a phase of their own."""


@entry_point(PROGRAM)
def main(words: list[str]) -> None:
    """Draw the figure that the subcommand names."""
    arguments = parser().parse_args(words)
    arguments.checkpoints = [locate(name) for name in arguments.checkpoints]
    announce(PROGRAM)
    from torchrl_mcp.runs.trust import trusting

    with trusting(arguments.trust):
        arguments.draw(arguments)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    description = (
        "Draw the paper's Figures 5, 6 and 7 from trained networks, as PNG and SVG, and write their data as CSV."
    )
    parser = new_parser(PROGRAM, description, EXAMPLES)
    commands = parser.add_subparsers(required=True, metavar="command")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--output", type=Path, default=Path("figures"), help="folder to write to (default %(default)s)")
    add_trust(shared)
    shared.add_argument("--seed", type=seed, default=0, help="seed of random numbers (default %(default)s)")

    command = commands.add_parser(
        "curves", parents=[takes("run folder"), shared], help="draw learning curves of several runs in one figure"
    )
    command.set_defaults(draw=curves)
    command = commands.add_parser(
        "holdout",
        parents=[takes("run folder or checkpoint file"), shared],
        help="draw Figure 5: learning curves, and trajectories of the ant in the first run of each method and stage",
    )
    command.set_defaults(draw=holdout)
    command = commands.add_parser(
        "exploration",
        parents=[takes("run folder, checkpoint file or builtin:CHARACTER"), shared],
        help="draw Figure 6: paths of random exploration",
    )
    command.add_argument(
        "--trajectories", type=count, default=48, metavar="N", help="number of paths (default %(default)s)"
    )
    command.add_argument("--seconds", type=seconds, default=10.0, help="duration of each path (default %(default)s)")
    command.set_defaults(draw=explore)
    command = commands.add_parser(
        "primitives",
        parents=[takes("run folder, checkpoint file or builtin:CHARACTER"), shared],
        help="draw Figure 7: weights over the walk cycle, and actions",
    )
    command.add_argument(
        "--clip", help="generated motion to follow, such as left_sharp (default: a walk straight ahead)"
    )
    command.add_argument(
        "--walkers", type=count, default=8, metavar="N", help="number of simulations (default %(default)s)"
    )
    command.add_argument("--seconds", type=seconds, default=10.0, help="duration of each walk (default %(default)s)")
    command.set_defaults(draw=analyse)
    return parser


def takes(kinds: str) -> argparse.ArgumentParser:
    """Return the parent of the parser of a command that takes checkpoints, of the kinds that its help names."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("checkpoints", nargs="+", metavar="CHECKPOINT", help=kinds)
    return parser


def holdout(arguments: argparse.Namespace) -> None:
    """Draw Figure 5: learning curves on the held-out directions, and trajectories by target direction."""
    from torchrl_mcp.analysis import checkpoints
    from torchrl_mcp.analysis.curves import draw_curves, labelled_curves, write_curves
    from torchrl_mcp.analysis.holdout import draw_trajectories
    from torchrl_mcp.report import sections
    from torchrl_mcp.runs import policies

    runs: dict[str, dict[str, list[Path]]] = {}
    for path in arguments.checkpoints:
        cfg = policies.policy_config(path)
        if cfg.task.name != "holdout":
            raise ValueError(f"{path} is of task={cfg.task.name}: pass runs of task=holdout, which Figure 5 shows")
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
    from torchrl_mcp.analysis.curves import draw_curves, learning_curves, write_curves

    lines = learning_curves({name: [path] for name, path in _named(arguments.checkpoints)})
    _save(draw_curves(lines), arguments.output / "curves")
    write_curves(lines, arguments.output / "curves.csv")


def explore(arguments: argparse.Namespace) -> None:
    """Draw Figure 6: paths of random exploration, by method."""
    from torchrl_mcp.analysis import exploration
    from torchrl_mcp.runs.tables import text_table

    panels, character = _explored(arguments)
    stem = arguments.output / f"exploration_{character}"
    whose = CHARACTERS.get(character, character)
    title = f"{whose}, {arguments.trajectories} times from the same state, seen from above"
    _save(exploration.draw_exploration(panels, title=title), stem)
    _write([{"panel": name, **row} for name, panel in panels.items() for row in exploration.path_rows(panel)], stem)
    numbers = [{"panel": name, **exploration.path_statistics(panel)} for name, panel in panels.items()]
    _write(numbers, stem, "summary")
    print(text_table(numbers))


def _explored(arguments: argparse.Namespace) -> tuple[dict[str, "Exploration"], str]:
    """Return the explorations of every checkpoint and of noise by name, and the name of the character."""
    import torch

    from torchrl_mcp.analysis import checkpoints, exploration
    from torchrl_mcp.runs import policies

    runs = [(name, *policies.restore(path, num_envs=1, seed=0)[:2]) for name, path in _named(arguments.checkpoints)]
    first = runs[0][1]
    characters = dict.fromkeys(cfg.character.name for _, cfg, _ in runs)
    if len(characters) > 1:
        raise ValueError(f"the checkpoints are of {' and '.join(characters)}: pass checkpoints of one character")
    number = arguments.trajectories
    seed = arguments.seed
    std = first.get("action_std", first.character.action_std)
    env, start = checkpoints.ground(first, number, seconds=arguments.seconds, seed=seed)
    panels: dict[str, Exploration] = {}
    for name, cfg, agent in runs:
        explorer = checkpoints.explorer(cfg, agent, number, torch.Generator().manual_seed(seed))
        label = checkpoints.explorer_title(cfg)
        label = f"{label} ({name})" if label in panels else label
        panels[label] = exploration.explore(explorer, agent.parts["observation_normaliser"], env, start)
    generator = torch.Generator().manual_seed(seed)
    noise = exploration.action_noise(env.action_spec.shape[-1], std=std, generator=generator)
    panels[f"no primitives, noise of std {std:g}"] = exploration.explore(noise, torch.nn.Identity(), env, start)
    return panels, first.character.name


def analyse(arguments: argparse.Namespace) -> None:
    """Draw Figure 7: weights over the walk cycle and mean actions of primitives; print their specialisation."""
    from torchrl_mcp.analysis import checkpoints
    from torchrl_mcp.analysis.walk_cycle import draw_walk_cycle
    from torchrl_mcp.analysis.walks import action_rows, cycle_rows, primitive_rows, specialisation
    from torchrl_mcp.runs import policies
    from torchrl_mcp.runs.tables import text_table

    rows = []
    for name, path in _named(arguments.checkpoints):
        cfg = policies.policy_config(path)
        walk, untrained = checkpoints.walk_of(
            path, clip=arguments.clip, walkers=arguments.walkers, seconds=arguments.seconds, seed=arguments.seed
        )
        stem = arguments.output / f"primitives_{name}"
        whose = CHARACTERS.get(cfg.character.name, cfg.character.name)
        title = f"{cfg.method.title}, {whose}, walking {arguments.clip or 'straight ahead'}"
        _save(draw_walk_cycle(walk, untrained, title=title), stem)
        _write(cycle_rows(walk), stem, "weights")
        _write(action_rows(walk), stem, "actions")
        _write(primitive_rows(walk), stem)
        shared = {"checkpoint": name, "character": cfg.character.name, "seed": cfg.seed, "strides": walk.strides}
        rows.append({**shared, "networks": "trained", **specialisation(walk)})
        rows.append({**shared, "networks": "untrained", **untrained})
    _write(rows, arguments.output / "primitives")
    print(f"{text_table(rows)}\n{PAPER}")


def _ray_rows(name: str, panel: "Trajectories") -> list[dict[str, object]]:
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


def _cells(folders: Sequence[Path]) -> "list[Cell]":
    """Return the cells of run folders, as in the report."""
    from torchrl_mcp.report.comparison import cells
    from torchrl_mcp.report.results import Run, read_run

    runs = []
    for folder in folders:
        if not isinstance(run := read_run(folder), Run):
            raise ValueError(f"{folder}: {run.reason}; pass run folders, which have learning curves")
        runs.append(run)
    return cells(runs)


def _label(cfg: "DictConfig") -> str:
    """Return the title of a method, with its mixer and exploration if they are not standard."""
    details = []
    if cfg.method.standard.get("mixer") not in (None, cfg.mixer.name):
        details.append(cfg.mixer.name)
    exploration = cfg.get("exploration", {})
    explores = exploration and cfg.actor._target_ == exploration.actor._target_ and cfg.mixer.name == "multiplicative"
    if explores and cfg.stage.name == "transfer" and exploration.name == "action":
        details.append("over actions")
    return " ".join([cfg.method.title, *details])


def _named(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Return paths with names for files: the shortest ends of the paths that are unique."""
    stems = [path.resolve().with_suffix("") if path.is_file() else path.resolve() for path in paths]
    for depth in range(1, max(len(stem.parts) for stem in stems) + 1):
        names = ["-".join(stem.parts[-depth:]) for stem in stems]
        if len(set(names)) == len(names):
            return list(zip(names, paths, strict=True))
    raise ValueError("the command line names a checkpoint twice: pass each once")


def _save(figure: "Figure", stem: Path) -> None:
    from torchrl_mcp.analysis.figures import save_figure

    for path in save_figure(figure, stem):
        print(path)


def _write(rows: Sequence[Mapping[str, object]], stem: Path, part: str = "") -> None:
    from torchrl_mcp.runs.tables import write_csv

    path = stem.with_name(f"{stem.name}{part and '_'}{part}.csv")
    write_csv(rows, path, digits=5)
    print(path)


if __name__ == "__main__":
    main()
