"""``torchrl-mcp-evaluate``: how good is a trained policy?"""

import argparse
import json
import sys
from pathlib import Path

import torch

from torchrl_mcp import experiment
from torchrl_mcp.evaluation import evaluate, summary


def main() -> None:
    """Play one episode in each of many environments and print what came of it."""
    parser = argparse.ArgumentParser(prog="torchrl-mcp-evaluate", description=__doc__)
    parser.add_argument("path", type=Path, help="run folder, of which the newest checkpoint counts, or checkpoint file")
    parser.add_argument("--episodes", type=int, default=128, help="episodes, one per environment (default 128)")
    parser.add_argument("--seed", type=int, default=12345, help="seed of environments and sampling (default 12345)")
    parser.add_argument("--output", type=Path, help="write the numbers to this JSON file as well")
    arguments = parser.parse_args()
    try:
        results = evaluate_run(arguments.path, episodes=arguments.episodes, seed=arguments.seed)
    except ValueError as error:
        sys.exit(f"torchrl-mcp-evaluate: {error}")
    print(f"{arguments.path}: {arguments.episodes} episodes, seed {arguments.seed}")
    for mode, numbers in results.items():
        print(
            f"  {mode:13} normalised return {numbers['normalised_return']:.3f} +- {numbers['normalised_return_std']:.3f} "
            f"(95 % interval of the mean {numbers['interval'][0]:.3f} to {numbers['interval'][1]:.3f}), "
            f"return {numbers['return']:.1f}, length {numbers['length']:.0f}, terminated {numbers['terminated']:.0%}"
        )
    if arguments.output:
        arguments.output.write_text(json.dumps(results, indent=2) + "\n")


def evaluate_run(path: Path, *, episodes: int, seed: int) -> dict[str, dict]:
    """Return the :func:`~torchrl_mcp.evaluation.summary` of the run's policy, ``deterministic`` and ``stochastic``."""
    results = {}
    for mode in ("deterministic", "stochastic"):
        _, agent, env = experiment.restore(path, num_envs=episodes, seed=seed)
        torch.manual_seed(seed)
        outcome = evaluate(agent.actor.policy, env, deterministic=mode == "deterministic")
        results[mode] = summary(outcome, env.normalised_return)
    return results


if __name__ == "__main__":
    main()
