"""Measures steps and training samples per second of MuJoCo Warp on a GPU, and of ``mujoco.batch`` on the same machine.

    python benchmarks/gpu_throughput.py                         # hours, writes results/gpu_throughput.csv
    python benchmarks/gpu_throughput.py --quick --device cpu    # a minute, tests that the script runs; writes nothing

``steps`` are control steps per second of the environments alone, with random actions and new episodes, through
TorchRL's ``step_and_maybe_reset``. ``samples`` are samples per second of whole training iterations of MCP: acting,
physics, resets, advantages, gradient steps, metrics. An iteration takes 8 steps of each environment, and makes two
passes over these samples in 16 minibatches. With both engines, networks are on ``--device``, in the precision of
``autocast=auto``.

Each measurement has a separate process. Kernels are compiled and loaded before the clock starts, and the first training
iteration is not counted. ``setup_seconds`` is the time until the clock starts, which is longer if kernels are not in
Warp's cache. A row without numbers is a measurement that failed; its error is printed above the table.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any

import torch
from report import about, table, write
from scaling import Record

from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.runs import build, configuration, requirements
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.provenance import machine
from torchrl_mcp.training.precision import choose

RESULTS = Path(__file__).resolve().parent / "results" / "gpu_throughput.csv"
SCENES = (
    *(f"{task}-{character}" for task in ("heading", "carry", "dribble", "imitation") for character in CHARACTERS),
    "holdout-ant",
)
SIZES, ENGINES = (1024, 2048, 4096, 8192, 16384), ("warp", "mujoco")
STEPS, MINIBATCHES, EPOCHS = 8, 16, 2
"""Control steps of an iteration, and numbers of minibatches and of passes over its samples."""
MEASURED = ("steps", "samples", "setup_seconds")


def measure(scene: str, physics: str, num_envs: int, device: str, threads: int, iterations: int) -> dict[str, Any]:
    """Measure an engine in a scene, and return the columns :data:`MEASURED` of a row."""
    start = time.perf_counter()
    task, character = scene.split("-")
    stage = "pretrain" if task in ("imitation", "holdout") else "transfer"
    samples = num_envs * STEPS
    settings = {
        **{"method": "mcp", "task": task, "character": character, "stage": stage},
        **{"device": device, "physics": physics, "num_threads": threads, "autocast": choose("auto", device).autocast},
        "training.num_envs": num_envs,
        "training.frames_per_batch": samples,
        "training.minibatch_size": samples // MINIBATCHES,
        "training.num_epochs": EPOCHS,
        "training.total_frames": samples * (1 + iterations),
        "checkpoint_interval": 10**9,
        "width": 1.0,
        **{"logger": "none", "progress_bar": False, "run_dir": "."},
    }
    cfg = configuration.compose_run(*(f"{name}={value}" for name, value in settings.items()))
    source = build.make_source(cfg)
    agent = build.make_agent(cfg, source.env, builtin("mcp", character) if stage == "transfer" else None)
    trainer = build.make_trainer(cfg, agent, source, Path(cfg.run_dir))
    play(source.env, 2)
    setup = time.perf_counter() - start
    steps = STEPS * iterations
    seconds = play(source.env, steps)
    record = Record()
    trainer.folder.metrics = record  # type: ignore[assignment]
    trainer.save = lambda: None  # type: ignore[method-assign]
    trainer.run()
    training = sum(samples / iteration["time/steps_per_second"] for iteration in record.rows[1:])
    return {
        "steps": round(num_envs * steps / seconds),
        "samples": round(samples * iterations / training),
        "setup_seconds": round(setup, 1),
    }


def play(env: Any, steps: int) -> float:
    """Take steps with random actions, and return the seconds."""
    state = env.reset()
    actions = [env.action_spec.rand() for _ in range(steps)]
    wait(env.device)
    start = time.perf_counter()
    for action in actions:
        _, state = env.step_and_maybe_reset(state.set("action", action))
    wait(env.device)
    return time.perf_counter() - start


def wait(device: torch.device) -> None:
    """Wait until the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def row(scene: str, physics: str, num_envs: int, *settings: Any) -> dict[str, Any]:
    """Measure in a separate process, and return the row."""
    job = json.dumps([scene, physics, num_envs, *settings])
    done = subprocess.run([sys.executable, __file__, "--job", job], stdout=subprocess.PIPE, text=True, check=False)
    numbers = json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else dict.fromkeys(MEASURED, "")
    return {"scene": scene, "physics": physics, "num_envs": num_envs, **numbers}


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one scene, 16 environments, one iteration")
    parser.add_argument("--device", default="cuda", help="device of Warp and of all networks")
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=SCENES, metavar="TASK-CHARACTER")
    parser.add_argument("--sizes", nargs="+", type=int, default=list(SIZES), help="numbers of environments")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="threads of mujoco.batch")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.job:
        print(json.dumps(measure(*json.loads(arguments.job))))
        return
    try:
        for physics in ENGINES:
            requirements.require_equipment(configuration.compose_run(f"device={arguments.device}"))
            Heading("biped", 1, physics=physics)
    except ValueError as error:
        parser.error(str(error))
    quick = arguments.quick
    threads = arguments.threads
    scenes, sizes, iterations = (SCENES[:1], [16], 1) if quick else (arguments.scenes, arguments.sizes, 4)
    conditions = {"threads": threads, "iterations": iterations, **about(), **machine(arguments.device)}
    conditions |= {name: version(name) for name in ("mujoco-warp", "warp-lang")}
    print(" | ".join(f"{key} {value}" for key, value in conditions.items()), flush=True)
    output = arguments.output or (None if quick else RESULTS)
    rows = []
    for scene, num_envs, physics in product(scenes, sizes, ENGINES):
        rows.append(row(scene, physics, num_envs, arguments.device, threads, iterations))
        print(" ".join(f"{key}={value}" for key, value in rows[-1].items()), flush=True)
        if output:  # after every row, because a long measurement may be interrupted
            write(output, [{**each, **conditions} for each in rows])
    print(table(rows))


if __name__ == "__main__":
    main()
