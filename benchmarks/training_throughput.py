"""Measures training samples per second on the CPU, end to end, of this library and of Stable-Baselines3's PPO.

    pip install -c constraints.txt stable-baselines3    # adds this one package, changes no other
    python benchmarks/training_throughput.py            # minutes, writes results/training_throughput.csv
    python benchmarks/training_throughput.py --quick    # seconds, writes nothing without --output

Both train Gymnasium's Ant-v5 without contact forces, and the time includes the whole iteration: acting, physics,
resets, advantages, gradient steps, metrics. Policy and value networks (1024-512, ReLU, separate), initial standard
deviation, frames per iteration, minibatch and epochs (of preset=fast), step size and number of threads are the same.
Everything else is each library's default: this library has a goal, standardises inputs and takes fused Adam steps.

A contender is ``ours-METHOD-PRECISION`` or ``sb3-VECENV-NUM_ENVS``; ``--contenders`` selects contenders. With
``--before PYTHON``, an interpreter with another version of this library, ``before-METHOD-PRECISION`` measures that
version. Each contender has a separate process, in which the first iteration does not count. The contenders then take
turns, one iteration each per round, while the others wait, so that a busy machine slows all of them. A speed is the
median over rounds, and a ratio is the median of the ratios of all rounds.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from hydra import compose, initialize_config_module
from omegaconf import DictConfig
from report import about, peak_memory, table, write

SCRIPT = Path(__file__).resolve()
RESULTS = SCRIPT.parent / "results" / "training_throughput.csv"
CONTENDERS = ["ours-scratch-bf16", "ours-scratch-fp32", "ours-mcp-bf16", "sb3-dummy-128", "sb3-subproc-16"]
QUICK_CONTENDERS = ["ours-scratch-bf16", "sb3-dummy-16"]
QUICK_TRAINING = {"num_envs": 16, "frames_per_batch": 256, "minibatch_size": 128, "num_epochs": 1}
STEP_SIZE = 3e-4
SECTIONS = ("physics", "forward", "update", "other")
AIM = 2.0

Iteration = dict[str, Any]
"""Report of a worker: ``seconds``, peak ``memory`` in MiB, and ``shares`` of the seconds by section."""


def composed(*overrides: str) -> DictConfig:
    """Return the configuration of a training run."""
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        return compose("train", list(overrides))


class Turns:
    """Turns of a worker: an iteration begins with a line of standard input, and ends with a line of JSON."""

    def begin(self) -> None:
        """Wait for a line, or exit at the end of the input."""
        if not sys.stdin.readline():
            raise SystemExit
        self.start = time.perf_counter()

    def end(self, shares: dict[str, float]) -> None:
        """Report seconds, memory and shares of sections of the iteration."""
        seconds = time.perf_counter() - self.start
        print(json.dumps({"seconds": seconds, "memory": peak_memory(os.getpid()), "shares": shares}), flush=True)

    def log_metrics(self, metrics: dict[str, float], step: int) -> None:
        """End the turn. The trainer calls this method like a logger after each iteration."""
        self.end({section: metrics[f"time/{section}"] for section in SECTIONS})
        self.begin()


def ours(method: str, precision: str, training: dict[str, int]) -> None:
    """Train with this library's configuration and loop."""
    from torchrl_mcp.runs import build

    settings = {
        "method": method,
        "task": "holdout",
        "task.directions.pretrain": [0, 0],  # +x, with the reward of Ant-v5
        "task.pretrain.max_episode_steps": 1000,
        "autocast": precision == "bf16",
        "width": 1.0,
        "learned_std": False,
        "optimizer.actor.lr": STEP_SIZE,
        "optimizer.critic.lr": STEP_SIZE,
        "optimizer.schedule": "null",
        "training.total_frames": 10**12,  # until standard input ends
        "checkpoint_interval": 10**9,
        "progress_bar": False,
        "run_dir": ".",
        **{f"training.{key}": value for key, value in training.items()},
    }
    cfg = composed(*(f"{key}={value}" for key, value in settings.items()))
    source = build.make_source(cfg)
    trainer = build.make_trainer(cfg, build.make_agent(cfg, source.env), source, Path(cfg.run_dir))
    turns = Turns()
    trainer.folder.metrics.loggers = [turns]
    turns.begin()
    trainer.run()


def sb3(vec_env: str, num_envs: str, training: dict[str, int]) -> None:
    """Train with Stable-Baselines3, with ``DummyVecEnv`` (a loop) or ``SubprocVecEnv`` (a process per ant)."""
    from math import log

    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
    from torch import nn

    class Callback(BaseCallback):
        turns, collected = Turns(), 0.0

        def _on_rollout_start(self) -> None:
            if self.num_timesteps:
                now = time.perf_counter()
                self.turns.end({"update": (now - self.collected) / (now - self.turns.start)})
            self.turns.begin()

        def _on_rollout_end(self) -> None:
            self.collected = time.perf_counter()

        def _on_step(self) -> bool:
            return True

    classes: dict[str, type[DummyVecEnv] | type[SubprocVecEnv]] = {"dummy": DummyVecEnv, "subproc": SubprocVecEnv}
    env = make_vec_env(
        "Ant-v5",
        int(num_envs),
        seed=0,
        env_kwargs={"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0},
        vec_env_cls=classes[vec_env],
    )
    cells = [1024, 512]
    std = composed("method=scratch").parts.policy.std
    ppo = PPO(
        "MlpPolicy",
        env,
        learning_rate=STEP_SIZE,
        n_steps=training["frames_per_batch"] // int(num_envs),
        batch_size=training["minibatch_size"],
        n_epochs=training["num_epochs"],
        policy_kwargs={"net_arch": {"pi": cells, "vf": cells}, "activation_fn": nn.ReLU, "log_std_init": log(std)},
        seed=0,
        device="cpu",
    )
    ppo.learn(10**12, callback=Callback())


def worker(name: str, training: dict[str, int], threads: int) -> None:
    """Train as a contender."""
    import torch

    torch.set_num_threads(threads)
    family, kind, detail = name.split("-")
    {"ours": ours, "before": ours, "sb3": sb3}[family](kind, detail, training)


def iterate(name: str, process: subprocess.Popen) -> Iteration:
    """Let a contender take one iteration, and return its report."""
    assert process.stdin is not None
    assert process.stdout is not None
    with suppress(BrokenPipeError):
        process.stdin.write("\n")
        process.stdin.flush()
    for line in process.stdout:
        if line.startswith("{"):
            return json.loads(line)
    raise SystemExit(f"{name} failed, see above")


def measure(
    contenders: list[str], training: dict[str, int], threads: int, rounds: int, before: str
) -> dict[str, list[Iteration]]:
    """Return every contender's iterations, one per round; ``before`` is the interpreter of ``before-...``."""
    processes: dict[str, subprocess.Popen] = {}
    pipe = subprocess.PIPE
    settings = ["--threads", str(threads), "--worker", json.dumps(training)]
    with TemporaryDirectory() as folder:
        try:
            for name in contenders:
                python = before if name.startswith("before") else sys.executable
                command = [python, str(SCRIPT), *settings, name]
                home = Path(folder, name)
                home.mkdir()
                processes[name] = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=home)
                iterate(name, processes[name])
            iterations: dict[str, list[Iteration]] = {name: [] for name in contenders}
            for _ in range(rounds):
                for name, process in processes.items():
                    iterations[name].append(iterate(name, process))
        finally:
            for process in processes.values():
                process.communicate()
    return iterations


def summaries(iterations: dict[str, list[Iteration]], frames: int) -> list[dict[str, Any]]:
    """Return a row of numbers per contender."""
    seconds = {name: [entry["seconds"] for entry in entries] for name, entries in iterations.items()}
    best = min((name for name in seconds if name.startswith("sb3")), key=lambda name: median(seconds[name]), default="")
    rows = []
    for name, entries in iterations.items():
        ratios = [rival / ours for ours, rival in zip(seconds[name], seconds.get(best, []), strict=False)]
        shares = [entry["shares"] for entry in entries]
        rows.append(
            {
                "contender": name,
                "samples_per_second": round(frames / median(seconds[name])),
                "slowest": round(frames / max(seconds[name])),
                "fastest": round(frames / min(seconds[name])),
                "of_best_sb3": round(median(ratios), 3) if ratios else "",
                **{key: round(median(s[key] for s in shares), 3) if key in shares[0] else "" for key in SECTIONS},
                "memory_mib": round(max(entry["memory"] for entry in entries)),
            }
        )
    return rows


def available(contenders: list[str]) -> list[str]:
    """Return the contenders that are installed, and print a message for all others."""
    if importlib.util.find_spec("stable_baselines3"):
        return contenders
    for name in contenders:
        if name.startswith("sb3"):
            print(f"{name}: skipped, because stable-baselines3 is not installed")
    return [name for name in contenders if not name.startswith("sb3")]


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small batches, fewer contenders and rounds")
    parser.add_argument("--contenders", nargs="+", metavar="NAME")
    parser.add_argument(
        "--before", default=sys.executable, metavar="PYTHON", help="interpreter of contenders before-..."
    )
    parser.add_argument("--rounds", type=int, help="iterations of every contender")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="torch threads of every contender")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        worker(args.worker[1], json.loads(args.worker[0]), args.threads)
        return

    preset = composed("preset=fast").training
    training = QUICK_TRAINING if args.quick else {key: preset[key] for key in QUICK_TRAINING}
    contenders = available(args.contenders or (QUICK_CONTENDERS if args.quick else CONTENDERS))
    if not contenders:
        return
    rounds = args.rounds or (2 if args.quick else 10)
    conditions = {**training, "step_size": STEP_SIZE, "threads": args.threads, "rounds": rounds, **about()}
    print(" | ".join(f"{key} {value}" for key, value in conditions.items()), flush=True)
    rows = summaries(measure(contenders, training, args.threads, rounds, args.before), training["frames_per_batch"])
    print(table(rows))
    for row in rows:
        if row["contender"].startswith("ours-scratch") and row["of_best_sb3"]:
            print(f"{row['contender']}: {row['of_best_sb3']:.2f} times as fast as the best SB3 (aim {AIM})")
    if output := args.output or (None if args.quick else RESULTS):
        write(output, [{**row, **conditions} for row in rows])
        print(f"written to {output}")


if __name__ == "__main__":
    main()
