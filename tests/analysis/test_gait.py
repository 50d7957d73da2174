import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_mcp.analysis.gait import Feet, stride_phases, touch_downs
from torchrl_mcp.envs import Heading

PERIOD = 30


def walking(strides, duty=0.6, start=0):
    """Right and left foot of a walker whose right foot touches down at ``start`` and every 30 steps thereafter."""
    step = np.arange(strides * PERIOD) - start
    return np.stack([step % PERIOD < duty * PERIOD, (step + PERIOD // 2) % PERIOD < duty * PERIOD], -1)


def test_phases_count_from_touch_down_to_touch_down_of_the_right_foot():
    phases = stride_phases(walking(4, start=10))
    assert np.isnan(phases[:10]).all()
    assert np.isnan(phases[100:]).all()  # the last stride is not over
    np.testing.assert_allclose(phases[10:100], np.tile(np.arange(30) / 30, 3))


def test_a_foot_that_bounces_or_brushes_the_ground_touches_down_once():
    standing = walking(4, start=10)
    expected = stride_phases(standing)
    for step in (16, 17, 47, 75, 76, 77):  # bounces
        assert standing[step, 0]
        standing[step, 0] = False
    for step in (34, 63, 64):  # brushes
        assert not standing[step, 0]
        standing[step, 0] = True
    np.testing.assert_array_equal(stride_phases(standing), expected)


def test_touch_downs_are_where_standing_begins():
    foot = np.zeros(60, dtype=bool)
    foot[[*range(12), *range(25, 41), *range(52, 60)]] = True
    assert touch_downs(foot).tolist() == [25, 52]  # how long it has stood at first is not known


@pytest.mark.parametrize("left", [np.zeros(120, dtype=bool), np.arange(120) % 15 < 8], ids=["hopping", "tripping"])
def test_strides_in_which_the_left_foot_does_not_touch_down_once_are_none(left):
    standing = walking(4)
    standing[:, 1] = left
    assert np.isnan(stride_phases(standing)).all()


@pytest.mark.parametrize("character", ["biped", "humanoid", "trex"])
def test_feet_stand_where_they_are_within_millimetres_of_the_ground(character):
    env = Heading(character, num_envs=3, seed=0, num_threads=1)
    feet = Feet(env)
    model = env.simulation.model
    qpos = torch.from_numpy(model.qpos0).repeat(3, 1)
    qpos[1, 2] += 0.02
    # The right thigh forward by a radian: that foot is off the ground.
    hip = model.joint("right_hip").qposadr[0]
    qpos[2, hip : hip + 4] = torch.tensor([np.cos(0.5), 0.0, -np.sin(0.5), 0.0])
    env.reset(TensorDict({"qpos": qpos, "qvel": torch.zeros(3, model.nv)}, [3]), set_state=True)
    assert feet.standing().tolist() == [[True, True], [False, False], [False, True]]
