r"""Search of settings at equal processor time: every trial trains for the same CPU seconds on one core.

    python benchmarks/search.py heading mcp pretrained=builtin stage=transfer --seconds 90 --trials 14
    python benchmarks/search.py heading mcp pretrained=builtin stage=transfer --seconds 120 --seeds 100 101 \
        --candidate large="training.num_envs=128 training.frames_per_batch=4096" --candidate small=

Optuna's TPE sampler proposes settings, each of them an argument of ``torchrl-mcp-train``. A trial is stopped by its CPU
seconds, counted from the first step on, so that other work on the machine does not falsify the comparison. Its score is
the mean of two returns: the mean of the episodes of training that ended in the last fifth of the time, and that of 64
deterministic episodes of the printed task. Trials with a training return below the median of the others at half the
time are given up. Repeated, the command goes on with the trials that are missing. With candidates, it compares these
alone, one run per seed, in a table of their own.

Optuna 4 or newer does not go with Hydra's plugin: install it in an environment of its own.
"""

import argparse
import csv
import json
import math
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from torchrl_mcp.training.run_folder import NORMALISED_RETURN, read_metrics

SEED = 100
"""First seed of the trials; tables use seeds from 0 on."""

FIXED = ("logger=none", "progress_bar=false", "torch_threads=1", "num_threads=1", "keep_checkpoints=1",
         "evaluation.episodes=0", "training.total_frames=1_000_000_000")  # fmt: skip
TICKS = os.sysconf("SC_CLK_TCK")


def suggest(trial: optuna.Trial, method: str) -> list[str]:
    """Return the settings of a trial."""
    num_envs = trial.suggest_categorical("num_envs", [16, 32, 64, 128])
    horizon = trial.suggest_categorical("horizon", [16, 32, 64])
    minibatch = min(trial.suggest_categorical("minibatch_size", [128, 256, 512]), num_envs * horizon)
    words = [
        f"training.num_envs={num_envs}",
        f"training.frames_per_batch={num_envs * horizon}",
        f"training.minibatch_size={minibatch}",
        f"training.num_epochs={trial.suggest_categorical('num_epochs', [2, 4, 8])}",
        f"step_size.actor={trial.suggest_categorical('lr', [6e-5, 3e-4, 1e-3])}",
        f"step_size.max={trial.suggest_categorical('max_lr', [5e-4, 1e-3, 2e-3])}",
        f"step_size.target_kl={trial.suggest_categorical('target_kl', [0.01, 0.02, 0.05, 0.1])}",
        f"step_size.critic={trial.suggest_categorical('critic_lr', [1e-4, 3e-4, 1e-3])}",
        f"lmbda={trial.suggest_categorical('lmbda', [0.8, 0.9, 0.95])}",
        f"width={trial.suggest_categorical('width', [0.25, 0.5])}",
    ]
    if method in ("mcp", "moe"):
        exploration = trial.suggest_categorical("exploration", ["action", "weights"])
        words.append(f"exploration={exploration}")
        if exploration == "weights":
            words.append(f"exploration.actor.logits_std={trial.suggest_categorical('logits_std', [0.25, 0.5, 1.0])}")
    checkpoints = max(1, 4096 // (num_envs * horizon))
    return [*words, f"checkpoint_interval={checkpoints}"]


KNOWN = [  # the settings of preset=fast before the search, and small batches
    {"num_envs": 128, "horizon": 32, "minibatch_size": 512, "num_epochs": 4, "lr": 3e-4, "max_lr": 5e-4,
     "target_kl": 0.02, "critic_lr": 1e-3, "lmbda": 0.95, "width": 0.5, "exploration": "weights", "logits_std": 0.5},
    {"num_envs": 32, "horizon": 32, "minibatch_size": 256, "num_epochs": 4, "lr": 3e-4, "max_lr": 5e-4,
     "target_kl": 0.02, "critic_lr": 3e-4, "lmbda": 0.95, "width": 0.5, "exploration": "weights", "logits_std": 0.5},
]  # fmt: skip


def cpu_seconds(pid: int) -> float:
    """Return the CPU seconds of a process with all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def recent_return(folder: Path, share: float) -> float:
    """Return the mean normalised return of the episodes that ended in the last ``share`` of the seconds, 0 if none did.

    An iteration weighs as much as the episodes that end in it: else early falls would count most.
    """
    rows = read_metrics(folder)
    late = [row for row in rows if row["seconds"] >= (1 - share) * rows[-1]["seconds"]]
    late = [row for row in late if math.isfinite(row[NORMALISED_RETURN])]  # from the first episode of full length on
    count = sum(row["episode/count"] for row in late)
    return sum(row["episode/count"] * row[NORMALISED_RETURN] for row in late) / count if count else 0.0


def train(words: list[str], folder: Path, seconds: float, trial: optuna.Trial | None) -> float:
    """Train for CPU seconds, and return those taken.

    Raises:
        optuna.TrialPruned: If the run failed, or is worse than the others at half the time.
    """
    command = ["torchrl-mcp-train", *words, *FIXED, f"run_dir={folder}"]
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / f"{folder.name}.log").open("w") as log:
        process = subprocess.Popen(command, stdout=log, stderr=log)
    began = used = 0.0
    halfway = False
    try:
        while process.poll() is None:
            time.sleep(1)
            if not (folder / "config.yaml").exists():
                began = cpu_seconds(process.pid)
                continue
            used = cpu_seconds(process.pid) - began
            if trial and not halfway and used >= seconds / 2:
                halfway = True
                trial.report(recent_return(folder, 0.2), 1)
                if trial.should_prune():
                    raise optuna.TrialPruned
            if used >= seconds:
                return used
        raise optuna.TrialPruned(f"{command} ended by itself")
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()


def score(folder: Path, seconds: float, words: list[str], trial: optuna.Trial | None = None) -> dict[str, float]:
    """Train and evaluate."""
    used = train(words, folder, seconds, trial)
    output = folder / "search.json"
    command = ["torchrl-mcp-evaluate", folder, "--episodes", "64", "--seed", "777", "--output", output]
    subprocess.run([str(word) for word in command], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    evaluated = json.loads(output.read_text())["deterministic"]["normalised_return"]
    last = (read_metrics(folder) or [{"frames": 0.0}])[-1]
    dead = [value for name, value in last.items() if name.startswith("dead")]
    return {
        "cpu_seconds": used,
        "steps": last["frames"],
        "training": recent_return(folder, 0.2),
        "deterministic": evaluated,
        "dead": max(dead, default=0.0),
    }


def main() -> None:
    """Search."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("method")
    parser.add_argument("settings", nargs="*", help="of all trials")
    parser.add_argument("--seconds", type=float, required=True, help="CPU seconds of a trial")
    parser.add_argument("--trials", type=int, default=24)
    parser.add_argument("--candidate", action="append", default=[], metavar="NAME=SETTINGS", help="instead of a search")
    parser.add_argument("--seeds", type=int, nargs="+", default=[SEED], help="of candidates")
    parser.add_argument("--root", type=Path, default=Path("runs/search"))
    arguments = parser.parse_args()
    root = arguments.root / f"{arguments.task}-{arguments.method}"
    root.mkdir(parents=True, exist_ok=True)
    fixed = [f"task={arguments.task}", f"method={arguments.method}", *arguments.settings]
    if arguments.candidate:
        compare(root, fixed, dict(one.split("=", 1) for one in arguments.candidate), arguments.seeds, arguments.seconds)
        return
    fixed.append(f"seed={SEED}")

    def objective(trial: optuna.Trial) -> float:
        folder = root / f"trial-{trial.number:03}"
        numbers = score(folder, arguments.seconds, [*fixed, *suggest(trial, arguments.method)], trial)
        for name, value in numbers.items():
            trial.set_user_attr(name, value)
        for checkpoint in folder.glob("checkpoints/*"):
            checkpoint.unlink()
        return (numbers["training"] + numbers["deterministic"]) / 2

    study = optuna.create_study(
        study_name=root.name,
        storage=JournalStorage(JournalFileBackend(str(arguments.root / "search.log"))),
        load_if_exists=True,
        direction="maximize",
        sampler=optuna.samplers.TPESampler(seed=SEED, multivariate=True, group=True, n_startup_trials=10),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=4),
    )
    if not study.trials:
        for settings in KNOWN:
            study.enqueue_trial(settings)
    done = sum(trial.state.is_finished() for trial in study.trials)
    study.optimize(objective, n_trials=max(0, arguments.trials - done), catch=(subprocess.CalledProcessError,))
    write(study, root.with_suffix(".csv"))


def compare(root: Path, fixed: list[str], candidates: dict[str, str], seeds: list[int], seconds: float) -> None:
    """Train and evaluate candidates with every seed, and write a row for each.

    Raises:
        SystemExit: If a candidate was scored with other seconds or settings.
    """
    table = []
    for seed in seeds:
        for name, settings in candidates.items():
            folder = root / f"{name}-seed{seed}"
            words = [*fixed, f"seed={seed}", "checkpoint_interval=4", *settings.split()]
            asked = {"seconds": seconds, "settings": " ".join(words)}
            if not (found := folder / "score.json").exists():
                shutil.rmtree(folder, ignore_errors=True)  # of an interrupted run
                found.write_text(json.dumps(score(folder, seconds, words) | asked))
            held = json.loads(found.read_text())
            if changed := [key for key, value in asked.items() if held.get(key) != value]:
                raise SystemExit(
                    f"{folder} was scored with other {' and '.join(changed)}: remove it, or give another --root"
                )
            table.append({"candidate": name, "seed": seed, **held})
            write_rows(table, root.with_name(f"{root.name}-candidates.csv"))


def write(study: optuna.Study, path: Path) -> None:
    """Write the trials, best first."""
    found = sorted(study.trials, key=lambda trial: -1 if trial.value is None else trial.value, reverse=True)
    table = [{"trial": t.number, "state": t.state.name, "score": t.value, **t.user_attrs, **t.params} for t in found]
    write_rows(table, path)


def write_rows(table: list[dict], path: Path) -> None:
    """Write a table as CSV."""
    names = list(dict.fromkeys(name for row in table for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(table)


if __name__ == "__main__":
    main()
