"""Measures how training scales with environments, threads and workers, and predicts its speed on other machines.

    python benchmarks/scaling.py            # minutes, writes results/scaling*.csv
    python benchmarks/scaling.py --quick    # a minute, writes nothing without --output
    python benchmarks/scaling.py --refit    # seconds, from existing measurements

The script measures whole iterations of MCP on the humanoid's heading task with the built-in primitives, in the
precision of ``autocast=auto``. It uses one thread, two threads, and one thread for every core. The speed with all cores
is printed next to the prediction from one and two threads, which checks the prediction on this machine. ``*_cpu`` are
CPU seconds of all threads. A section is serial if two threads take as much time and CPU as one thread, and scales if
they take half of the time. In between, threads wait for each other or for Python's lock. ``serial`` is the serial share
by Amdahl's law.

From the seconds of the sections, the script fits the constants of a model:

    iteration = T * (physics * N / speed-up + forward + forward' * N + rest + rest' * N) + update * N * T / speed-up

with ``N`` environments and ``T`` steps of each. Forward pass and rest use one thread. The speed-up of physics and
update on more cores is predicted from the gain of a second thread in two ways: by Amdahl's law (low), and with the same
gain for every further core (high). A GPU computes forward pass and update. Its time is the larger of two times, for
launching the operations, which are counted, and for their arithmetic; the time of transfers is added. ``GPU`` contains
the assumptions.
"""

import argparse
import csv
import os
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
from report import about, table, write
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

from torchrl_mcp.runs import build
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.training.precision import choose
from torchrl_mcp.training.trainer import Trainer

RESULTS = Path(__file__).resolve().parent / "results" / "scaling.csv"
SIZES, QUICK_SIZES = (64, 256, 1024, 4096), (16, 64)
STEPS, ITERATIONS, EPOCHS, MINIBATCH = 8, 2, 2, 512
"""Control steps of an iteration; iterations, of which the first is a warm-up; passes over the samples; minibatch."""
SECTIONS = ("physics", "forward", "collection", "update", "other")
GPU = {"operations_per_second": 2e5, "flops": 2e13, "seconds_per_transfer": 2e-5}
"""Assumptions about launches of operations from Python, sustained arithmetic, and small synchronous transfers."""
MEASURED = ("num_envs", "threads", "workers", "samples_per_second", *(f"{name}_seconds" for name in SECTIONS))
CPU = tuple(f"{name}_cpu" for name in SECTIONS)
CORES = os.cpu_count() or 1
TRANSFERS = 5
"""Number of transfers in a control step of this task, as counted in tests/accelerator."""
MACHINES = {f"{cores} cores": (cores, False) for cores in sorted({2, 8, 16, 64, CORES})}
MACHINES |= {f"{cores} cores, GPU": (cores, True) for cores in (8, 64)}


class Operations(TorchDispatchMode):
    """Counts operations, each of which would be launched on a GPU."""

    count = 0

    def __torch_dispatch__(self, operation: Any, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        """Count an operation and run it."""
        self.count += 1
        return operation(*args, **(kwargs or {}))


def make_trainer(num_envs: int, threads: int, workers: int) -> Trainer:
    """Return the trainer of a measurement, with threads for physics and torch, or with workers of one thread each."""
    collector = f"collector={'processes' if workers else 'local'}"
    settings = {
        "character": "humanoid",
        "task": "heading",
        "stage": "transfer",
        "logger": "none",
        "training.num_envs": num_envs,
        "training.frames_per_batch": num_envs * STEPS,
        "training.minibatch_size": min(MINIBATCH, num_envs * STEPS),
        "training.num_epochs": EPOCHS,
        "training.total_frames": num_envs * STEPS * ITERATIONS,
        "width": 1.0,
        "checkpoint_interval": 10**9,
        "autocast": choose("auto", "cpu").autocast,
        "num_threads": threads,
        "progress_bar": False,
        "run_dir": ".",
    }
    cfg = compose_run(collector, *(f"{key}={value}" for key, value in settings.items()))
    if workers:
        cfg.collector.num_workers = workers
    source = build.make_source(cfg)
    agent = build.make_agent(cfg, source.env, builtin("mcp", "humanoid"))
    return build.make_trainer(cfg, agent, source, Path(cfg.run_dir))


class Record:
    """A metrics writer that stores metrics in memory."""

    def __init__(self) -> None:
        self.rows: list[dict[str, float]] = []

    def write(self, metrics: dict[str, float], *, step: int) -> None:
        """Store a row."""
        self.rows.append(metrics)


def measure(num_envs: int, threads: int, workers: int) -> dict[str, Any]:
    """Return samples per second, and the wall-clock and CPU seconds of an iteration's sections."""
    row = sections(num_envs, threads, workers)
    with patch("time.perf_counter", time.process_time):
        cpu = sections(num_envs, threads, workers)
    return row | {f"{name}_cpu": cpu[f"{name}_seconds"] for name in SECTIONS}


def sections(num_envs: int, threads: int, workers: int) -> dict[str, Any]:
    """Return samples per second and the seconds of an iteration's sections; the first iteration does not count."""
    torch.set_num_threads(threads)
    trainer = make_trainer(num_envs, threads, workers)
    record = Record()
    trainer.folder.metrics = record  # type: ignore[assignment]
    trainer.save = lambda: None  # type: ignore[method-assign]
    trainer.run()
    rows = record.rows[1:]
    seconds = [num_envs * STEPS / row["time/steps_per_second"] for row in rows]
    spent = {
        f"{name}_seconds": round(
            np.mean([row.get(f"time/{name}", 0.0) * s for row, s in zip(rows, seconds, strict=True)]), 5
        )
        for name in SECTIONS
    }
    samples = round(num_envs * STEPS / float(np.mean(seconds)))
    return {"num_envs": num_envs, "threads": threads, "workers": workers, "samples_per_second": samples, **spent}


def serial_shares(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the share of each section in an iteration on one thread, and the serial share of the section."""
    one = of_threads(rows, 1)
    two = of_threads(rows, 2)
    shares_by_section = []
    for name in (name for name in SECTIONS if name != "collection"):
        shares = [row[f"{name}_seconds"] / sum(row[f"{section}_seconds"] for section in SECTIONS) for row in one]
        times = [second[f"{name}_seconds"] / first[f"{name}_seconds"] for first, second in zip(one, two, strict=True)]
        serial = float(np.clip(2 * np.median(times) - 1, 0, 1))
        shares_by_section.append({"section": name, "share": f"{np.median(shares):.0%}", "serial": f"{serial:.0%}"})
    return shares_by_section


def of_threads(rows: list[dict[str, Any]], threads: int) -> list[dict[str, Any]]:
    """Return the rows that were measured with a number of threads and without workers."""
    return [row for row in rows if row["threads"] == threads and not row["workers"]]


def count() -> dict[str, float]:
    """Return operations, and FLOPs per sample, of the policy's forward pass and of a gradient step."""
    trainer = make_trainer(MINIBATCH, 1, 0)
    batch = trainer.source.env.fake_tensordict().expand(MINIBATCH).clone()
    with torch.no_grad(), Operations() as operations, FlopCounterMode(display=False) as flops:
        trainer.agent.actor.policy(batch)
    counts = {"forward_operations": operations.count, "forward_flops": flops.get_total_flops() / MINIBATCH}
    batch = batch.update({"advantage": torch.zeros(MINIBATCH, 1), "value_target": torch.zeros(MINIBATCH, 1)})
    with Operations() as operations, FlopCounterMode(display=False) as flops:
        for name in trainer.update.objective.optimizers:
            trainer.update._learn(name, batch, [torch.arange(MINIBATCH)])
    return counts | {"step_operations": operations.count, "step_flops": flops.get_total_flops() / MINIBATCH}


def fit(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return the model's constants: seconds per control step and sample on one thread, and a second thread's gain."""
    one = of_threads(rows, 1)
    two = of_threads(rows, 2)
    constants: dict[str, float] = {}
    for name in ("forward", "other"):
        sizes = [row["num_envs"] for row in one]
        slope, constant = np.polyfit(sizes, [row[f"{name}_seconds"] / STEPS for row in one], 1, w=1 / np.array(sizes))
        constants |= {f"{name}_per_step": max(constant, 0.0), f"{name}_per_sample": slope}
    for name in ("physics", "update"):
        seconds = [[row[f"{name}_seconds"] / row["num_envs"] / STEPS for row in some] for some in (one, two)]
        gain = float(np.median(np.divide(*seconds)))
        constants |= {f"{name}_per_sample": np.median(seconds[0]), f"{name}_gain": float(np.clip(gain, 1, 2))}
    return {name: float(value) for name, value in constants.items()}


def predict(num_envs: int, cores: int, gpu: bool, c: dict[str, float], *, linear: bool) -> int:
    """Return samples per second on ``cores`` cores, with or without a GPU, from the model's constants."""

    def speed_up(name: str) -> float:
        gain = c[f"{name}_gain"]
        if linear:
            return 1 + (cores - 1) * (gain - 1)
        serial = 2 / gain - 1
        return 1 / (serial + (1 - serial) / cores)

    samples = num_envs * STEPS
    physics = samples * c["physics_per_sample"] / speed_up("physics")
    rest = STEPS * c["other_per_step"] + samples * c["other_per_sample"]
    if not gpu:
        forward = STEPS * c["forward_per_step"] + samples * c["forward_per_sample"]
        return round(samples / (physics + rest + forward + samples * c["update_per_sample"] / speed_up("update")))
    launches = GPU["operations_per_second"]
    rate = GPU["flops"]
    forward = STEPS * max(c["forward_operations"] / launches, num_envs * c["forward_flops"] / rate)
    forward += STEPS * TRANSFERS * GPU["seconds_per_transfer"]
    steps = EPOCHS * max(samples / MINIBATCH, 1)
    update = steps * max(c["step_operations"] / launches, min(MINIBATCH, samples) * c["step_flops"] / rate)
    return round(samples / (physics + rest + forward + update))


def main() -> None:
    """Measure, fit, predict, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--refit", action="store_true")
    parser.add_argument("--output", type=Path)
    arguments = parser.parse_args()
    sizes = QUICK_SIZES if arguments.quick else SIZES
    output = arguments.output or (None if arguments.quick else RESULTS)
    if not arguments.refit:
        rows = [measure(size, threads, 0) for size in sizes for threads in sorted({1, 2, CORES})]
        rows += [measure(size, 1, workers) for size in sizes[1:3] for workers in (1, 2)]
        rows = [row | about() for row in rows]
        print(table([{key: row[key] for key in (*MEASURED, *CPU)} for row in rows]))
        if output:
            write(output, rows)
    else:
        rows = read(output or RESULTS)
    constants = fit(rows) | count()
    local = {(row["threads"], row["num_envs"]): int(row["samples_per_second"]) for row in rows if not row["workers"]}
    predictions = [
        {"machine": name, "num_envs": size}
        | {bound: predict(size, *machine, constants, linear=bound == "high") for bound in ("low", "high")}
        | {"measured": "" if machine[1] else local.get((machine[0], size), "")}
        for name, machine in MACHINES.items()
        for size in sizes
    ]
    print(table(serial_shares(rows)), table(predictions), sep="\n")
    print(*(f"{name} {value:.4g}" for name, value in constants.items()), sep="\n")
    if output:
        write(output.with_name(f"{output.stem}_predicted.csv"), predictions)
        values = [{"constant": name, "value": f"{value:.4g}"} for name, value in (constants | GPU).items()]
        write(output.with_name(f"{output.stem}_constants.csv"), values)


def read(path: Path) -> list[dict[str, Any]]:
    """Return the measurements in a file."""
    with path.open(newline="") as file:
        return [row | {key: float(row[key]) for key in MEASURED} for row in csv.DictReader(file)]


if __name__ == "__main__":
    main()
