"""Sweeps: one bad run does not end them, and repeating them finishes them."""

import os
import subprocess
import sys
from datetime import datetime
from importlib.util import find_spec

import pytest
from omegaconf import OmegaConf

from torchrl_mcp.commands.sweep import Sweep

SMOKE = ["preset=smoke", "logger=none", "num_threads=1", "progress_bar=false", "evaluation.episodes=0", "width=0.05"]
# The ant has no heading, and the first step size diverges.
RUNS = [*SMOKE, "method=scratch", "task=heading", "training.total_frames=128", "character=ant,biped"]
SWEEP = ["--multirun", *RUNS, "optimizer.actor.lr=1e30,1e-4"]


def failures(outcome):
    return [line for line in outcome.stderr.splitlines() if line.startswith("failed: ") and ".log" in line]


def test_sweeps_of_two_processes_have_logs_of_their_own(tmp_path, monkeypatch):
    folders = set()
    for process in (1, 2):
        monkeypatch.setattr(os, "getpid", lambda process=process: process)
        monkeypatch.setattr("torchrl_mcp.commands.sweep.datetime", SameSecond)
        sweep = Sweep()
        sweep.on_multirun_start(OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path)}}}))
        folders.add(sweep.folder)
    assert len(folders) == 2


class SameSecond(datetime):
    @classmethod
    def now(cls):
        return cls(2026, 1, 2)


def test_every_other_run_of_a_sweep_takes_place_and_repeated_it_skips_what_is_complete(command, tmp_path):
    outcome = command("train", *SWEEP, cwd=tmp_path)
    assert outcome.returncode
    assert [line.partition("character=")[2].split()[0] for line in failures(outcome)] == ["ant", "ant", "biped"]
    for line, reason in zip(failures(outcome), ["no environment has", "no environment has", "became nan"], strict=True):
        assert reason in line
        log = line.partition(", see ")[2]
        assert "Traceback" in (tmp_path / log).read_text()
    (complete,) = (path for path in tmp_path.rglob("metrics.csv") if "lr-0.0001" in str(path))
    before = complete.stat().st_mtime_ns
    again = command("train", *SWEEP, cwd=tmp_path)
    assert "lr-0.0001_preset-smoke_training.total_frames-128_width-0.05/seed0 is complete" in again.stdout
    assert len(failures(again)) == 3
    assert complete.stat().st_mtime_ns == before


def test_the_folder_of_a_run_with_other_settings_is_refused_and_left_alone(command, tmp_path):
    arguments = ["--multirun", *RUNS[:-1], "autocast=false"]
    assert command("train", *arguments, cwd=tmp_path).returncode == 0
    outcome = command("train", *arguments[:-1], "autocast=true", cwd=tmp_path)
    assert outcome.returncode
    assert "holds a run that differs in autocast: give another run_root" in failures(outcome)[0]


def test_runs_from_other_networks_have_folders_of_their_own(command, tmp_path):
    pretraining = [*SMOKE, "task=holdout", "method=finetune", "training.total_frames=128"]
    for name, seed in (("a", 0), ("b", 1)):
        assert command("train", *pretraining, f"seed={seed}", f"run_dir={name}", cwd=tmp_path).returncode == 0
    sweep = ["--multirun", *pretraining, "stage=transfer", "pretrained=a,b"]
    outcome = command("train", *sweep, cwd=tmp_path)
    assert outcome.returncode == 0, outcome.stderr
    assert len(list(tmp_path.rglob("runs/holdout-ant/transfer/finetune/*/seed0/metrics.csv"))) == 2


@pytest.mark.slow
@pytest.mark.skipif(not find_spec("hydra_plugins"), reason="needs pip install 'torchrl-mcp[launchers]'")
def test_processes_list_their_failed_runs_at_the_end(tmp_path):
    words = ["-m", "torchrl_mcp.commands.train", *SWEEP, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    outcome = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True)
    assert outcome.returncode
    assert len(failures(outcome)) == 3
    assert len([path for path in tmp_path.rglob("metrics.csv") if "lr-0.0001" in str(path)]) == 1
