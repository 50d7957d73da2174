"""Shows in how few samples an update changes a Gaussian policy by much.

    python benchmarks/divergence.py runs/dribble-biped/transfer/latent_space/preset-comparison/seed0 --updates 20

From each checkpoint of the run but its first and its last, the script repeats the next updates in a copy of the run and
compares the policy before and after each update, in all samples of the batch. ``results/divergence.csv`` gets a row for
each update:

- ``estimate``: the KL divergence of the update in nats, as the training estimates it to adapt the step size;
- ``exact``: the exact KL divergence of the new from the old policy, averaged over the samples;
- ``without_extremes``: the same average without the thousandth of the samples with the largest divergences;
- ``median``, ``largest``: median and largest divergence of a sample;
- ``far_inputs``, ``far_inputs_of_extremes``: mean number of normalised features of the state above 5 or below -5, in
  all samples and in that thousandth of the samples;
- ``smallest_std``: the smallest standard deviation of the new policy.

An update takes about ten seconds on one core. A run has only the checkpoints that ``keep_checkpoints`` keeps.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from omegaconf import DictConfig
from report import about, append, table
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Independent, Normal, kl_divergence

from torchrl_mcp.runs import build, records
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.run_folder import find_all, frames
from torchrl_mcp.training.update import Update

RESULTS = Path(__file__).resolve().parent / "results" / "divergence.csv"

FAR = 5.0
"""Standard deviations from the mean beyond which a feature is far."""

EXTREMES = 0.001
"""Share of the samples that count as extremes."""


class Comparison:
    """An update that compares the policy before and after each call.

    Args:
        update: The update.

    Attributes:
        rows: One row of measurements per call.
    """

    def __init__(self, update: Update) -> None:
        self.update = update
        self.rows: list[dict[str, Any]] = []

    def __call__(self, batch: TensorDictBase, *, warming_up: bool) -> dict[str, float]:
        """Learn from trajectories ``(N, T)``, and return the metrics of the update."""
        agent = self.update.agent
        samples = batch.select("observation", "goal", *agent.actor.stored).flatten()
        states = agent.parts["observation_normaliser"](samples["observation"])
        before = self._policy(samples)
        metrics = self.update(batch, warming_up=warming_up)
        after = self._policy(samples)
        self.rows.append({"estimate": metrics["loss/kl"], **changes(states, before, after)})
        return metrics

    def _policy(self, samples: TensorDictBase) -> Independent:
        """Return the distribution ``(B, D)`` of the sampled variable."""
        with torch.no_grad():
            distribution = self.update.agent.actor.trained.get_dist(samples.clone())
            return Independent(Normal(distribution.mean.clone(), distribution.stddev.clone()), 1)


def changes(states: Tensor, before: Independent, after: Independent) -> dict[str, float]:
    """Compare a policy before and after an update, in ``B`` samples.

    Args:
        states: Normalised features of the samples' states, ``(B, S)``.
        before: The policy before the update, with batch shape ``(B,)``.
        after: The policy after the update, of the same shape.

    Returns:
        The measurements that the head of this file lists, except ``estimate``; divergences are in nats.
    """
    divergences = kl_divergence(before, after)
    order = divergences.argsort(descending=True)
    count = max(1, round(EXTREMES * len(order)))
    far_inputs = (states.abs() > FAR).sum(-1).float()
    return {
        "exact": divergences.mean().item(),
        "without_extremes": divergences[order[count:]].mean().item(),
        "median": divergences.median().item(),
        "largest": divergences.max().item(),
        "far_inputs": far_inputs.mean().item(),
        "far_inputs_of_extremes": far_inputs[order[:count]].mean().item(),
        "smallest_std": after.stddev.min().item(),
    }


def repeat(cfg: DictConfig, path: Path, updates: int) -> Iterator[dict[str, Any]]:
    """Yield a row for each of the updates after a checkpoint."""
    with TemporaryDirectory() as copy:
        cfg.training.total_frames = frames(path) + updates * cfg.training.frames_per_batch
        cfg.progress_bar = False
        cfg.checkpoint_interval = updates
        trainer = build.make_run(cfg, Path(copy))
        checkpoint.load(trainer.checkpoint, path)
        first = trainer.progress.iteration + 1
        comparison = Comparison(trainer.update)
        trainer.update = comparison
        trainer.run()
        for iteration, row in enumerate(comparison.rows, first):
            yield {"method": cfg.method.name, "seed": cfg.seed, "iteration": iteration, **row, **about()}


def main() -> None:
    """Repeat updates, print the rows and append them to the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("--updates", type=int, default=20, help="updates after each checkpoint (default %(default)s)")
    parser.add_argument("--output", type=Path, default=RESULTS, help=f"CSV file (default {RESULTS.name})")
    arguments = parser.parse_args()
    for path in find_all(arguments.run)[-2:0:-1]:
        rows = list(repeat(records.run_config(arguments.run), path, arguments.updates))
        for row in rows:
            append(arguments.output, row)
        shown = ["iteration", "estimate", "exact", "without_extremes", "median", "largest"]
        print(table([{name: row[name] for name in shown} for row in rows]), flush=True)


if __name__ == "__main__":
    main()
