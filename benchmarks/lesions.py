"""Measures how the biped's MCP follows each walk without one of its primitives.

    python benchmarks/lesions.py    # 15 minutes on one core, writes results/lesions.csv

For each of the three pre-trainings in ``results/table2/networks``, the script removes one primitive after the other
from the product (weight 0), or fixes its weight at the mean, so that the gate no longer controls it. ``completed`` is
the share of episodes in which the biped neither falls nor loses the reference, for each clip and over all clips.
``steps`` is the mean length of the episodes, at most 300. Episodes are deterministic, and their beginnings are spread
evenly over the clip. ``--quick`` takes seconds, removes one primitive of one seed, and writes nothing without
``--output``.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from statistics import mean
from typing import Any, cast

import torch
from report import about, table, write
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import Tensor, nn

from torchrl_mcp.evaluation.clips import ClipResult, follow_each
from torchrl_mcp.runs import policies

RESULTS = Path(__file__).resolve().parent / "results"
EPISODES = 16
"""Number of episodes per clip."""


class Lesion(nn.Module):
    """Fixes the weight of one primitive, and stores the mean weights of every call.

    Args:
        primitive: Number of the primitive, from 0, or None for an intact gate.
        weight: The fixed weight.
    """

    def __init__(self, primitive: int | None = None, weight: float = 0.0) -> None:
        super().__init__()
        self.primitive = primitive
        self.weight = weight
        self.means: list[Tensor] = []

    def forward(self, gates: Tensor) -> Tensor:
        """Return weights ``(N, K)`` with the lesion."""
        self.means.append(gates.mean(0))
        if self.primitive is None:
            return gates
        return gates.index_fill(-1, torch.tensor(self.primitive), self.weight)


def follow(network: Path, lesion: Lesion, *, episodes: int, threads: int) -> list[ClipResult]:
    """Follow every clip with a lesion, each in ``episodes`` episodes."""
    agent, env = policies.restore_for_clips(network, episodes=episodes, seed=12345, num_threads=threads)
    *before, head = cast("ProbabilisticTensorDictSequential", agent.actor.policy)
    policy = ProbabilisticTensorDictSequential(
        *before, TensorDictModule(lesion, in_keys=["gates"], out_keys=["gates"]), head
    )
    return follow_each(policy, env)


def rows(seeds: list[int], primitives: int, *, episodes: int, threads: int) -> Iterator[dict[str, Any]]:
    """Yield rows of the intact networks, and of each primitive with weight 0 and with its mean weight."""
    for seed in seeds:
        network = RESULTS / "table2" / "networks" / f"mcp-biped-{seed}.torchrl"
        intact = Lesion()
        results = follow(network, intact, episodes=episodes, threads=threads)
        yield row(seed, "none", "", results, episodes)
        means = torch.stack(intact.means).mean(0).tolist()
        for kind, weights in (("weight 0", [0.0] * len(means)), ("mean weight", means)):
            for primitive, weight in enumerate(weights[:primitives]):
                results = follow(network, Lesion(primitive, weight), episodes=episodes, threads=threads)
                yield row(seed, kind, primitive + 1, results, episodes)


def row(seed: int, lesion: str, primitive: int | str, results: list[ClipResult], episodes: int) -> dict[str, Any]:
    """Return the row of one lesion, in which primitives are counted from 1, as in figures."""
    return {
        "seed": seed,
        "lesion": lesion,
        "primitive": primitive,
        "completed": round(mean(result.completed for result in results), 3),
        "steps": round(mean(result.length for result in results)),
        "episodes": episodes * len(results),
        **{result.clip: round(result.completed, 3) for result in results},
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed, one primitive, one episode per clip")
    parser.add_argument("--threads", type=int, default=1, help="threads of networks and physics")
    parser.add_argument("--output", type=Path, help="CSV file; without --quick it is lesions.csv by default")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    seeds, primitives, episodes = ([0], 1, 1) if arguments.quick else ([0, 1, 2], 8, EPISODES)
    measured = list(rows(seeds, primitives, episodes=episodes, threads=arguments.threads))
    print(table([{key: line[key] for key in list(line)[:6]} for line in measured]))
    if output := arguments.output or (None if arguments.quick else RESULTS / "lesions.csv"):
        write(output, [{**line, **about()} for line in measured])


if __name__ == "__main__":
    main()
