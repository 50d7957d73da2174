"""The ant holdout experiment: Figure 5 and the last row of Tables 1 and 2.

    python benchmarks/holdout.py --output runs/holdout    # hours; resumes after an interruption

MCP is pre-trained on directions in [0, 3/2 pi] and transferred to [3/2 pi, 2 pi], exploring over actions and over
weights, and so are the additive mixer and the baselines. Scratch learns the held-out directions alone, for as many
steps as pre-training and transfer together. Every run is a call of ``torchrl-mcp-train``, on one core.
"""

import argparse
import math
import os
import shlex
import statistics
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import torch
from report import write

from torchrl_mcp.analysis import draw_curves, learning_curves, read_metrics, write_curves
from torchrl_mcp.analysis.figures import save_figure
from torchrl_mcp.analysis.holdout import Trajectories, draw_trajectories, play_directions
from torchrl_mcp.report.results import Run, read_run
from torchrl_mcp.runs import policies
from torchrl_mcp.runs.tables import text_table
from torchrl_mcp.training.run_folder import CONFIG

RESULTS = Path(__file__).resolve().parent / "results"
PRETRAINING, TRANSFER = 1_000_000, 600_000
COMMON = [
    *("task=holdout", "preset=fast", "width=1.0", "learned_std=false"),
    *("logger=none", "torch_threads=1", "num_threads=1", "progress_bar=false"),
]


@dataclass(frozen=True)
class Contender:
    """A line of the table.

    Attributes:
        label: Name in the table.
        pretraining: One of ``PRETRAININGS``, or None.
        settings: Settings of the transfer, in addition to those of the pre-training.
        steps: Steps of the transfer.
        paper: The paper's result.
    """

    label: str
    pretraining: str | None
    settings: tuple[str, ...] = ()
    steps: int = TRANSFER
    paper: str = ""


PRETRAININGS = {
    "multiplicative": ["mixer=multiplicative"],
    "additive": ["mixer=additive"],
    **{method: [f"method={method}"] for method in ("latent_space", "finetune", "moe", "option_critic")},
}

CONTENDERS = {
    "transfer-multiplicative-action": Contender(
        "MCP, over actions", "multiplicative", ("exploration=action",), paper="0.812 +- 0.030"
    ),
    "transfer-multiplicative-weights": Contender("MCP, over weights", "multiplicative", ("exploration=weights",)),
    "transfer-additive-action": Contender("additive mixer", "additive"),
    "transfer-latent_space": Contender("latent space", "latent_space", paper="0.745 +- 0.060"),
    "transfer-finetune": Contender("finetune", "finetune", paper="0.885 +- 0.062"),
    "transfer-moe": Contender("mixture of experts", "moe"),
    "transfer-option_critic": Contender("option-critic", "option_critic"),
    "scratch": Contender("scratch", None, ("method=scratch",), PRETRAINING + TRANSFER, "0.951 +- 0.093"),
}

DIRECTIONS = {"pretrain": (0.0, 1.5 * math.pi), "transfer": (1.5 * math.pi, 2.0 * math.pi)}
SPACING = math.radians(7.5)
PANELS = {
    "MCP as pre-trained,\non directions it saw": ("pretrain-multiplicative", "pretrain"),
    "MCP as pre-trained,\non held-out directions": ("pretrain-multiplicative", "transfer"),
    "MCP after transfer,\non held-out directions": ("transfer-multiplicative-action", "transfer"),
    "scratch,\non held-out directions": ("scratch", "transfer"),
}


def main() -> None:
    """Train missing runs, evaluate, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--output", type=Path, default=Path("runs/holdout"), help="folder of the run folders")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="runs at a time, one core each")
    parser.add_argument("--report", action="store_true", help="train nothing: report the runs that have ended")
    parser.add_argument("--episodes", type=int, default=128, help="of each evaluation")
    arguments = parser.parse_args()
    if arguments.report:
        report(arguments.output, arguments.seeds, arguments.episodes)
        return
    chains = [(name, seed) for seed in arguments.seeds for name in CONTENDERS]
    pretrainings = [(name, seed) for seed in arguments.seeds for name in PRETRAININGS]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        list(pool.map(lambda job: pretrain(arguments.output, *job), pretrainings))
        list(pool.map(lambda job: learn(arguments.output, *job), chains))
    report(arguments.output, arguments.seeds, arguments.episodes)


def pretrain(folder: Path, name: str, seed: int) -> None:
    """Pre-train a method or mixer, or finish its run."""
    settings = ["stage=pretrain", *PRETRAININGS[name], f"training.total_frames={PRETRAINING}"]
    train(folder / f"pretrain-{name}-{seed}", [*settings, f"seed={seed}"])


def learn(folder: Path, name: str, seed: int) -> None:
    """Train a contender on the held-out directions, or finish its run."""
    contender = CONTENDERS[name]
    settings = ["stage=transfer", *contender.settings, f"training.total_frames={contender.steps}"]
    if contender.pretraining:
        pretrained = folder / f"pretrain-{contender.pretraining}-{seed}"
        settings += [*PRETRAININGS[contender.pretraining], f"pretrained={pretrained}"]
    train(folder / f"{name}-{seed}", [*settings, f"seed={seed}"])


def train(run: Path, settings: list[str]) -> None:
    """Train in a separate process, or resume the run."""
    arguments = [f"resume={run}"] if (run / CONFIG).exists() else [*COMMON, *settings, f"run_dir={run}"]
    command = [sys.executable, "-m", "torchrl_mcp.cli.train", *arguments]
    subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})


def report(folder: Path, seeds: list[int], episodes: int) -> None:
    """Evaluate all finished runs, and write table, curves and figures to ``benchmarks/results``."""
    ended = {name: [s for s in seeds if has_ended(folder / f"{name}-{s}", c.steps)] for name, c in CONTENDERS.items()}
    rows = [row for name in CONTENDERS for seed in ended[name] for row in evaluate(folder, name, seed, episodes)]
    write(RESULTS / "holdout.csv", rows)
    groups = {c.label: [folder / f"{name}-{s}" for s in ended[name]] for name, c in CONTENDERS.items() if ended[name]}
    curves = learning_curves(groups)
    write_curves(curves, RESULTS / "holdout_curves.csv")
    save_figure(draw_curves(curves), RESULTS / "holdout_curves")
    panels = {title: trajectories(folder / f"{name}-{seeds[0]}", stage) for title, (name, stage) in PANELS.items()}
    save_figure(draw_trajectories(panels), RESULTS / "holdout_trajectories")
    print(table(rows))


def has_ended(run: Path, steps: int) -> bool:
    """Return whether a run has taken all its steps."""
    rows = read_metrics(run)
    return bool(rows) and rows[-1]["frames"] >= steps


def trajectories(run: Path, stage: str) -> Trajectories:
    """Return trajectories of a run's policy for the target directions of ``stage``."""
    low, high = DIRECTIONS[stage]
    directions = torch.linspace(low, high, round((high - low) / SPACING) + 1, dtype=torch.float64)
    _, agent, env = policies.restore(run, num_envs=len(directions), seed=12345)
    return play_directions(agent.actor.policy, env, directions)


def evaluate(folder: Path, name: str, seed: int, episodes: int) -> list[dict]:
    """Return the results of a run, deterministic and stochastic, with everything needed to reproduce it."""
    contender, path = CONTENDERS[name], folder / f"{name}-{seed}"
    run = read_run(path)
    if not isinstance(run, Run):
        raise ValueError(f"{path} {run.reason}")
    numbers = policies.evaluate_run(path, episodes=episodes, seed=12345)
    for values in numbers.values():
        del values["metrics"], values["diagnostics"]
    facts = {
        "contender": name,
        "label": contender.label,
        "seed": seed,
        "pretraining_steps": PRETRAINING if contender.pretraining else 0,
        "frames": contender.steps,
        "preset": "fast",
    }
    source = {
        "seconds": round(run.seconds),
        "commit": run.commit,
        **run.provenance.get("machine", {}),
        "command": shlex.join(run.provenance.get("command", [])).replace(str(folder.resolve()), "runs/holdout"),
    }
    return [facts | {"mode": mode, "paper": contender.paper} | values | source for mode, values in numbers.items()]


def table(rows: list[dict]) -> str:
    """Return the results as Markdown: mean and standard deviation over seeds."""
    lines = []
    for name, contender in CONTENDERS.items():
        scores = {
            mode: [row["normalised_return"] for row in rows if (row["contender"], row["mode"]) == (name, mode)]
            for mode in ("deterministic", "stochastic")
        }
        facts = {"": contender.label, "steps": f"{contender.steps:,}", "seeds": len(scores["deterministic"])}
        means = {mode: spread(values) for mode, values in scores.items()}
        lines.append(facts | means | {"paper": contender.paper})
    return text_table(lines, markdown=True)


def spread(values: list[float]) -> str:
    """Return mean and standard deviation, if there are enough values."""
    deviation = f" +- {statistics.stdev(values):.3f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):.3f}{deviation}" if values else ""


if __name__ == "__main__":
    main()
