"""The depth to which the characters' legs pass into each other.

    python benchmarks/legs_apart.py    # a few minutes, writes results/legs_apart.csv

Characters do not collide with themselves, so only the imitated motions keep their legs apart. This script measures, for
every character, the signed distance between the legs' collision shapes (``mj_geomDistance``), over the generated corpus
and over evaluation episodes in which the built-in networks follow it. ``deepest_mm`` is the greatest depth in
millimetres; the others are shares of the frames with an overlap, and with one deeper than 1 and 2 cm.

``--quick`` takes seconds, measures less and writes nothing unless given ``--output``.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from report import about, table, write
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.envs import Imitation
from torchrl_mcp.envs.motions import trex_corpus, walking_corpus
from torchrl_mcp.envs.motions.inspection.crossing import legs_apart
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.policies import restore

RESULTS = Path(__file__).resolve().parent / "results"
SEED = 12345
STEPS = 300


def generated(character: str) -> Tensor:
    """Return the states of the generated corpus, shape ``(T, nq)``."""
    clips = trex_corpus() if character == "trex" else walking_corpus(character, 0).values()
    return torch.cat([clip.qpos for clip in clips])


def learnt(character: str, episodes: int, steps: int) -> Tensor:
    """Return states of the deterministic built-in network with changing references, shape ``(T, nq)``."""
    _, agent, env = restore(
        builtin("mcp", character), num_envs=episodes, seed=SEED, clip_end="switch", switch_interval=5.0
    )
    assert isinstance(env, Imitation)
    states, alive, state = [], torch.ones(episodes, dtype=torch.bool), env.reset()
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(steps):
            state = env.step(agent.actor.policy(state))["next"]
            alive &= ~state["done"].squeeze(-1)
            states.append(env.simulation.state["qpos"][alive].clone())
    return torch.cat(states)


def measured(characters: list[str], episodes: int, steps: int) -> Iterator[dict[str, Any]]:
    """Yield a row for each character and motion."""
    for character in characters:
        for motion, qpos in (
            ("generated corpus", generated(character)[: None if steps == STEPS else steps]),
            ("built-in network", learnt(character, episodes, steps)),
        ):
            apart = legs_apart(character, qpos)
            shares = {
                f"deeper_than_{mm}_mm": round(float((apart < -mm / 1000).double().mean()), 4) for mm in (0, 10, 20)
            }
            row = {"character": character, "motion": motion, "frames": len(apart)}
            yield {**row, "deepest_mm": round(1000 * max(0.0, -float(apart.min())), 1), **shares}


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--characters", nargs="+", default=["biped", "humanoid", "trex"])
    parser.add_argument("--quick", action="store_true", help="measure less")
    parser.add_argument("--threads", type=int, default=1, help="threads of torch")
    parser.add_argument("--output", type=Path, help="CSV file; without --quick there is a default")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rows = list(measured(args.characters, *((2, 20) if args.quick else (32, STEPS))))
    print(table(rows))
    if output := args.output or (None if args.quick else RESULTS / "legs_apart.csv"):
        write(output, [{**row, "threads": args.threads, **about()} for row in rows])
        print(f"written to {output}")


if __name__ == "__main__":
    main()
