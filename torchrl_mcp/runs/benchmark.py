"""Benchmarks: many runs of ``torchrl-mcp-train``, which Hydra's launchers start, pre-training before transfer.

The rows and settings of a benchmark file are expanded to runs. The configured launcher starts the runs in two batches,
because Hydra's sweepers cannot make one run wait for another: first pre-training and runs that need none, then
transfer. The configuration in its folder identifies a run. Re-running a benchmark skips finished runs, resumes the
others, and refuses folders with other settings.
"""

import sys
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, cast

from hydra import initialize_config_module
from hydra.core.config_loader import ConfigLoader
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.experimental.callback import Callback
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, RunMode
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from torchrl_mcp.runs import experiment, quoting, records
from torchrl_mcp.runs.configuration import planned
from torchrl_mcp.runs.identity import TRANSFER_ONLY, differences, is_among
from torchrl_mcp.runs.imports import require_environment
from torchrl_mcp.runs.requirements import require_settings
from torchrl_mcp.runs.status import MANIFEST, overview, write_manifest
from torchrl_mcp.runs.trust import targets, trusting
from torchrl_mcp.training.run_folder import CONFIG, LOG
from torchrl_mcp.values import shown

QUIET = ["hydra/hydra_logging=none", "hydra/job_logging=none"]

Settings = Mapping[str, str]
"""Values of settings by name, as on the command line."""


@dataclass(frozen=True)
class Job:
    """A run of a benchmark.

    Attributes:
        folder: Run folder.
        overrides: Command-line overrides.
        config: Resolved configuration.
        needs: Folder of the pre-training that must be complete first, or None without pre-training.
    """

    folder: Path
    overrides: list[str]
    config: dict[str, Any]
    needs: Path | None = None

    def after(self, pretraining: Path) -> "Job":
        """Return this job with transfer from the pre-training in a folder."""
        config = {**self.config, "pretrained": str(pretraining)}
        places = [quoting.setting("pretrained", pretraining), quoting.setting("run_dir", self.folder)]
        return Job(self.folder, [*self.overrides, *places], config, pretraining)


def main(arguments: Sequence[str]) -> None:
    """Run the incomplete runs of the benchmark on the command line.

    Raises:
        ValueError: If the arguments fit no row, or a folder holds a run with other settings.
        SystemExit: If runs are not complete afterwards; the message lists them with the reasons.
    """
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        hydra = GlobalHydra.instance().hydra
        assert hydra is not None
        master = hydra.compose_config("train", [*QUIET, *arguments], RunMode.MULTIRUN, with_log_configuration=False)
        context = HydraContext(config_loader=hydra.config_loader, callbacks=cast("Any", Callback()))
        jobs = plan(master, hydra.config_loader)
        launcher = Plugins.instance().instantiate_launcher(context, run, master)
        with trusting({name for job in jobs for name in targets(job.config)}):  # the run folders repeat these names
            unfinished = complete(jobs, launcher, master)
    if unfinished:
        sys.exit("\n".join(unfinished))
    done = f"all {len(jobs)} runs are" if len(jobs) > 1 else "the run is"
    print(f"{done} complete: {quoting.command('report', master.run_root)}")


def complete(jobs: Sequence[Job], launcher: Launcher, master: DictConfig) -> list[str]:
    """Launch the incomplete jobs of the benchmark ``master.benchmark``.

    Returns:
        A line with the reason for every job that is still incomplete.

    Raises:
        ValueError: If a folder holds a run with other settings.
    """
    if conflicts := [line for job in jobs if (line := conflict(job))]:
        raise ValueError("\n".join(["nothing was started, because folders hold runs with other settings:", *conflicts]))
    runs = {job.folder: job.config["training"]["total_frames"] for job in jobs}
    name = MANIFEST.format(master.hydra.runtime.choices.benchmark)
    write_manifest(runs, Path(master.hydra.sweep.dir) / name)
    with overview(Path(master.run_root), runs):
        launched = launch(jobs, launcher)
    return [line for job in jobs if (line := outcome(job, launched))]


def plan(master: DictConfig, loader: ConfigLoader) -> list[Job]:
    """Return all runs of the benchmark ``master.benchmark`` with the command line applied, pre-training first.

    An argument that is also a key of rows, such as ``task=heading``, selects rows. Any other argument sets a setting of
    all runs, to one value or to several. If the method keeps parts, the run transfers from a pre-training with the same
    settings, which several runs may share.

    Raises:
        ValueError: If the benchmark's rows are malformed, no row fits the arguments, or two runs with different
            settings would share a folder.
    """
    rows = rows_of(master)
    params = [f"{key}={shown(value)}" for key, value in (master.benchmark.get("params") or {}).items()]
    given = [line for line in master.hydra.overrides.task if not line.startswith(("benchmark=", "benchmark."))]
    overrides = OverridesParser.create(config_loader=loader).parse_overrides([*params, *given])
    choices = {override.get_key_element(): values(override) for override in overrides}
    require_in_rows(rows, choices)
    pretraining: dict[tuple[str, ...], Job] = {}
    transfer: list[Job] = []
    for settings in expand(rows, choices):
        job = make_job({**settings, "stage": "transfer"}, master, loader)
        if job.config["transfer"]["keep"] and not job.config["pretrained"]:
            needed = pretraining_of(settings, job.config["task"])
            key = tuple(f"{name}={value}" for name, value in needed.items())
            pretraining[key] = pretraining.get(key) or make_job(needed, master, loader)
            job = job.after(pretraining[key].folder)
        transfer.append(job)
    if not transfer:
        listed = "\n".join(map(str, rows))
        raise ValueError(f"no row of the benchmark fits {' '.join(given)}: select some of its rows,\n{listed}")
    jobs = [*pretraining.values(), *transfer]
    require_own_folders(jobs)
    return jobs


def rows_of(master: DictConfig) -> list[dict[str, list[Any]]]:
    """Return the rows of the benchmark ``master.benchmark``.

    Raises:
        ValueError: If ``rows`` is not a list of mappings from settings to lists of values.
    """
    content = OmegaConf.to_container(master.benchmark)
    rows: Any = content.get("rows") if isinstance(content, dict) else None
    fits = isinstance(rows, list) and all(isinstance(row, dict) for row in rows)
    if not fits or not all(isinstance(values, list) for row in rows for values in row.values()):
        raise ValueError(
            f"benchmark={master.hydra.runtime.choices.benchmark} needs rows of lists: write "
            "rows: [{task: [heading], method: [mcp, moe]}] in its file"
        )
    return rows


def expand(rows: Sequence[Mapping[str, Sequence[str]]], choices: Mapping[str, Sequence[str]]) -> Iterator[Settings]:
    """Yield the combinations of every row that ``choices`` permit, with every combination of the other choices.

    >>> list(expand([{"task": ["heading", "carry"]}], {"task": ["carry"], "seed": ["0", "1"]}))
    [{'task': 'carry', 'seed': '0'}, {'task': 'carry', 'seed': '1'}]
    """
    for row in rows:
        fixed = {key: [shown(value) for value in row[key]] for key in row}
        selected = {key: [value for value in fixed[key] if value in choices.get(key, fixed[key])] for key in row}
        further = {key: choice for key, choice in choices.items() if key not in row}
        for combination in product(*selected.values(), *further.values()):
            yield dict(zip([*selected, *further], combination, strict=True))


def require_in_rows(rows: Sequence[Mapping[str, Sequence[str]]], choices: Mapping[str, Sequence[str]]) -> None:
    """Check that every chosen value fits a row.

    Raises:
        ValueError: If all rows have the key of a choice, but none has its value.
    """
    for key in (key for key in choices if all(key in row for row in rows)):
        available = dict.fromkeys(shown(value) for row in rows for value in row[key])
        if unknown := [value for value in choices[key] if value not in available]:
            raise ValueError(
                f"no row of the benchmark has {key}={','.join(unknown)}: give some of {','.join(available)}"
            )


def values(override: Override) -> list[str]:
    """Return the values of one argument of the command line."""
    if override.is_discrete_sweep():
        return [str(value) for value in override.sweep_string_iterator()]
    return [override.get_value_element_as_str()]


def pretraining_of(settings: Settings, task: Mapping[str, Any]) -> Settings:
    """Return the settings of the pre-training from which a run transfers.

    Args:
        settings: Settings of the run.
        task: Configuration of the run's task.
    """
    name = task["name"] if "pretrain" in task else "imitation"
    kept = {
        key: value
        for key, value in settings.items()
        if not is_among(key.lstrip("+"), TRANSFER_ONLY)
        and (name == task["name"] or not key.lstrip("+").startswith("task."))
    }
    return {**kept, "task": name, "stage": "pretrain"}


def make_job(settings: Settings, master: DictConfig, loader: ConfigLoader) -> Job:
    """Return the run with these settings, in its configured folder."""
    overrides = [f"{key}={value}" for key, value in {**settings, "progress_bar": "false"}.items()]
    cfg = loader.load_sweep_config(master, overrides)
    with _current(cfg):
        with read_write(cfg), open_dict(cfg):
            del cfg["hydra"]
        require_settings(cfg)
        require_environment(cfg)
        plan = planned(cfg)
    return Job(plan.folder, overrides, plan.config)


@contextmanager
def _current(cfg: DictConfig) -> Iterator[None]:
    """Let ``${hydra:...}`` refer to a configuration during the block.

    Hydra documents how to set the configuration, but not how to restore the previous one; Hydra's jobs also assign
    ``cfg``.
    """
    previous = HydraConfig.instance().cfg
    HydraConfig.instance().set_config(cfg)
    try:
        yield
    finally:
        HydraConfig.instance().cfg = previous


def require_own_folders(jobs: Sequence[Job]) -> None:
    """Check that no two jobs share a folder.

    Raises:
        ValueError: If two jobs have the same folder.
    """
    owners: dict[Path, Job] = {}
    for job in jobs:
        owner = owners.setdefault(job.folder, job)
        if owner is not job:
            changed = ", ".join(differences(owner.config, job.config)) or "nothing"
            raise ValueError(
                f"two runs, which differ in {changed}, would share the folder {job.folder}: run them one after the "
                "other, each with a different run_root"
            )


def conflict(job: Job) -> str | None:
    """Return the reason why a job cannot use its folder, or None if it can."""
    if not (job.folder / CONFIG).exists():
        return None
    if not (changed := records.changes(job.folder, job.config)):
        return None
    return f"{job.folder} differs in {', '.join(changed)}: keep the folder, and choose another run_root"


def launch(jobs: Sequence[Job], launcher: Launcher) -> list[Job]:
    """Launch incomplete jobs in batches, each as soon as its pre-training is complete, and return the launched jobs."""
    launched: list[Job] = []
    waiting = [job for job in jobs if not is_complete(job.folder)]
    while ready := [job for job in waiting if job.needs is None or is_complete(job.needs)]:
        try:
            launcher.launch([job.overrides for job in ready], initial_job_idx=len(launched))
        except Exception:  # launchers raise all kinds of errors when a worker dies; the folders show what finished
            traceback.print_exc()
        launched += ready
        waiting = [job for job in waiting if job not in ready]
    return launched


def run(cfg: DictConfig) -> None:
    """Train as configured or resume the run, and write the output to the log in the run folder."""
    folder = Path(cfg.run_dir)
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / LOG).open("a", buffering=1) as log, redirect_stdout(log), redirect_stderr(log):
        try:
            experiment.train_or_resume(cfg, wait=True)
        except Exception:
            traceback.print_exc()
            raise


def is_complete(folder: Path) -> bool:
    """Return whether a folder holds a finished and evaluated run."""
    return (folder / CONFIG).exists() and records.is_complete(folder)


def outcome(job: Job, launched: Sequence[Job]) -> str | None:
    """Return the reason why a job is not complete, or None if it is complete."""
    if is_complete(job.folder):
        return conflict(job)  # its pre-training, which has been made meanwhile, may differ
    if job in launched:
        return f"failed: {job.folder}, see {job.folder / LOG}"
    return f"not run: {job.folder}, which needs {job.needs}"
