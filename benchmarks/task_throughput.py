"""Measures environment steps per second of every task with every character, and of bare MuJoCo in the same scene.

    python benchmarks/task_throughput.py            # a quarter of an hour, writes results/task_throughput.csv
    python benchmarks/task_throughput.py --quick    # seconds, writes nothing without --output

``ours`` calls TorchRL's ``step_and_maybe_reset``. ``raw`` is ``mujoco.batch`` with the model of the scene. To compute
the same physics, ``raw`` replays the same controls from the same states with the same physics steps, updates the
kinematics that tasks need, and copies the initial states of new episodes. Characters act at random. In imitation, they
use the built-in policy with the exploration of training, so that episodes last as long as in training. The time of the
policy does not count.

Both have one torch thread and all cores for physics, and take turns of a few steps each. The fastest turn counts,
because other work on the machine only slows turns down. ``of_raw`` is the ratio of the two speeds, ``physics`` the
share of our time inside MuJoCo in that turn, and ``resets`` the mean number of new episodes in a step. ``memory_kib``
is the resident memory per simulation: the memory that the process needs in addition for the simulations, divided by
their number. Every pair of task and character has a separate process.
"""

import argparse
import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import cycle
from pathlib import Path
from typing import Any

import tensordict  # noqa: F401 - before mujoco, see envs/__init__.py

# isort: split
import mujoco
import numpy as np
import torch
from hydra.utils import instantiate
from mujoco.batch import Batch
from report import about, table, write
from tensordict import TensorDictBase
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp import envs
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.runs.policies import restore

RESULTS = Path(__file__).resolve().parent / "results" / "task_throughput.csv"
TASKS, SIZES = ("Heading", "Carry", "Dribble", "Imitation"), (256, 1024)
AIMS = {256: 0.9, 1024: 0.95}
AIMS_OF_IMITATION = {256: 0.85, 1024: 0.9}
PARTS = ("qpos", "qvel", "qacc_warmstart", "mocap_pos", "mocap_quat")
"""Parts of the state of a simulation, some of which a scene may lack."""

Step = tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]
"""Controls ``(N, A)``, the ``n`` simulations with a new episode, and their initial states, each ``(n, ...)``."""


def resident() -> float:
    """Return the resident memory of this process in KiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024


def make(task: str, character: str, **kwargs: Any) -> envs.PDCharacterEnv:
    """Return environments of a task; imitation uses the generated motions and the reward of its configuration."""
    if task != "Imitation":
        return getattr(envs, task)(character=character, **kwargs)
    cfg = compose_run("task=imitation", f"character={character}")
    return instantiate(cfg.task.pretrain)(**kwargs)


class Ours:
    """Steps a task and records the input that bare MuJoCo needs to replay it.

    Args:
        env: The task.
        act: Function that adds the action to the task's observations.
    """

    def __init__(self, env: envs.PDCharacterEnv, act: Callable[[TensorDictBase], TensorDictBase]) -> None:
        self.env = env
        self.act = act
        self.state = env.reset()

    def turn(self, steps: int) -> tuple[float, dict[str, np.ndarray], list[Step]]:
        """Take steps; return the seconds in the environment, the state before the steps, and a record of each step."""
        seconds = 0.0
        done = []
        physics = {key: value for key, value in self.env.simulation.state.items() if key in PARTS}
        before = {key: value.numpy().copy() for key, value in physics.items()}
        for _ in range(steps):
            state = self.act(self.state)
            start = time.perf_counter()
            step, self.state = self.env.step_and_maybe_reset(state)
            seconds += time.perf_counter() - start
            ended = step["next", "done"].flatten().nonzero().flatten()
            controls = self.env._controls(step["action"]).numpy().astype(float)
            done.append((controls, ended.numpy(), {key: value[ended].numpy() for key, value in physics.items()}))
        return seconds, before, done


class Raw:
    """Replays the steps of a task with bare MuJoCo."""

    def __init__(self, env: envs.PDCharacterEnv, threads: int) -> None:
        self.batch = Batch(env.simulation.model, env.num_envs, threads, True)
        self.substeps = env.substeps
        self.parts = {key: self.batch.bind(key) for key in ("ctrl", *PARTS)}

    def turn(self, before: dict[str, np.ndarray], done: list[Step]) -> float:
        """Replay our steps, and return the seconds."""
        for key, value in before.items():
            self.parts[key][:] = value
        self.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        start = time.perf_counter()
        for controls, ended, begun in done:
            self.parts["ctrl"][:] = controls
            self.batch.step(nstep=self.substeps, stage=mujoco.mjtStage.mjSTAGE_VEL)
            for key, value in begun.items():
                self.parts[key][ended] = value
        return time.perf_counter() - start


def actions(task: str, env: envs.PDCharacterEnv) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return the policy of the characters in a task."""
    if task == "Imitation":
        _, agent, _ = restore(builtin("mcp", env.character.name), num_envs=1, seed=0)
        return agent.actor.policy
    generator = torch.Generator().manual_seed(0)
    script = cycle(torch.rand(32, *env.action_spec.shape, generator=generator) * 0.6 - 0.3)
    return lambda state: state.set("action", next(script))


@torch.no_grad()
@set_exploration_type(ExplorationType.RANDOM)
def measure(task: str, character: str, num_envs: int, turns: int, steps: int, threads: int) -> dict[str, Any]:
    """Let the task and bare MuJoCo take turns."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    act = actions(task, make(task, character, num_envs=num_envs))
    gc.collect()
    before = resident()
    env = make(task, character, num_envs=num_envs, seed=0, num_threads=threads)
    ours = Ours(env, act)
    memory = (resident() - before) / num_envs
    raw = Raw(env, threads)
    for _ in range(15 if task == "Imitation" else 5):  # warm-up, in which episodes of imitation reach various lengths
        ours.turn(steps)
    seconds: dict[str, list[float]] = {"raw": [], "ours": []}
    physics = []
    resets = 0
    for _ in range(turns + 1):
        inside = env.physics_seconds
        spent, start, done = ours.turn(steps)
        physics.append((env.physics_seconds - inside) / spent)
        seconds["ours"].append(spent)
        seconds["raw"].append(raw.turn(start, done))
        resets += sum(len(ended) for _, ended, _ in done)
    fastest = {name: min(values[1:]) for name, values in seconds.items()}  # the first turn is a warm-up
    return {
        "task": task,
        "character": character,
        "num_envs": num_envs,
        "raw": round(num_envs * steps / fastest["raw"]),
        "ours": round(num_envs * steps / fastest["ours"]),
        "of_raw": round(fastest["raw"] / fastest["ours"], 3),
        "physics": round(physics[seconds["ours"].index(fastest["ours"])], 3),
        "resets": round(resets / (turns + 1) / steps, 2),
        "memory_kib": round(memory, 1),
    }


def rows(tasks: list[str], characters: list[str], sizes: list[int], *settings: int) -> Iterator[dict[str, Any]]:
    """Measure each pair and size in a separate process."""
    for task in tasks:
        for character in characters:
            for num_envs in sizes:
                job = json.dumps([task, character, num_envs, *settings])
                done = subprocess.run(
                    [sys.executable, __file__, "--job", job], stdout=subprocess.PIPE, text=True, check=True
                )
                row = json.loads(done.stdout.splitlines()[-1])
                print(" ".join(f"{key}={value}" for key, value in row.items()), flush=True)
                yield row


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one character, few simulations and turns")
    parser.add_argument("--tasks", nargs="+", default=list(TASKS), choices=TASKS)
    parser.add_argument("--characters", nargs="+", default=list(envs.characters.CHARACTERS))
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES), help="numbers of simulations")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="threads of the physics")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.job:
        print(json.dumps(measure(*json.loads(arguments.job))))
        return
    sizes, turns, steps = ([8], 2, 3) if arguments.quick else (arguments.sizes, 25, 4)
    characters = arguments.characters[:1] if arguments.quick else arguments.characters
    conditions = {"turns": turns, "steps": steps, "threads": arguments.threads, **about()}
    print(" | ".join(f"{key} {value}" for key, value in conditions.items()))
    measured = list(rows(arguments.tasks, characters, sizes, turns, steps, arguments.threads))
    print(table(measured))
    for row in measured:
        aims = AIMS_OF_IMITATION if row["task"] == "Imitation" else AIMS
        if row["of_raw"] < aims.get(row["num_envs"], 0):
            print(f"{row['task']}, {row['character']}, {row['num_envs']}: below the aim of {aims[row['num_envs']]}")
    if output := arguments.output or (None if arguments.quick else RESULTS):
        write(output, [{**row, **conditions} for row in measured])


if __name__ == "__main__":
    main()
