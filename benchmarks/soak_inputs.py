"""Tests damaged checkpoints and invalid actions, for ``soak.py``."""

import argparse
import math
import os
import random
import re
import tempfile
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import product
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import torch

from torchrl_mcp.envs.physics.simulation import LARGEST
from torchrl_mcp.runs import build, configuration, experiment, policies
from torchrl_mcp.training import checkpoint

SMALL = ("method=mcp", "task=holdout", "stage=pretrain", "preset=smoke", "width=0.0625", "autocast=false")
"""Settings of a short run with small checkpoints."""

TASKS = [("holdout", "ant"), *product(("imitation", "heading", "carry", "dribble"), ("biped", "humanoid", "trex"))]


def contents(path: Path) -> Mapping[str, bytes]:
    """Return the members of a checkpoint, except for times and random generators."""
    with ZipFile(path) as archive:
        names = [
            name for name in archive.namelist() if not re.match(r"manifest|components/\d+-(progress|random)", name)
        ]
        return {name: archive.read(name) for name in names}


def flips(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Damage a checkpoint, try to read it for a resume and for an evaluation, and yield a row for each."""
    with tempfile.TemporaryDirectory() as name:
        cfg = configuration.compose_run(*SMALL, f"run_dir={name}/run", "logger=none", "progress_bar=false")
        path = checkpoint.find(experiment.train(cfg))
        copy = Path(name) / "damaged.torchrl"
        _, agent, _ = policies.restore(path, num_envs=1, seed=0)
        intact_values = {key: value.clone() for key, value in agent.parts.state_dict().items()}
        original = path.read_bytes()
        results = {check: Counter[str]() for check in ("resume", "evaluate")}
        for _ in range(20 if args.quick else args.flips):
            data = bytearray(original)
            data[random.randrange(len(data))] ^= 1 << random.randrange(8)
            copy.write_bytes(data)
            intact = checkpoint.is_intact(copy)
            results["resume"]["refused" if not intact else outcome(contents(copy) == contents(path))] += 1
            for value in agent.parts.state_dict().values():
                value.zero_()
            try:
                checkpoint.load_agent(agent.parts, copy)
            except ValueError:
                results["evaluate"]["refused"] += 1
                continue
            same = all(torch.equal(value, intact_values[key]) for key, value in agent.parts.state_dict().items())
            results["evaluate"][outcome(same)] += 1
    for check, tally in results.items():
        counts = {name: tally[name] for name in ("refused", "harmless", "accepted_wrongly")}
        yield {"check": check, "bytes": len(original), "flips": tally.total(), **counts}


def outcome(same: bool) -> str:
    """Return the outcome for a damaged file that was accepted."""
    return "harmless" if same else "accepted_wrongly"


def steps(args: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Play invalid actions in all tasks with all characters, and yield a row for each pair."""
    os.chdir(tempfile.mkdtemp())  # MuJoCo writes its warnings to the working directory
    num_envs = 6 if args.quick else 768
    total = 60 * len(TASKS) if args.quick else args.steps
    chosen = [(task, character) for task, character in TASKS if task in args.tasks]
    for task, character in chosen:
        stage = "pretrain" if task in ("holdout", "imitation") else "transfer"
        cfg = configuration.compose_run(f"task={task}", f"character={character}", f"stage={stage}")
        env = build.make_env(cfg, num_envs=num_envs, seed=0, num_threads=args.threads)
        generator = torch.Generator().manual_seed(0)
        tally = Counter[str]()
        before = warned()
        began = time.monotonic()
        state = env.reset()
        with warnings.catch_warnings(record=True) as complaints:
            warnings.simplefilter("always")
            for _ in range(math.ceil(total / len(chosen) / num_envs)):
                action = actions(env.action_spec.low, env.action_spec.high, generator)
                unfit = ~(action.abs() < LARGEST).all(-1)
                taken, state = env.step_and_maybe_reset(state.set("action", action))
                ended = taken["next", "terminated"].squeeze(-1) & (taken["next", "reward"].squeeze(-1) == 0)
                emitted = [taken["next", key] for key in ("observation", "goal", "reward")] + [state["observation"]]
                tally.update(
                    steps=num_envs,
                    episodes=int(taken["next", "done"].sum()),
                    unfit=int(unfit.sum()),
                    missed=int((unfit & ~ended).sum()),
                    not_finite=sum(int((~value.isfinite()).sum()) for value in emitted),
                )
        seconds = time.monotonic() - began
        tally["diverged"] = env.num_diverged - tally["unfit"]
        tally["mujoco_warnings"] = warned() - before
        tally["python_warnings"] = len(complaints)
        names = ("steps", "episodes", "unfit", "missed", "diverged", "not_finite", "mujoco_warnings", "python_warnings")
        yield {"task": task, "character": character, **{name: tally[name] for name in names}} | {
            "steps_per_second": round(tally["steps"] / seconds)
        }


def actions(low: torch.Tensor, high: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Draw actions within the bounds, of any magnitude, and with NaN, each for a third of the simulations."""
    third = len(low) // 3
    drawn = low + (high - low) * torch.rand(low.shape, generator=generator)
    sizes = 10 ** (12 * torch.rand(third, 1, generator=generator))
    drawn[third : 2 * third] *= torch.where(sizes < 5e11, sizes, torch.inf)
    chosen = torch.rand(third, low.shape[-1], generator=generator) < 0.1 / low.shape[-1]
    drawn[2 * third : 3 * third][chosen] = torch.nan
    return drawn


def warned() -> int:
    """Count the warnings in MuJoCo's log of the working directory."""
    log = Path("MUJOCO_LOG.TXT")
    return log.read_text().count("WARNING") if log.exists() else 0
