"""A folder of its own for each test, and states of the biped and its box, which tests of carrying share."""

import pytest
import torch

FRONT = 0.065  # half-thickness of the biped's torso, a box
HALF_SIZE = 0.15  # of the box


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs divergence in the working directory


@pytest.fixture
def ahead():
    """Make states in which the source with the box is ``gap`` in front of the biped's torso, the target far away."""

    def begin(env, gap):
        env.reset()
        state = env.get_state()
        place = torch.tensor([FRONT + gap + HALF_SIZE, 0.0])
        state["qpos"][:, -7:-5], state["mocap_pos"][:, 1, :2] = place, place
        state["mocap_pos"][:, 0, :2] = torch.tensor([-5.0, 0.0])
        state["qpos"][:, -4:] = state["mocap_quat"][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        return state

    return begin


@pytest.fixture
def holding(ahead):
    """Make states after the torso has taken the box."""

    def take(env):
        start = env.reset(ahead(env, -0.002), set_state=True)
        env.step(start.set("action", torch.zeros(env.action_spec.shape)))
        assert env.simulation.state["eq_active"].flatten().tolist() == [1.0] * env.num_envs
        return env.get_state()

    return take
