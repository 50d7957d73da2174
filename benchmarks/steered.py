"""What the frozen primitives can do in carrying and dribbling: a gate that was trained for heading, steered by hand.

    python benchmarks/steered.py    # five minutes, writes results/steered.csv

The player walks by ``builtin:CHARACTER-heading`` and never saw the object. A rule of a few lines chooses its direction:
to the box, and with the box to the target; behind the ball, and with the ball to the target. The direction is at most
``turn`` radians to the side, because large turns make the gate fall. A gate that is trained for the task should do
better. ``--quick`` takes seconds, plays two episodes of 2 s and writes nothing unless given ``--output``.
"""

import argparse
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf
from report import about, earned, table, write
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_mcp.envs import Carry, Dribble
from torchrl_mcp.runs import build, policies
from torchrl_mcp.runs.builtin import locate

RESULTS = Path(__file__).resolve().parent / "results" / "steered.csv"
PLAYERS = {"carry": ("biped", "humanoid"), "dribble": ("biped", "humanoid", "trex")}
"""The characters that play each task."""
TURNS = [0.3, 0.6, math.pi]
"""Largest angles between the character's heading and the direction that the gate is told, in radians."""
DETOUR = 0.8
"""Metres from the ball at which the player passes it."""


class SteeredPolicy(TensorDictModuleBase):
    """A heading policy that is told where to walk by a rule."""

    in_keys, out_keys = ("observation", "goal"), ("action",)

    def __init__(self, env: Carry | Dribble, heading: TensorDictModuleBase, turn: float) -> None:
        super().__init__()
        self.env, self.turn, self._heading = env, turn, [heading]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        target, thing = (tensordict["goal"][:, self.env.goal_layout[name]][:, :2] for name in self._positions())
        if "taken" in self.env.episode:
            way = torch.where(self.env.episode["taken"].bool().unsqueeze(-1), target - thing, thing)
        else:
            way = behind(thing, normalize(target - thing, dim=-1))
        angle = torch.atan2(way[:, 1], way[:, 0]).clamp(-self.turn, self.turn)
        told = tensordict.select("observation").set("goal", torch.stack([angle.cos(), angle.sin()], -1))
        return tensordict.set("action", self._heading[0](told)["action"])

    def _positions(self) -> tuple[str, str]:
        names = [name for name in self.env.goal_layout if name.endswith(".position")]
        return names[0], names[-1]  # the target first, the object last


def behind(ball: Tensor, push: Tensor) -> Tensor:
    """Return the way to walk, ``(N, 2)``: to the ball if it lies in the direction of the push, otherwise round it."""
    side = torch.stack([-push[:, 1], push[:, 0]], -1)
    nearer = torch.where((ball * side).sum(-1, keepdim=True) > 0, -side, side)
    ahead = (normalize(ball, dim=-1) * push).sum(-1, keepdim=True)
    beside, back = ball + DETOUR * nearer, ball - DETOUR * push
    return torch.where(ahead > 0.9, ball, torch.where(ahead > 0, back, beside))


def rows(episodes: int, turns: Sequence[float], **changes: Any) -> Iterator[dict[str, Any]]:
    """Play episodes of each task by each character, and yield their results."""
    for task, character in [(task, character) for task, characters in PLAYERS.items() for character in characters]:
        with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
            cfg = compose("train", [f"task={task}", f"character={character}", "stage=transfer"])
        evaluated: Any = OmegaConf.to_container(cfg.evaluation.environment, resolve=True)
        evaluated["goal_positions"] = "metres"  # for the rule
        _, agent, _ = policies.restore(locate(f"builtin:{character}-heading"), num_envs=1, seed=0)
        for turn in turns:
            env = build.make_env(cfg, num_envs=episodes, seed=12345, **evaluated | changes)
            player = SteeredPolicy(env, agent.actor.policy, turn)
            yield {"task": task, "character": character, "turn": round(turn, 2), **earned(player, env)}


def main() -> None:
    """Play, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="two episodes of 2 s")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    quick = (2, TURNS[:1])
    measured = list(rows(*quick, max_episode_steps=60) if arguments.quick else rows(128, TURNS))
    print(table(measured))
    if output := arguments.output or (None if arguments.quick else RESULTS):
        write(output, [row | about() for row in measured])


if __name__ == "__main__":
    main()
