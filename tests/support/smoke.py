"""The smallest runs, and what tests compare of them."""

import csv

from torchrl_mcp.runs import policies
from torchrl_mcp.runs.configuration import compose_run

SMOKE = ("preset=smoke", "logger=none", "num_threads=1", "progress_bar=false")


def configure(folder, *overrides):
    """Compose a run of a few hundred steps in a folder."""
    return compose_run(*SMOKE, f"run_dir={folder}", *overrides)


def rows(folder):
    """Return what a run recorded, by iterations, save times."""
    with (folder / "metrics.csv").open(newline="") as file:
        lines = csv.DictReader(file)
        return [{k: v for k, v in row.items() if not k.startswith(("seconds", "time/"))} for row in lines]


def final_parts(folder):
    """Return parameters and statistics of a run's last policy."""
    return policies.restore(folder, num_envs=1, seed=0)[1].parts.state_dict()
