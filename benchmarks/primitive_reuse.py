"""Time of an update at transfer, with frozen primitives evaluated once per step or in every minibatch.

    python benchmarks/primitive_reuse.py            # minutes, writes results/primitive_reuse.csv
    python benchmarks/primitive_reuse.py --quick    # seconds, writes nothing unless given --output

The library stores the outputs of frozen primitives when a step is collected, because acting needs them anyway, and its
loss evaluates the gate alone (*reuse*). With *no reuse*, the loss evaluates the primitives again, without gradients for
their parameters. Both run the trainer's whole update (``num_epochs`` passes of gradient steps on gate and critic) on
the same batch of random states, in turns. The sizes are those of the ant (S=27, G=2, A=8) and of a humanoid (S=196,
G=13, A=28), with the networks and K=8 primitives of method=mcp and the batch of preset=fast.
"""

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from hydra.utils import instantiate
from omegaconf import DictConfig
from report import about, table, write
from tensordict import TensorDict, TensorDictBase

from torchrl_mcp.runs import build
from torchrl_mcp.training.collectors import LocalSource
from torchrl_mcp.training.trainer import Trainer

RESULTS = Path(__file__).resolve().parent / "results" / "primitive_reuse.csv"
QUICK_TRAINING = {"num_envs": 16, "frames_per_batch": 256, "minibatch_size": 128, "num_epochs": 2}
TOLERANCE = 1e-3  # on a loss of the order of 0.1: rounding differs with the size of a matrix product


class Sizes(NamedTuple):
    """Sizes of state, goal and action."""

    observation: int
    goal: int
    action: int


CHARACTERS = {"ant": Sizes(27, 2, 8), "humanoid": Sizes(196, 13, 28)}


def make_trainer(cfg: DictConfig, sizes: Sizes, folder: Path, *, reuse: bool) -> Trainer:
    """Return the trainer of an agent of these sizes, with the same weights in every call."""
    num_envs = cfg.training.num_envs
    env: Any = SimpleNamespace(  # the attributes of an environment with its sizes
        batch_size=[num_envs],
        observation_spec={"observation": torch.empty(num_envs, sizes.observation), "goal": torch.empty(1, sizes.goal)},
        action_spec=torch.empty(num_envs, sizes.action),
    )
    torch.manual_seed(cfg.seed)
    agent = build.make_agent(cfg, env)
    if not reuse:
        agent = replace(agent, actor=instantiate(cfg.actor)(agent.parts))
    return build.make_trainer(cfg, agent, LocalSource(env), folder)


@torch.no_grad()
def collect(trainer: Trainer, sizes: Sizes) -> TensorDictBase:
    """Return a batch ``(N, T)`` of random states, as after collection and estimation of advantages."""
    num_envs = trainer.source.num_envs
    steps = []
    for _ in range(trainer.frames_per_batch // num_envs):
        state = {"observation": torch.randn(num_envs, sizes.observation), "goal": torch.randn(num_envs, sizes.goal)}
        with torch.autocast("cpu", torch.bfloat16, enabled=trainer.autocast):
            steps.append(trainer.actor.policy(TensorDict(state, [num_envs])))
    batch = TensorDict.stack(steps, 1)
    for key in ("advantage", "value_target", "state_value"):
        batch[key] = torch.randn(*batch.shape, 1)
    return batch


def update(trainer: Trainer, batch: TensorDictBase) -> tuple[float, dict[str, float]]:
    """Return the milliseconds of an update and the means of its loss's outputs."""
    start = time.perf_counter()
    metrics = trainer._update(batch, warming_up=False)
    return (time.perf_counter() - start) * 1e3, metrics


def compare(character: str, precision: str, training: dict[str, int], repeats: int) -> dict[str, Any]:
    """Return the row of a character and a precision."""
    sizes = CHARACTERS[character]
    overrides = [f"training.{key}={value}" for key, value in training.items()]
    cfg = build.compose_run(
        "method=mcp", "stage=transfer", "width=1.0", f"autocast={precision == 'bf16'}", "run_dir=.", *overrides
    )
    with TemporaryDirectory() as folder:
        trainers = {
            name: make_trainer(cfg, sizes, Path(folder), reuse=name == "reuse") for name in ("reuse", "no_reuse")
        }
    batch = collect(trainers["reuse"], sizes)
    first = {}
    for name, trainer in trainers.items():  # not counted: first calls allocate
        torch.manual_seed(cfg.seed)
        _, first[name] = update(trainer, batch)
    losses = [first[name]["loss/loss_objective"] for name in trainers]
    if abs(losses[0] - losses[1]) > TOLERANCE:
        raise RuntimeError(f"the two sides are to take the same gradient steps, but their losses are {losses}")
    milliseconds: dict[str, list[float]] = {name: [] for name in trainers}
    for _ in range(repeats):
        for name, trainer in trainers.items():
            milliseconds[name].append(update(trainer, batch)[0])
    ratios = [slow / fast for fast, slow in zip(milliseconds["reuse"], milliseconds["no_reuse"], strict=True)]
    return {
        "character": character,
        "precision": precision,
        **{f"{name}_ms": round(median(values), 1) for name, values in milliseconds.items()},
        "ratio": round(median(ratios), 3),
        **{f"{name}_ms_min": round(min(values), 1) for name, values in milliseconds.items()},
        "ratio_min": round(min(milliseconds["no_reuse"]) / min(milliseconds["reuse"]), 3),
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small batch, fewer repeats")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="torch threads")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    repeats = 2 if args.quick else 10
    preset = build.compose_run("preset=fast").training
    training = QUICK_TRAINING if args.quick else {key: preset[key] for key in QUICK_TRAINING}
    conditions = {**training, "threads": args.threads, "repeats": repeats, **about()}
    print(" | ".join(f"{key} {value}" for key, value in conditions.items()), flush=True)
    rows = [compare(name, precision, training, repeats) for name in CHARACTERS for precision in ("fp32", "bf16")]
    print(table(rows))
    if output := args.output or (None if args.quick else RESULTS):
        write(output, [{**row, **conditions} for row in rows])
        print(f"written to {output}")


if __name__ == "__main__":
    main()
