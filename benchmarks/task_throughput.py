"""Environment steps per second of every task with every character, beside bare MuJoCo in the same scene.

    python benchmarks/task_throughput.py            # a quarter of an hour, writes results/task_throughput.csv
    python benchmarks/task_throughput.py --quick    # seconds, writes nothing unless given --output

``raw`` is ``mujoco.batch`` with the scene's model and as many physics steps per action, kinematics brought up to date
as the tasks need them, characters acting at random, and those that have sunk put back. ``ours`` goes through TorchRL's
``step_and_maybe_reset``: states, goals, rewards, falls and partial resets come on top. Both act alike, have one torch
thread and all processors for physics, and take turns of some steps each, so that a busy machine slows both; a speed is
the median over turns, the ratio the median of the turns'. ``physics`` is the share of our time inside MuJoCo.
``memory_kib`` is what one more simulation takes: resident memory of the process with the largest number of simulations
less that without, divided by the number. Every pair has a process of its own.
"""

import argparse
import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from typing import Any

import mujoco
import torch
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from mujoco.batch import Batch
from report import about, table, write

from torchrl_mcp import envs

RESULTS = Path(__file__).resolve().parent / "results" / "task_throughput.csv"
TASKS, SIZES = ("Heading", "Carry", "Dribble", "Imitation"), (256, 1024)
AIM = 0.9
PLACES = ("qpos", "qvel", "mocap_pos", "mocap_quat")
SUNKEN = 0.5
"""Share of its height at rest below which the root of a character has sunk."""


def resident() -> float:
    """Resident memory of this process in KiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1024


def make(task: str, character: str, **kwargs: Any) -> envs.PDCharacterEnv:
    """Environments of a task; imitation follows the generated corpus with the reward of its configuration."""
    if task != "Imitation":
        return getattr(envs, task)(character=character, **kwargs)
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        cfg = compose("train", ["task=imitation", f"character={character}"])
    return instantiate(cfg.task.pretrain)(**kwargs)


def raw(env: envs.PDCharacterEnv, script: torch.Tensor, threads: int) -> Callable[[int], None]:
    """A step of MuJoCo alone in the scene of ``env``."""
    model = env.simulation.model
    batch = Batch(model, env.num_envs, threads, True)
    batch.reset()
    env.reset()
    start = {key: value.numpy() for key, value in env.get_state().items() if key in PLACES}
    places = {key: batch.bind(key) for key in start}
    for key, value in start.items():
        places[key][:] = value
    ctrl, qpos = batch.bind("ctrl"), places["qpos"]
    controls = (script.double() * torch.from_numpy(model.actuator_ctrlrange @ [-0.5, 0.5])).numpy()

    def step(index: int) -> None:
        ctrl[:] = controls[index % len(controls)]
        batch.step(nstep=env.substeps, stage=mujoco.mjtStage.mjSTAGE_VEL)
        sunken = (qpos[:, 2] < SUNKEN * model.qpos0[2]).nonzero()[0]
        if len(sunken):
            batch.reset(sunken, stage=mujoco.mjtStage.mjSTAGE_NONE)
            for key, value in start.items():
                places[key][sunken] = value[sunken]

    return step


def ours(env: envs.PDCharacterEnv, script: torch.Tensor) -> Callable[[int], None]:
    """A step of the task."""
    state = env.reset()

    def step(index: int) -> None:
        nonlocal state
        _, state = env.step_and_maybe_reset(state.set("action", script[index % len(script)]))

    return step


def measure(task: str, character: str, num_envs: int, turns: int, steps: int, threads: int) -> dict[str, Any]:
    """Let bare MuJoCo and the task take turns."""
    torch.set_num_threads(1)
    make(task, character, num_envs=1).reset()
    gc.collect()
    before = resident()
    env = make(task, character, num_envs=num_envs, seed=0, num_threads=threads)
    generator = torch.Generator().manual_seed(0)
    script = torch.rand(32, *env.action_spec.shape, generator=generator) * 0.6 - 0.3
    contender = ours(env, script)
    memory = (resident() - before) / num_envs
    contenders, seconds = {"raw": raw(env, script, threads), "ours": contender}, {"raw": [], "ours": []}
    physics = []
    for turn in range(turns + 1):
        for name, step in contenders.items():
            start, inside = time.perf_counter(), env.physics_seconds
            for index in range(steps):
                step(turn * steps + index)
            if turn:  # the first warms up
                seconds[name].append(time.perf_counter() - start)
                if name == "ours":
                    physics.append((env.physics_seconds - inside) / seconds[name][-1])
    return {
        "task": task,
        "character": character,
        "num_envs": num_envs,
        "raw": round(num_envs * steps / median(seconds["raw"])),
        "ours": round(num_envs * steps / median(seconds["ours"])),
        "of_raw": round(median(a / b for a, b in zip(seconds["raw"], seconds["ours"], strict=True)), 3),
        "physics": round(median(physics), 3),
        "memory_kib": round(memory, 1),
    }


def rows(tasks: list[str], characters: list[str], sizes: list[int], *settings: int) -> Iterator[dict[str, Any]]:
    """Measure each pair and size in a process of its own."""
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
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="threads of the physics")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.job:
        print(json.dumps(measure(*json.loads(arguments.job))))
        return
    sizes, turns, steps = ([8], 2, 3) if arguments.quick else (list(SIZES), 10, 25)
    characters = arguments.characters[:1] if arguments.quick else arguments.characters
    conditions = {"turns": turns, "steps": steps, "threads": arguments.threads, **about()}
    print(" | ".join(f"{key} {value}" for key, value in conditions.items()))
    measured = list(rows(arguments.tasks, characters, sizes, turns, steps, arguments.threads))
    print(table(measured))
    print(f"least of raw: {min(row['of_raw'] for row in measured)} (aim {AIM})")
    if output := arguments.output or (None if arguments.quick else RESULTS):
        write(output, [{**row, **conditions} for row in measured])


if __name__ == "__main__":
    main()
