import tempfile

import pytest
import torch
from torch import nn

from torchrl_mcp.modules import RunningNormaliser
from torchrl_mcp.training.checkpoint import rotation, run_checkpoint


@pytest.fixture(scope="session")
def make_parts():
    """Small parts of an agent, the same for the same seed."""

    def make_parts(seed=0, *, goal_dim=2):
        torch.manual_seed(seed)
        return nn.ModuleDict(
            {
                "observation_normaliser": RunningNormaliser(3),
                "gating": nn.Sequential(nn.Linear(goal_dim, 4), nn.ReLU(), nn.Linear(4, 2)),
                "primitives": nn.Linear(3, 2),
            }
        )

    return make_parts


@pytest.fixture(scope="session")
def same_numbers():
    """Whether two modules have equal parameters and buffers."""

    def same_numbers(first, second):
        first, second = first.state_dict(), second.state_dict()
        return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)

    return same_numbers


@pytest.fixture(scope="session")
def config():
    """The configuration that checkpoints hold."""
    return {"method": {"name": "mcp"}, "seed": 3}


@pytest.fixture
def saved_run(tmp_path, monkeypatch, make_parts, config):
    """A run folder with one checkpoint, beside an empty folder for temporary files."""
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "metrics.csv").write_text("iteration\n1\n")
    rotation(folder, keep_last=2).save(run_checkpoint(make_parts()), step=128, metadata={"config": config})
    return folder
