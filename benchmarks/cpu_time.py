"""Trains for a number of CPU seconds, so that other work on the machine does not distort comparisons of settings."""

import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from torchrl_mcp.envs.characters.contract import CONTROL_TIMESTEP
from torchrl_mcp.runs.provenance import processor_facts
from torchrl_mcp.training.run_folder import MODES, find_all, frames

EVALUATION_SEED = "777"
EPISODES = "128"

FIXED = (
    *("autocast=false", "logger=none", "progress_bar=false", "torch_threads=1", "num_threads=1", "keep_checkpoints=1"),
    *("evaluation.episodes=0", "training.total_frames=1_000_000_000"),
)
"""Settings of every training: one core, float32, and no end."""

TICKS = os.sysconf("SC_CLK_TCK")


class Training:
    """A training in a separate process, which stands still between the periods in which it may train.

    Args:
        words: Arguments of ``torchrl-mcp-train``.
        folder: The run folder.
    """

    def __init__(self, words: Sequence[str], folder: Path) -> None:
        self.folder = folder
        shutil.rmtree(folder, ignore_errors=True)  # remains of an interrupted trial
        folder.parent.mkdir(parents=True, exist_ok=True)
        self.log = folder.with_suffix(".log").open("w")
        program = Path(sys.executable).with_name("torchrl-mcp-train")
        self.command = [str(program), *words, *FIXED, f"run_dir={folder}"]
        self.process = subprocess.Popen(self.command, stdout=self.log, stderr=self.log)
        self.began = 0.0

    def train_to(self, seconds: float) -> float:
        """Train until the training has used ``seconds`` of CPU time in total, and return the CPU seconds used.

        Raises:
            ChildProcessError: If the training ends before.
        """
        self.process.send_signal(signal.SIGCONT)
        used = 0.0
        while used < seconds:
            time.sleep(1)
            if self.process.poll() is not None:
                raise ChildProcessError(f"{' '.join(self.command)} ended early, see {self.log.name}")
            if not (self.folder / "config.yaml").exists():
                self.began = cpu_seconds(self.process.pid)
            used = cpu_seconds(self.process.pid) - self.began
        self.process.send_signal(signal.SIGSTOP)
        return used

    def end(self) -> None:
        """End the process, and close its log."""
        self.process.kill()
        self.process.wait()
        self.log.close()


def cpu_seconds(pid: int) -> float:
    """Return the CPU seconds of a process with all its threads."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def scored(training: Training, seconds: float) -> dict[str, Any]:
    """Train until the training has used ``seconds`` of CPU time, evaluate the newest checkpoint, and return numbers."""
    used = training.train_to(seconds)
    output = training.folder / f"search-{seconds:.0f}.json"
    program = Path(sys.executable).with_name("torchrl-mcp-evaluate")
    words = [program, training.folder, "--episodes", EPISODES, "--seed", EVALUATION_SEED, "--output", output]
    subprocess.run([str(word) for word in words], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    evaluation = json.loads(output.read_text())
    row: dict[str, Any] = {"cpu_seconds": used}
    for mode in MODES:
        numbers = evaluation[mode]
        row |= {
            f"{mode}_return": round(numbers["normalised_return"], 4),
            f"{mode}_success": numbers["metrics"].get("success"),
            f"{mode}_success_seconds": round(CONTROL_TIMESTEP * numbers["durations"].get("success", 0), 3),
            f"{mode}_falls": numbers["terminated"],
        }
    row["steps"] = frames(find_all(training.folder)[0])
    row["score"] = mean(row[f"{mode}_return"] + (row[f"{mode}_success"] or 0) for mode in MODES)
    return row


def processor() -> str:
    """Return the name of the processor."""
    facts = processor_facts()
    family = f"family {facts.get('cpu family')} model {facts.get('model')}"
    return f"{facts.get('model name', platform.machine())} {family}"
