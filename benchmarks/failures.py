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

import torch
from report import table
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_mcp.runs import policies
from torchrl_mcp.training import checkpoint

START = 5.0
"""Seconds at the beginning and at the end of an episode that the outcomes name."""

NEAR = 1.0
"""Largest distance in metres from the target of an object that stops short."""

STILL = 0.1
"""Largest change of this distance in metres of an object that lies still."""


def outcomes(success: Tensor, lengths: Tensor, distances: Tensor, timestep: float) -> dict[str, Tensor]:
    """Return which of N episodes have each outcome, each ``(N,)``, bool; an episode has exactly one outcome.

    Args:
        success: Whether the episode had a success, ``(N,)``.
        lengths: Steps until a fall, or all steps, ``(N,)``.
        distances: Distance between object and target in metres after each of T steps, ``(T, N)``.
        timestep: Seconds per step.
    """
    steps = round(START / timestep)
    last = distances[-steps:]
    fell = lengths < len(distances)
    short = (last.max(0).values < NEAR) & (last.max(0).values - last.min(0).values < STILL)
    return {
        "success": success,
        "falls at the start": ~success & fell & (lengths <= steps),
        "falls later": ~success & fell & (lengths > steps),
        "stops short": ~success & ~fell & short,
        "other": ~success & ~fell & ~short,
    }


def play(path: Path, *, episodes: int, seed: int) -> dict[str, Tensor]:
    """Play one deterministic episode in each of N environments, and return the outcomes."""
    evaluation = policies.policy_config(checkpoint.find(path)).evaluation
    _, agent, env = policies.restore(path, num_envs=episodes, seed=seed, **evaluation.environment)
    if not hasattr(env, "target"):
        raise SystemExit(f"{path} is not a run of carry or dribble: give one")
    success = torch.zeros(episodes, dtype=torch.bool)
    lengths = torch.full((episodes,), env.max_episode_steps)
    distances = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        state = env.reset()
        for step in range(1, env.max_episode_steps + 1):
            outcome = env.step(agent.actor.policy(state))["next"]
            fell = outcome["terminated"].squeeze(-1) & (lengths == env.max_episode_steps)
            lengths[fell] = step
            success |= outcome["success"].squeeze(-1) & (lengths >= step)
            distances.append(torch.linalg.vector_norm((env.object.position - env.target.position)[:, :2], dim=-1))
            state = outcome.exclude("reward", "done", "terminated", "truncated")
    return outcomes(success, lengths, torch.stack(distances), env.control_timestep)


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
