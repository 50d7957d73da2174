"""Methods in both stages with their networks on the stand-in: ``rehearsal.py METHOD...`` prints what came of it.

Physics stays on the CPU, as with a GPU. Pre-training is one iteration in float32, to be compared with the CPU's.
Transfer is two iterations in bfloat16, of which the second is done again from the checkpoint between them.
"""

import csv
import json
import sys
from collections import Counter
from contextlib import redirect_stdout
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from stand_in import NAME, Accelerator, PretendTensor, register
from torch.utils._python_dispatch import _disable_current_modes
from torchrl.checkpoint import Checkpoint
from torchrl.collectors import Collector

from torchrl_mcp.runs import experiment, policies
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.training import checkpoint
from torchrl_mcp.training.collectors import LocalSource
from torchrl_mcp.training.trainer import Trainer
from torchrl_mcp.training.update import Update

SETTINGS = [
    *("preset=smoke", "logger=none", "num_threads=1", "progress_bar=false", "character=biped"),
    *("training.frames_per_batch=32", "training.minibatch_size=16", "training.num_epochs=3"),
]
"""Eight steps of four environments and six gradient steps per iteration."""
SECTIONS = {"collect": (LocalSource, "collect"), "update": (Update, "learn"), "save": (Trainer, "save")}


def main():
    """Rehearse the methods of the command line."""
    kept = register()
    allow_the_stand_in()
    waits = count_by_section()
    with redirect_stdout(sys.stderr):
        found = {method: rehearse(method, waits) for method in sys.argv[1:]}
        found["planted"] = plant()
    print(json.dumps(found))
    del kept


def rehearse(method, waits):
    """Return the metrics of a method on the CPU and on the stand-in, and the waits of each stage by section."""
    motions = "turning" if method == "hierarchical" else "single"
    pretraining = ["task=imitation", "stage=pretrain", f"motions={motions}", "autocast=false"]
    transfer = ["task=heading", "stage=transfer", "autocast=true", "checkpoint_interval=1"]
    with TemporaryDirectory() as name:
        folder, found = Path(name), {}
        if method != "scratch":
            found["cpu"] = rows(train(folder / "cpu", method, "device=cpu", *pretraining))
            waits.clear()
            with Accelerator():
                found["pretrain"] = rows(train(folder / "pretrain", method, f"device={NAME}", *pretraining))
            found["waits of pretrain"] = dict(waits)
            transfer.append(f"pretrained={folder / 'pretrain'}")
        waits.clear()
        with Accelerator():
            run = train(folder / "transfer", method, f"device={NAME}", *transfer)
            found["waits of transfer"] = dict(waits)
            found["transfer"] = rows(run)
            checkpoint.find(run).unlink()
            experiment.resume(run)
            found["resumed"] = rows(run)
        found["evaluation"] = policies.evaluation(run, episodes=2, seed=0, max_episode_steps=3)
    return found


def plant():
    """Return what is said of a network of which one tensor was left on the CPU."""
    layer = torch.nn.Linear(3, 3).to(NAME)
    layer.bias = torch.nn.Parameter(torch.zeros(3))
    try:
        return str(layer(torch.zeros(2, 3, device=NAME)))
    except RuntimeError as error:
        return str(error)


def train(folder, method, *overrides):
    """Train for one iteration of pre-training or two of transfer."""
    settings = [f"method={method}", f"run_dir={folder}", *SETTINGS, *overrides]
    cfg = compose_run(*settings)
    iterations = 2 if cfg.stage.name == "transfer" else 1
    cfg.training.total_frames = iterations * cfg.training.frames_per_batch * cfg.get("batch_factor", 1)
    return experiment.train(cfg)


def rows(folder):
    """Return what a run recorded, save times."""
    with (folder / "metrics.csv").open(newline="") as file:
        lines = csv.DictReader(file)
        return [{k: float(v) for k, v in row.items() if not k.startswith(("seconds", "time/"))} for row in lines]


def count_by_section():
    """Return a counter of what the processor waits for, by ``SECTIONS`` of the loop, and ``other``."""
    waits, section = Counter(), ["other"]

    def watch(owner, name, label):
        method = getattr(owner, name)

        @wraps(method)
        def watched(*args, **kwargs):
            outer, section[0] = section[0], label
            try:
                return method(*args, **kwargs)
            finally:
                section[0] = outer

        setattr(owner, name, watched)

    for label, (owner, name) in SECTIONS.items():
        watch(owner, name, label)
    PretendTensor.on_wait = staticmethod(lambda operation: waits.update([section[0]]))
    return waits


def allow_the_stand_in():
    """Let torch and TorchRL do for the stand-in what they do for the devices that they know by name."""
    torch.accelerator.synchronize = lambda device: None
    Collector._get_sync_fn = lambda collector, device: lambda: None
    for name in ("save", "load"):  # files are mapped to memory, which is the CPU's business
        setattr(Checkpoint, name, without_modes(getattr(Checkpoint, name)))


def without_modes(method):
    """Return a method that runs without dispatch modes."""

    @wraps(method)
    def plain(*args, **kwargs):
        with _disable_current_modes():
            return method(*args, **kwargs)

    return plain


if __name__ == "__main__":
    main()
