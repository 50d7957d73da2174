"""Counts how episodes of carrying and dribbling without a success fail.

    python benchmarks/failures.py runs/dribble-biped/transfer/mcp/preset-fast/seed0    # a minute on one core

For each run folder or checkpoint, the script plays deterministic episodes of the paper's task and prints the share of
episodes for each outcome:

- ``success``: a success at any moment;
- ``falls at the start``: no success, and a fall in the first five seconds;
- ``falls later``: no success, and a later fall;
- ``stops short``: no success, and in the last five seconds the object lies still less than a metre from its target;
- ``other``: for example, the character drives the ball past its target, or carries the box about.
"""

import argparse
from pathlib import Path
from typing import Any

from report import table
from torch import Tensor

from torchrl_mcp.envs.tasks.transport import Transport
from torchrl_mcp.evaluation.rollout import Evaluation, evaluate
from torchrl_mcp.runs import policies
from torchrl_mcp.training import checkpoint

START = 5.0
"""Seconds at the beginning and at the end of an episode that the outcomes name."""

NEAR = 1.0
"""Largest distance in metres from the target of an object that stops short."""

STILL = 0.1
"""Largest change of this distance in metres of an object that lies still."""


def outcomes(played: Evaluation, distances: Tensor, timestep: float) -> dict[str, Tensor]:
    """Return which of N episodes have each outcome, each ``(N,)``, bool; an episode has exactly one outcome.

    Args:
        played: The episodes, with the metric ``success``.
        distances: Distance between object and target in metres after each of T steps, ``(T, N)``, and NaN from the end
            of an episode on.
        timestep: Seconds per step.
    """
    success = played.metrics["success"] > 0
    early = played.lengths <= round(START / timestep)
    fell = played.terminated
    last = distances[-round(START / timestep) : -1]  # the last step ends all episodes
    short = (last.amax(0) < NEAR) & (last.amax(0) - last.amin(0) < STILL)
    return {
        "success": success,
        "falls at the start": ~success & fell & early,
        "falls later": ~success & fell & ~early,
        "stops short": ~success & ~fell & short,
        "other": ~success & ~fell & ~short,
    }


def play(path: Path, *, episodes: int, seed: int) -> dict[str, Tensor]:
    """Play one deterministic episode in each of N environments, and return the outcomes."""
    evaluation = policies.policy_config(checkpoint.find(path)).evaluation
    _, agent, env = policies.restore(path, num_envs=episodes, seed=seed, **evaluation.environment)
    if not isinstance(env, Transport):
        raise SystemExit(f"{path} is not a run of carry or dribble: give one")
    played = evaluate(agent.actor.policy, env, positions=lambda: env.object.position - env.target.position)
    assert played.positions is not None
    return outcomes(played, played.positions[..., :2].norm(dim=-1), env.control_timestep)


def main() -> None:
    """Play, and print the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", help="run folders or checkpoint files")
    parser.add_argument("--episodes", type=int, default=128, help="episodes of each run (default %(default)s)")
    parser.add_argument("--seed", type=int, default=12345, help="seed of the episodes (default %(default)s)")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for path in arguments.runs:
        shares = play(path, episodes=arguments.episodes, seed=arguments.seed)
        rows.append({"run": str(path), **{name: f"{chosen.float().mean():.0%}" for name, chosen in shares.items()}})
    print(table(rows))


if __name__ == "__main__":
    main()
