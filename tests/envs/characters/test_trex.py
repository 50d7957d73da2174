import copy

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from torchrl_mcp.envs.characters import TREX

BALL, HINGE = mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_HINGE
LEG = ("hip", "knee", "ankle", "toe")


@pytest.fixture(scope="module")
def model():
    spec = TREX.spec()
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1)
    return spec.compile()


@pytest.fixture
def data(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def touching(model, data):
    """Names of the bodies on the floor."""
    return {model.body(body).name for body in model.geom_bodyid[data.contact.geom].flat} - {"world"}


def stand(model, seconds, push=(0.0, 0.0)):
    """Hold the rest pose as the target, after a push in m/s; what has touched the floor by the end."""
    data, touched = mujoco.MjData(model), set()
    data.qvel[:2] = push
    for _ in range(round(seconds / model.opt.timestep)):
        mujoco.mj_step(model, data)
        touched |= touching(model, data)
    return data, touched


def test_fifteen_joints_are_balls_and_knees_and_ankles_are_hinges(model):
    hinges = {model.joint(index).name for index in np.flatnonzero(model.jnt_type == HINGE)}
    assert hinges == {"right_knee", "right_ankle", "left_knee", "left_ankle"}
    assert (model.jnt_type == BALL).sum() == 15


def test_its_centre_of_mass_is_well_within_its_soles(model):
    data = mujoco.MjData(model)
    data.qpos[2] -= 0.001
    mujoco.mj_forward(model, data)
    soles = ConvexHull(data.contact.pos[:, :2])
    distances = -(soles.equations[:, :2] @ data.subtree_com[1][:2] + soles.equations[:, 2])
    assert distances.min() > 0.05


def test_the_tail_has_its_share_of_the_mass_and_balances_the_front(model, data):
    tail, chest = (model.body(name).id for name in ("tail_1", "chest"))
    assert 0.15 < model.body_subtreemass[tail] / model.body_subtreemass[1] < 0.2
    hips = data.body("right_hip").xpos[0]
    behind, ahead = (model.body_subtreemass[part] * (data.subtree_com[part][0] - hips) for part in (tail, chest))
    assert -1 < behind / ahead < -0.5


def test_the_tail_is_half_of_its_length(model, data):
    ends = data.geom_xpos[:, 0]
    length = ends.max() - ends.min()
    assert 0.45 < (data.body("tail_1").xpos[0] - ends.min()) / length < 0.65


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_legs_stand_on_their_toes(data, side):
    hip, knee, ankle, toe = (data.body(f"{side}_{joint}").xpos for joint in LEG)
    assert knee[0] - hip[0] > 0.1
    assert knee[0] - ankle[0] > 0.1
    assert toe[0] - ankle[0] > 0.03
    assert (np.diff([hip[2], knee[2], ankle[2], toe[2]]) < -0.2).all()
    assert ankle[2] > 0.25


def test_three_toes_touch_the_ground_with_each_foot(model):
    data = mujoco.MjData(model)
    data.qpos[2] -= 0.001
    mujoco.mj_forward(model, data)
    geoms = {model.geom(geom).name for geom in data.contact.geom[:, 1]}
    assert geoms == {f"{side}_{toe}" for side in ("right", "left") for toe in ("inner_toe", "toe", "outer_toe")}


def test_the_head_is_large_and_the_arms_are_small(model, data):
    legs, arms = (model.body_subtreemass[model.body(f"right_{part}").id] for part in ("hip", "shoulder"))
    assert model.body("head").mass[0] > 5 * arms
    assert legs > 10 * arms
    assert data.body("head").xpos[2] > data.body("root").xpos[2] + 0.4


def test_decoration_does_not_reach_into_the_ground(model, data):
    floor = model.geom("floor").id
    drawn = set(range(model.ngeom)) - {floor} - set(np.flatnonzero(model.geom_conaffinity))
    assert drawn
    assert all(mujoco.mj_geomDistance(model, data, floor, geom, 9, None) > -1e-9 for geom in drawn)


def test_it_stands_when_told_to_hold_the_rest_pose(model):
    data, touched = stand(model, 5.0)
    assert touched == set(TREX.feet)
    np.testing.assert_allclose(data.qpos[:3], model.qpos0[:3], atol=0.05)
    assert np.abs(data.qvel).max() < 0.2


@pytest.mark.parametrize("push", [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.1)])
def test_it_withstands_a_push(model, push):
    _, touched = stand(model, 4.0, push)
    assert touched == set(TREX.feet)


def test_at_its_time_step_it_stands_like_at_a_much_shorter_one(model):
    coarse, _ = stand(model, 2.0)
    shorter = copy.copy(model)
    shorter.opt.timestep = 0.001
    fine, _ = stand(shorter, 2.0)
    np.testing.assert_allclose(coarse.qpos, fine.qpos, atol=0.005)
