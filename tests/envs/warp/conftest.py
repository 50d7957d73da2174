from importlib.util import find_spec

import pytest
import torch

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Imitation, generated_library

NUM_ENVS = 8
TASKS = {"heading": Heading, "carry": Carry, "dribble": Dribble}
TERMS = {"bodies": {"weight": 0.5, "scale": 10.0}, "velocity": {"weight": 0.5, "scale": 0.1}}


@pytest.fixture(scope="session", autouse=True)
def _needs_warp():
    pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")


def _make(scene, character="biped", num_envs=NUM_ENVS, **kwargs):
    kwargs = {"seed": 0, "num_threads": 1, **kwargs}
    if scene == "holdout":
        return Holdout(num_envs, (0.0, 6.0), **kwargs)
    if scene == "imitation":
        return Imitation(character, generated_library(character, seed=0), num_envs, terms=TERMS, **kwargs)
    return TASKS[scene](character, num_envs, **kwargs)


@pytest.fixture(scope="session")
def make():
    """Makes environments of a scene, by either engine."""
    return _make


@pytest.fixture(scope="session")
def actions():
    """Draws random actions."""
    return lambda env, num, scale=0.3, seed=1: (
        scale * (2 * torch.rand(num, *env.action_spec.shape, generator=torch.Generator().manual_seed(seed)) - 1)
    )


collect_ignore = [] if find_spec("mujoco_warp") else ["test_simulation.py", "test_parity.py"]
