r"""Searches settings at equal processor time: every trial of every method trains for the same CPU seconds on one core.

    python benchmarks/search.py carry mcp --minutes 15
    python benchmarks/search.py dribble latent_space --minutes 40
    python benchmarks/search.py carry mcp --minutes 15 --seeds 100 101 102 103 104 \
        --candidate default= --candidate large="training.num_envs=512 training.frames_per_batch=16384"

The protocol is the same for all methods and tasks, in float32 with the biped:

* A trial is a set of settings, which are arguments of ``torchrl-mcp-train``. Optuna draws the settings at
  random, except for the first trial, which has the current defaults. Every method has the same number of trials.
* A trial trains with the seeds 100 and 101, which no table uses: in imitation from the start, in all other tasks from
  one pre-training of the method (5 M steps). A run is stopped after a number of CPU seconds, counted from its first
  step, so that other work on the machine does not distort the comparison. All trials of a study must run on the same
  kind of processor, which every row names.
* After half of the time, each seed plays 128 deterministic and 128 exploring episodes of the paper's task. Optuna's
  successive halving (reduction factor 2) ends the trial unless it is in the better half so far. Other trials train to
  the end and are evaluated again. An earlier first evaluation would be unfair: after a quarter of the time, large
  batches score worse than small batches, but at the end they score better.
* The score is success plus normalised return, averaged over seeds and over deterministic and exploring episodes. A task
  without success is scored by its return alone.

Re-running the command continues with the missing trials. With candidates, the script trains only the candidates, for
the whole time and with every seed, and writes a separate table. Optuna 4 or newer is incompatible with Hydra's plugin:
install Optuna in a separate environment.
"""

import argparse
import csv
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from cpu_time import Training, processor, scored
from report import about, append

SEEDS = (100, 101)
"""Seeds of the trials. Tables use seeds from 0."""

PRETRAINED = Path(__file__).parent / "results" / "table2" / "networks"

RESULTS = Path(__file__).parent / "results" / "search"

STEPS_PER_CHECKPOINT = 65_536

OVERSHOOT = 4.0
"""CPU seconds by which a run may exceed its time: it is stopped once per second, and several threads may compute."""

BATCHES = {"1024": (32, 1024), "4096": (128, 4096), "16384": (512, 16_384)}
"""Numbers of environments and of steps per batch, by the size of the batch."""

CHOICES = {"8192": (32, 1024), "32768": (128, 4096), "131072": (512, 16_384)}
"""The same for the hierarchical model, whose batches are eight times as large as ``training.frames_per_batch``."""


def suggest(trial: Any, method: str) -> list[str]:
    """Return the settings of a trial, which the sampler draws except for the trial with the defaults."""
    if trial.user_attrs.get("default"):
        return []
    batches = CHOICES if method == "hierarchical" else BATCHES
    chosen = batches[trial.suggest_categorical("batch", list(batches))]
    words = batch_words(
        *chosen,
        minibatches=trial.suggest_categorical("minibatches", [8, 16]),
        passes=trial.suggest_categorical("passes", [4, 8]),
    )
    words += [
        f"step_size.target_kl={trial.suggest_categorical('target_kl', [0.02, 0.05, 0.1])}",
        f"step_size.max={trial.suggest_categorical('max_step', [5e-4, 1e-3])}",
        f"stage.gamma={trial.suggest_categorical('discount', [0.99, 0.995])}",
    ]
    return [*words, *NOISE[method][trial.suggest_categorical("noise", list(NOISE[method]))].split()]


def batch_words(num_envs: int, frames: int, *, minibatches: int, passes: int) -> list[str]:
    """Return the settings for a batch."""
    return [
        f"training.num_envs={num_envs}",
        f"training.frames_per_batch={frames}",
        f"training.minibatch_size={frames // minibatches}",
        f"training.num_epochs={passes}",
    ]


def _logits() -> dict[str, str]:
    return {
        "actions": "exploration=action",
        "weights 0.5": "exploration=weights exploration.actor.logits_std=0.5",
        "weights 1": "exploration=weights exploration.actor.logits_std=1",
        "weights learned": "exploration=weights exploration.learned_logits_std=0.5",
    }


def _actions(stds: Sequence[float]) -> dict[str, str]:
    return {
        f"{std}{' learned' if learned else ''}": f"action_std={std} learned_std={str(learned).lower()}"
        for std in stds
        for learned in (False, True)
    }


NOISE = {
    "mcp": _logits(),
    "moe": _logits(),
    "latent_space": {
        "actions": "exploration=action",
        "latents 0.5": "exploration=weights exploration.latent_std=0.5",
        "latents 1": "exploration=weights exploration.latent_std=1",
        "latents learned": "exploration=weights",
    },
    "finetune": _actions([0.05, 0.1]),
    "scratch": _actions([0.1, 0.2]),
    "hierarchical": {"means": "exploration=weights", "samples": "exploration=action"},
    "option_critic": {f"{share} random": f"epsilon={share}" for share in (0.05, 0.1, 0.2)},
}
"""Settings of exploration by name, for every method."""


def settings_of(task: str, method: str) -> list[str]:
    """Return the settings that all trials of a method in a task share; imitation is pre-training."""
    stage = "pretrain" if task == "imitation" else "transfer"
    begins_anew = stage == "pretrain" or method == "scratch"
    pretrained = [] if begins_anew else [f"pretrained={PRETRAINED / f'{method}-biped-0.torchrl'}"]
    return [f"task={task}", f"method={method}", "character=biped", f"stage={stage}", *pretrained]


def search(task: str, method: str, root: Path, results: Path, *, seconds: float, trials: int) -> None:
    """Search, and write a row after each evaluation of a run.

    Args:
        task: Name of the task.
        method: Name of the method.
        root: Folder of the runs.
        results: Folder of tables and of Optuna's journal, with which an interrupted search continues.
        seconds: CPU seconds of a run.
        trials: Number of trials.
    """
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    name = f"{task}-{method}"
    study = optuna.create_study(
        study_name=name,
        storage=JournalStorage(JournalFileBackend(str(results / "search.journal"))),
        load_if_exists=True,
        direction="maximize",
        pruner=optuna.pruners.SuccessiveHalvingPruner(min_resource=1, reduction_factor=2, min_early_stopping_rate=0),
    )
    for trial in study.trials:
        if trial.state == optuna.trial.TrialState.RUNNING:  # the search was interrupted during this trial
            study.tell(trial.number, state=optuna.trial.TrialState.FAIL)
            if trial.params:
                study.enqueue_trial(trial.params)
    if not any(trial.user_attrs.get("default") for trial in study.trials if trial.state.name != "FAIL"):
        study.enqueue_trial({}, user_attrs={"default": True})
    table = Table(results / f"{name}.csv")
    # A search that continues draws other settings than those before the interruption.
    study.sampler = optuna.samplers.RandomSampler(seed=SEEDS[0] + len(study.trials))

    def objective(trial: Any) -> float:
        settings = suggest(trial, method)
        score = 0.0
        trainings: list[Training] = []
        try:
            for seed in SEEDS:
                words = [*settings_of(task, method), f"seed={seed}", *settings]
                words.append(interval(words))
                trainings.append(Training(words, root / name / f"trial-{trial.number:02}-seed{seed}"))
                table.write(trial.number, seed, settings, scored(trainings[-1], seconds / 2))
            for step, used in ((1, seconds / 2), (2, seconds)):
                if step > 1:
                    for seed, training in zip(SEEDS, trainings, strict=True):
                        table.write(trial.number, seed, settings, scored(training, used))
                score = table.score(trial.number)
                trial.report(score, step)
                if step == 1 and trial.should_prune():
                    raise optuna.TrialPruned
        finally:
            for training in trainings:
                training.end()
        return score

    remaining = trials - sum(trial.state.name in ("COMPLETE", "PRUNED") for trial in study.trials)
    study.optimize(objective, n_trials=max(0, remaining), catch=(ChildProcessError, subprocess.CalledProcessError))


def interval(words: Sequence[str]) -> str:
    """Return the checkpoint interval in iterations for which all runs have the same number of steps per checkpoint.

    Args:
        words: All arguments of a run, because the defaults of a batch differ between tasks and methods.
    """
    from torchrl_mcp.runs.configuration import compose_run

    cfg = compose_run(*words)
    frames = cfg.training.frames_per_batch * cfg.get("batch_factor", 1)
    return f"checkpoint_interval={max(1, STEPS_PER_CHECKPOINT // frames)}"


def compare(
    task: str,
    method: str,
    root: Path,
    results: Path,
    candidates: dict[str, str],
    *,
    seconds: float,
    seeds: Sequence[int],
) -> None:
    """Train candidates for the whole time with every seed, and write a row for each run that has no row yet."""
    table = Table(results / f"{task}-{method}-candidates.csv")
    for seed in seeds:
        for name, arguments in candidates.items():
            settings = arguments.split()
            if table.contains(name, seed, settings, seconds):
                continue
            words = [*settings_of(task, method), f"seed={seed}", *settings]
            words.append(interval(words))
            training = Training(words, root / f"{task}-{method}" / f"{name}-seed{seed}")
            try:
                table.write(name, seed, settings, scored(training, seconds))
            finally:
                training.end()


class Table:
    """The rows of runs in a CSV file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The rows in the file, to which other searches may also write."""
        if not self.path.exists():
            return []
        with self.path.open(newline="") as file:
            return list(csv.DictReader(file))

    def write(self, trial: int | str, seed: int, settings: Sequence[str], numbers: dict[str, Any]) -> None:
        """Add a row."""
        row = {"trial": trial, "seed": seed, **numbers, "settings": " ".join(settings)}
        row |= {"processor": processor(), "commit": about()["commit"]}
        append(self.path, row)

    def score(self, trial: int) -> float:
        """Return the mean score of a trial's seeds in its last evaluation."""
        newest = {row["seed"]: float(row["score"]) for row in self.rows if row["trial"] == str(trial)}
        return mean(newest.values())

    def contains(self, trial: str, seed: int, settings: Sequence[str], seconds: float) -> bool:
        """Return whether the table contains a row of a run.

        Raises:
            SystemExit: If a row of the trial and seed has another commit, and thus perhaps other defaults, other
                settings or other CPU seconds.
        """
        rows = [row for row in self.rows if row["trial"] == trial and row["seed"] == str(seed)]
        expected = (" ".join(settings), about()["commit"])
        for row in rows:
            alike = seconds <= float(row["cpu_seconds"]) <= 1.05 * seconds + OVERSHOOT
            if not alike or (row["settings"], row["commit"]) != expected:
                raise SystemExit(
                    f"{self.path} has rows of {trial} with another commit, other settings or seconds: remove these "
                    "rows, or rename the candidate"
                )
        return bool(rows)


def main(argv: Sequence[str] | None = None, run: Callable[..., None] = search) -> None:
    """Search, or compare candidates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task")
    parser.add_argument("method")
    parser.add_argument("--minutes", type=float, required=True, help="CPU minutes of a trial")
    parser.add_argument("--trials", type=int, default=6)
    parser.add_argument(
        "--candidate", action="append", default=[], metavar="NAME=SETTINGS", help="train these settings, do not search"
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS), help="seeds of candidates")
    parser.add_argument("--root", type=Path, default=Path("runs/search"), help="folder of the runs")
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the tables")
    arguments = parser.parse_args(argv)
    if arguments.task == "imitation" and not arguments.candidate:
        parser.error("the proposed settings are for transfer: give a --candidate for imitation")
    arguments.results.mkdir(parents=True, exist_ok=True)
    study = (arguments.task, arguments.method, arguments.root, arguments.results)
    seconds = 60 * arguments.minutes
    if arguments.candidate:
        candidates = dict(one.split("=", 1) for one in arguments.candidate)
        compare(*study, candidates, seconds=seconds, seeds=arguments.seeds)
    else:
        run(*study, seconds=seconds, trials=arguments.trials)


if __name__ == "__main__":
    main()
