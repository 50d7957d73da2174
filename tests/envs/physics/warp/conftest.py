from importlib.util import find_spec
from unittest.mock import patch

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Imitation
from torchrl_mcp.envs.characters import ant
from torchrl_mcp.envs.motions import generated_library
from torchrl_mcp.envs.tasks import holdout

NUM_ENVS = 8
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
"""Of MuJoCo Warp; MuJoCo's threads stay on the CPU."""
TASKS = {"heading": Heading, "carry": Carry, "dribble": Dribble}
TERMS = {"bodies": {"weight": 0.5, "scale": 10.0}, "velocity": {"weight": 0.5, "scale": 0.1}}


@pytest.fixture(scope="session", autouse=True)
def _needs_warp():
    pytest.importorskip("mujoco_warp", reason="needs MuJoCo Warp: pip install 'torchrl-mcp[warp]'")


def _make(scene, character="biped", num_envs=NUM_ENVS, **kwargs):
    kwargs = {"seed": 0, "num_threads": 1, **kwargs}
    if kwargs.get("physics") == "warp":
        kwargs["device"] = DEVICE
    if scene == "holdout":
        cone = kwargs.pop("friction_cone", "pyramidal")
        with patch.object(holdout, "ant", lambda: _with_cone(ant(), cone)):
            return Holdout(num_envs, (0.0, 6.0), **kwargs)
    if scene == "imitation":
        return Imitation(character, generated_library(character, seed=0), num_envs, terms=TERMS, **kwargs)
    return TASKS[scene](character, num_envs, **kwargs)


def _with_cone(spec, cone):
    spec.option.cone = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}[cone]
    return spec


@pytest.fixture(scope="session")
def make():
    """Makes environments of a scene, by either engine."""
    return _make


@pytest.fixture(scope="session")
def actions():
    """Draws random actions."""
    return lambda env, num, scale=0.3, seed=1: (
        scale * (2 * torch.rand(num, *env.action_spec.shape, generator=torch.Generator().manual_seed(seed)) - 1)
    ).to(env.device)


@pytest.fixture(scope="session")
def held():
    """Makes states of carrying in which every character holds its box at another pose, ``height`` metres up."""

    def take(env, height=0.0, seed=0):
        env.reset()
        state, drawn = env.get_state(), np.random.default_rng(seed)
        state["qpos"][:, [2, -5]] += height
        env.reset(state, set_state=True)
        for index, row in enumerate(state["qpos"].numpy()):
            carrier = env.simulation.data(index).body(env.character.carrier)
            place, turn = drawn.uniform(0.2, 0.4, 3), drawn.normal(size=4)
            turn /= np.linalg.norm(turn)
            mujoco.mju_mulPose(row[-7:-4], row[-4:], carrier.xpos, carrier.xquat, place, turn)
            state["eq_data"][index, 0, 3:10] = torch.from_numpy(np.concatenate([place, turn]))
        state["eq_active"][:], state["taken"][:] = 1, 1
        return state

    return take


# It imports the extra; the other tests skip without it.
collect_ignore = [] if find_spec("mujoco_warp") else ["test_simulation.py"]
