import csv
import json
from functools import partial

import pytest
from omegaconf import OmegaConf

MACHINE = {"processor": "Abacus", "cores": 2, "device": "cpu", "python": "3.11", "torch": "2.13", "mujoco": "3.17"}


def numbers(value, diagnostics):
    """What an evaluation says of one mode."""
    interval = [value - 0.02, value + 0.02]
    episodes = {"return": 600 * value, "length": 450.0, "terminated": 0.25, "episodes": 128}
    return {"normalised_return": value, "interval": interval, "metrics": {}, "diagnostics": diagnostics} | episodes


PAPERS_MCP = {
    "num_primitives": 8,
    "mixer__name": "multiplicative",
    "exploration__name": "action",
    "transfer__keep": ["primitives", "observation_normaliser"],
    "transfer__freeze": ["primitives", "observation_normaliser"],
}


def write(
    root,
    name,
    *,
    method="scratch",
    task="heading",
    character="biped",
    stage="transfer",
    seed=0,
    score=None,
    progress=1.0,
    total_frames=1000,
    commit="abc1234",
    preset="fast",
    diagnostics=(),
    episodes=128,
    **settings,
):
    folder = root / name
    folder.mkdir(parents=True)
    cfg = OmegaConf.create({"seed": seed, "run_dir": str(folder), "training": {"total_frames": total_frames}})
    for group, choice in {"task": task, "character": character, "stage": stage, "method": method}.items():
        cfg[group] = {"name": choice}
    for key, value in settings.items():
        OmegaConf.update(cfg, key.replace("__", "."), value)
    OmegaConf.save(cfg, folder / "config.yaml")
    frames = [round(total_frames * progress * step / 10) for step in range(1, 11)] if progress else []
    rows = [(i, x, x / 100, 1, 0.5) for i, x in enumerate(frames, start=1)]
    with (folder / "metrics.csv").open("w", newline="") as file:
        columns = ["iteration", "frames", "seconds", "episode/count", "episode/normalised_return"]
        csv.writer(file).writerows([columns, *rows] if rows else [])
    if preset:
        origin = {"commit": commit, "choices": {"preset": preset}, "machine": MACHINE}
        (folder / "origin.json").write_text(json.dumps(origin))
    if score is not None:
        modes = {"deterministic": score, "stochastic": score - 0.1}
        found = {mode: numbers(value, dict(diagnostics)) for mode, value in modes.items()}
        (folder / "evaluation.json").write_text(json.dumps({"episodes": episodes, "seed": 12345, **found}))
    return folder


@pytest.fixture(scope="session")
def run_writers():
    """Of a folder, what writes runs into it: of any method, and of MCP with the paper's settings by default.

    Of scores, the deterministic is given and the stochastic 0.1 lower.
    """

    def write_mcp(root, name, **settings):
        return write(root, name, **{"method": "mcp"} | PAPERS_MCP | settings)

    return lambda root: (partial(write, root), partial(write_mcp, root))


@pytest.fixture
def write_run(run_writers, tmp_path):
    return run_writers(tmp_path / "runs")[0]


@pytest.fixture
def write_mcp(run_writers, tmp_path):
    return run_writers(tmp_path / "runs")[1]
