"""Measures environment steps per second of this library, bare MuJoCo, Gymnasium, EnvPool and TorchRL.

    python benchmarks/throughput.py            # about five minutes, writes results/throughput_env.csv
    python benchmarks/throughput.py --quick    # about a minute, writes nothing without --output
    python benchmarks/throughput.py --distributions    # half a minute, writes results/throughput_distributions.csv

Every contender simulates Ant-v5 (5 physics steps per action, without contact observations and costs unless stated),
acts at random and resets fallen ants. Each contender has a separate process. In a turn, all contenders are measured one
after the other, round after round, so that a busy machine slows all of them. A speed is the median over rounds, and a
ratio is the median of the ratios of all rounds. Only speeds of the same turn are comparable.

Contenders with one process per environment are measured with one process and with one per core; Gymnasium's also with
64 processes. A loop in Python does not become faster with more environments. EnvPool is measured if it is installed;
``--envpool-python`` sets an interpreter that has EnvPool.

With ``--distributions``, each contender draws actions with their log-probabilities instead, on one thread, from given
primitives and gates: 256 states, 8 primitives and 28 actions. The measured time is processor time. ``--before`` sets
another clone of this repository, whose product distribution is also measured.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from importlib.resources import files
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from report import about, peak_memory, table, write

RESULTS = Path(__file__).parent / "results" / "throughput_env.csv"
DISTRIBUTIONS = RESULTS.with_name("throughput_distributions.csv")
SUBSTEPS = 5
HEALTHY_Z = (0.2, 1.0)
ANT = {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}

Step = Callable[[int], None]


def actions(num_envs: int) -> np.ndarray:
    """Return 32 random actions to cycle through, shape ``(32, num_envs, 8)``."""
    return np.random.default_rng(0).uniform(-1, 1, (32, num_envs, 8)).astype(np.float32)


def raw(num_envs: int) -> Step:
    """Return the steps of ``mujoco.batch`` with minimal random actions and resets, which is the upper limit."""
    import mujoco
    from mujoco.batch import Batch

    model = mujoco.MjModel.from_xml_path(str(files("gymnasium") / "envs/mujoco/assets/ant.xml"))
    script, batch = actions(num_envs), Batch(model, num_envs)
    batch.reset()
    ctrl, qpos = batch.bind("ctrl"), batch.bind("qpos")
    noise = np.random.default_rng(0).uniform(-0.1, 0.1, (1024, qpos.shape[-1]))

    def step(index: int) -> None:
        ctrl[:] = script[index % 32]
        batch.step(nstep=SUBSTEPS)
        fallen = ((qpos[:, 2] < HEALTHY_Z[0]) | (qpos[:, 2] > HEALTHY_Z[1])).nonzero()[0]
        if len(fallen):
            batch.reset(fallen, stage=mujoco.mjtStage.mjSTAGE_NONE)
            qpos[fallen] += noise[(index + fallen) % 1024]

    return step


def ours(num_envs: int, contact_forces: bool = False) -> Step:
    """Return the steps of holdout, through TorchRL's ``step_and_maybe_reset``."""
    import torch

    from torchrl_mcp.envs import Holdout

    torch.set_num_threads(1)
    env = Holdout(num_envs, (0.0, 1.5 * math.pi), seed=0, contact_forces=contact_forces)
    return stepping(env, actions(num_envs))


def stepping(env: Any, script: np.ndarray) -> Step:
    """Return the steps of a TorchRL environment."""
    import torch

    carrier = env.reset()
    acting = torch.from_numpy(script).reshape(32, *env.action_spec.shape)

    def step(index: int) -> None:
        nonlocal carrier
        _, carrier = env.step_and_maybe_reset(carrier.set("action", acting[index % 32]))

    return step


def gymnasium(num_envs: int, mode: str) -> Step:
    """Return the steps of Gymnasium's vector environments, with a process per ant or with a loop in one process."""
    import gymnasium as gym

    env = gym.make_vec("Ant-v5", num_envs, vectorization_mode=mode, **ANT)
    env.reset(seed=0)
    script = actions(num_envs)
    return lambda index: env.step(script[index % 32])


def envpool(num_envs: int) -> Step:
    """Return the steps of EnvPool's C++ thread pool."""
    import envpool as pool

    off = {"use_contact_force": False, "contact_cost_weight": 0.0, "post_constraint": False}
    env = pool.make_gymnasium("Ant-v5", num_envs=num_envs, num_threads=os.cpu_count(), seed=0, **off)
    env.reset()
    script = actions(num_envs).astype(np.float64)
    return lambda index: env.step(script[index % 32])


def torchrl_parallel(num_envs: int) -> Step:
    """Return the steps of TorchRL's ParallelEnv over Gymnasium's Ant-v5, with a process per ant."""
    from torchrl.envs import GymEnv, ParallelEnv

    return stepping(ParallelEnv(num_envs, partial(GymEnv, "Ant-v5", **ANT)), actions(num_envs))


def torchrl_ant(num_envs: int, integrator: str = "Euler") -> Step:
    """Return the steps of TorchRL's AntEnv on C MuJoCo, with a process per ant.

    The default integrator, Euler, needs a quarter of the work of Ant-v5's RK4.
    """
    from torchrl.envs import AntEnv

    class Ant(AntEnv):
        @classmethod
        def _patch_xml(cls, xml: str) -> str:
            return super()._patch_xml(xml).replace("<option ", f'<option integrator="{integrator}" ')

    return stepping(Ant(num_envs=num_envs, backend="mujoco", seed=0), actions(num_envs))


SIZES = (1, 64, 256, 1024)
CPUS = os.cpu_count() or 1
CONTENDERS: dict[str, tuple[Callable[[int], Step], tuple[int, ...]]] = {
    "mujoco.batch": (raw, SIZES),
    "torchrl-mcp": (ours, SIZES),
    "torchrl-mcp, contact forces": (partial(ours, contact_forces=True), SIZES),
    "EnvPool": (envpool, SIZES),
    "Gymnasium sync": (partial(gymnasium, mode="sync"), (1, 64, 64, 64)),
    "Gymnasium async": (partial(gymnasium, mode="async"), (1, CPUS, CPUS, 64)),
    "TorchRL ParallelEnv(GymEnv)": (torchrl_parallel, (1, CPUS, CPUS, 1)),
    "TorchRL AntEnv": (torchrl_ant, (1, CPUS, CPUS, 1)),
    "TorchRL AntEnv, RK4": (partial(torchrl_ant, integrator="RK4"), (1, CPUS, CPUS, 1)),
}
"""Constructor of each contender, and its number of environments in each turn."""


def drawing(num_states: int, distribution: str, *, compiled: bool = False) -> Step:
    """Return a function that draws an action with its log-probability in each state."""
    import torch
    from torchrl.modules import IndependentNormal

    from torchrl_mcp import distributions

    torch.set_num_threads(1)
    loc = torch.randn(num_states, 8, 28)
    scale = torch.rand_like(loc) + 0.1
    gates = torch.rand(num_states, 8)
    single = distribution == "IndependentNormal"
    parameters = (loc[:, 0].contiguous(), scale[:, 0].contiguous()) if single else (loc, scale, gates)
    make = IndependentNormal if single else getattr(distributions, distribution)

    @torch.no_grad()
    def draw(*parameters: torch.Tensor) -> torch.Tensor:
        policy = make(*parameters)
        return policy.log_prob(policy.sample())

    function = torch.compile(draw, fullgraph=True) if compiled else draw
    return lambda index: function(*parameters)


BEFORE = "MultiplicativeGaussian, before"
DRAWING = {
    "IndependentNormal": partial(drawing, distribution="IndependentNormal"),
    "MultiplicativeGaussian": partial(drawing, distribution="MultiplicativeGaussian"),
    BEFORE: partial(drawing, distribution="MultiplicativeGaussian"),
    "AdditiveGaussian": partial(drawing, distribution="AdditiveGaussian"),
    "IndependentNormal, compiled": partial(drawing, distribution="IndependentNormal", compiled=True),
    "MultiplicativeGaussian, compiled": partial(drawing, distribution="MultiplicativeGaussian", compiled=True),
    "AdditiveGaussian, compiled": partial(drawing, distribution="AdditiveGaussian", compiled=True),
}
"""Functions that make the contenders which draw actions."""


def worker(name: str, num_envs: int) -> None:
    """Make a contender, and measure its speed for as many seconds as each line of standard input says."""
    step = {**{name: make for name, (make, _) in CONTENDERS.items()}, **DRAWING}[name](num_envs)
    index = 0
    until = time.perf_counter() + 0.3  # warm up, and let the first ants fall
    while index < 20 or time.perf_counter() < until:
        step(index)
        index += 1
    print(json.dumps({"ready": True}), flush=True)
    clock = time.process_time if name in DRAWING else time.perf_counter
    for line in sys.stdin:
        start = clock()
        first = index
        while clock() - start < float(line):
            step(index)
            index += 1
        speed = (index - first) * num_envs / (clock() - start)
        print(json.dumps({"speed": speed, "memory": peak_memory(os.getpid())}), flush=True)
    os._exit(0)  # an orderly end of many environments takes longer than the measurement


def measure(
    sizes: dict[str, int], envpool_python: str, rounds: int, seconds: float, before: Path | None = None
) -> Iterator[dict[str, Any]]:
    """Measure contenders in turns, each with its number of environments, and yield their rows."""
    processes = {}
    for name, num_envs in sizes.items():
        python = envpool_python if name == "EnvPool" else sys.executable
        command = [python, __file__, "--worker", name, str(num_envs)]
        pipe = subprocess.PIPE
        variables = {**os.environ, "PYTHONPATH": str(before)} if name == BEFORE else None
        processes[name] = subprocess.Popen(
            command, stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, text=True, env=variables
        )
    rows = {
        name: {"contender": name, "num_envs": sizes[name], "speeds": []}
        for name, process in processes.items()
        if answer(process)
    }
    for _ in range(rounds):
        for name, row in rows.items():
            result = answer(processes[name], f"{seconds}\n")
            row["speeds"].append(result["speed"])
            row["memory"] = result["memory"]
    for process in processes.values():
        process.communicate()
    yield from rows.values()


def answer(process: subprocess.Popen, line: str = "") -> dict[str, Any]:
    """Send a line to a worker, and return its answer, the next line of JSON; empty if the worker failed."""
    assert process.stdin is not None
    assert process.stdout is not None
    with suppress(BrokenPipeError):
        process.stdin.write(line)
        process.stdin.flush()
    return next((json.loads(line) for line in process.stdout if line.startswith("{")), {})


def ratio(row: dict[str, Any], reference: dict[str, Any]) -> float:
    """Return the median over rounds of the ratio of two contenders' speeds."""
    return median(a / b for a, b in zip(row["speeds"], reference["speeds"], strict=True))


def aims(rows: list[dict[str, Any]]) -> Iterator[str]:
    """Yield lines that compare the speeds of a turn with our aims."""
    for size in sorted({row["turn"] for row in rows if row["turn"] >= 256}):
        turn = {row["contender"]: row for row in rows if row["turn"] == size}
        aimed = {"mujoco.batch": 0.95, "EnvPool": 1, "Gymnasium sync": 2.5, "Gymnasium async": 2.5}
        aimed |= {"TorchRL AntEnv, RK4": 15}
        for name, aim in aimed.items():
            if name in turn:
                times = ratio(turn["torchrl-mcp"], turn[name])
                yield f"torchrl-mcp at {size}: {times:.3f} times {name} at {turn[name]['num_envs']} (aim {aim})"


def line(row: dict[str, Any], facts: dict[str, Any]) -> dict[str, Any]:
    """Return the row of a contender in the table."""
    return {
        **{key: row[key] for key in ("turn", "contender", "num_envs")},
        "steps_per_second": round(median(row["speeds"])),
        "best": round(max(row["speeds"])),
        "of_limit": round(row["of_limit"], 3),
        "memory_mib": round(row["memory"]),
        "rounds": len(row["speeds"]),
        **facts,
    }


def measure_distributions(before: Path | None, output: Path) -> None:
    """Measure, print and write the time of an action with its log-probability in 256 states."""
    facts = about()
    num_states = 256
    sizes = {name: num_states for name in DRAWING if name != BEFORE or before}
    rows = list(measure(sizes, sys.executable, rounds=15, seconds=0.15, before=before))
    normal = next(row for row in rows if row["contender"] == "IndependentNormal")
    lines = [
        {
            "contender": row["contender"],
            "microseconds": round(1e6 * num_states / median(row["speeds"])),
            "best": round(1e6 * num_states / max(row["speeds"])),
            "of_normal": round(1 / ratio(row, normal), 2),
        }
        for row in rows
    ]
    print(table(lines))
    write(output, [{**line, "rounds": 15, **facts} for line in lines])


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="sizes 64 and 256, fewer rounds")
    parser.add_argument("--envpool-python", default=sys.executable, help="interpreter that has EnvPool")
    parser.add_argument("--distributions", action="store_true", help="measure distributions instead")
    parser.add_argument("--before", type=Path, metavar="CLONE", help="clone of another version, for --distributions")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    parser.add_argument("--worker", nargs=2, metavar=("NAME", "NUM_ENVS"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        worker(args.worker[0], int(args.worker[1]))
    if args.distributions:
        measure_distributions(args.before, args.output or DISTRIBUTIONS)
        return

    rounds, seconds = (3, 0.7) if args.quick else (5, 1.0)
    facts = about()
    rows = []
    print(" | ".join(f"{key} {value}" for key, value in facts.items()))
    for turn in (1, 2) if args.quick else range(len(SIZES)):
        sizes = {name: counts[turn] for name, (_, counts) in CONTENDERS.items()}
        new = list(measure(sizes, args.envpool_python, rounds, seconds))
        limit = next(row for row in new if row["contender"] == "mujoco.batch")
        for row in new:
            row["turn"] = SIZES[turn]
            row["of_limit"] = ratio(row, limit)
        print(table([line(row, {}) for row in new]), flush=True)
        rows += new
    print("\n".join(aims(rows)))
    if output := args.output or (None if args.quick else RESULTS):
        write(output, [line(row, facts) for row in rows])


if __name__ == "__main__":
    main()
