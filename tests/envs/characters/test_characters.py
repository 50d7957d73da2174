"""What a character is: the sizes of Table 3, names and axes, shapes, limits and gains, symmetry, collision."""

import re
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters import CHARACTERS

BALL, HINGE, FREE = mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_FREE
PRIMITIVES = {mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX}


class Properties(NamedTuple):
    """Degrees of freedom, actions, bodies, mass in kg and height in m."""

    nv: int
    nu: int
    bodies: int
    mass: float
    height: float


# Table 3 of the paper; the number of bodies follows from its size of the state, 13 a body and 1.
TABLE_3 = {
    "biped": Properties(23, 17, 8, 42.0, 1.34),
    "humanoid": Properties(34, 28, 15, 45.0, 1.62),
    "trex": Properties(55, 49, 20, 54.5, 1.66),
}

BODIES = {
    "biped": "root torso right_hip right_knee right_ankle left_hip left_knee left_ankle",
    "humanoid": "root chest neck right_shoulder right_elbow right_wrist left_shoulder left_elbow left_wrist "
    "right_hip right_knee right_ankle left_hip left_knee left_ankle",
}


def planes(model):
    return model.geom("floor").id, model.geom("ceiling").id


def at_rest(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def swapped(name):
    """Name of the other side."""
    return re.sub("right|left", lambda side: {"right": "left", "left": "right"}[side[0]], name)


def inertia(model, data, body):
    """Inertia tensor about the body's centre of mass in the world's axes, 3 x 3."""
    axes = data.ximat[body].reshape(3, 3)
    return axes @ np.diag(model.body_inertia[body]) @ axes.T


def test_counts_and_mass_are_those_of_the_papers_table_3(character):
    model, paper = character.spec().compile(), TABLE_3[character.name]
    assert (model.nv, model.nu, model.nbody - 1) == paper[:3]
    assert model.body_mass.sum() == pytest.approx(paper.mass, abs=1e-9)


def test_it_stands_on_the_ground_as_high_as_table_3_says(character, scene):
    model = scene(character)
    data = at_rest(model)
    parts = np.flatnonzero((model.geom_bodyid > 0) & (model.geom_conaffinity == 1))
    gaps = [min(mujoco.mj_geomDistance(model, data, plane, part, 9, None) for part in parts) for plane in planes(model)]
    assert gaps[0] == pytest.approx(0, abs=1e-9)
    assert 9 - gaps[1] == pytest.approx(TABLE_3[character.name].height, abs=0.005)


def test_both_feet_and_nothing_else_touch_the_ground(character, scene):
    model = scene(character)
    data = mujoco.MjData(model)
    data.qpos[2] -= 0.001
    mujoco.mj_forward(model, data)
    touching = {model.body(model.geom_bodyid[geom]).name for geom in data.contact.geom[:, 1]}
    assert touching == set(character.feet)


def test_every_body_hangs_at_a_joint_of_its_name_or_is_welded(character, joints):
    model = character.spec().compile()
    assert model.joint("root").type == FREE
    for joint in joints(model):
        assert joint.name == model.body(joint.bodyid[0]).name
        assert model.jnt_type[joint.id] in {int(BALL), int(HINGE)}
    assert model.body_jntnum.max() == 1


def test_every_joint_has_actuators_of_its_name(character, joints, actuators):
    model = character.spec().compile()
    for joint in joints(model):
        mine = actuators(model, joint)
        names, gears = [model.actuator(index).name for index in mine], model.actuator_gear[mine]
        if joint.type == HINGE:
            assert names == [joint.name]
            assert gears.tolist() == [[1, 0, 0, 0, 0, 0]]
        else:
            assert names == [f"{joint.name}_{axis}" for axis in "xyz"]
            assert gears.tolist() == np.eye(3, 6).tolist()


@pytest.mark.parametrize("name", BODIES)
def test_bodies_have_the_names_and_the_order_of_motion_data(name):
    model = CHARACTERS[name].spec().compile()
    assert [model.body(index).name for index in range(1, model.nbody)] == BODIES[name].split()


def test_named_bodies_exist(character):
    model = character.spec().compile()
    for name in {*character.feet, *character.key_bodies, character.carrier} - {None}:
        assert model.body(name).id > 0


def test_frames_are_parallel_to_the_world_in_the_rest_pose(character):
    data = at_rest(character.spec().compile())
    np.testing.assert_allclose(data.xquat, np.eye(1, 4).repeat(len(data.xquat), 0), atol=1e-12)


def test_shapes_are_primitives_with_names_that_only_meet_the_scene(character):
    spec = character.spec()
    assert spec.compile().nmesh == 0
    for geom in spec.geoms:
        assert geom.name
        assert geom.contype == 0
        if geom.conaffinity:
            assert geom.type in PRIMITIVES
        else:
            assert geom.mass == 0


def test_targets_reach_beyond_the_limits(character, joints, actuators):
    model = character.spec().compile()
    for joint in joints(model):
        low, high = joint.range
        middle, half = (low + high) / 2, (high - low) / 2
        expected = [-1.2 * high, 1.2 * high] if joint.type == BALL else [middle - 1.4 * half, middle + 1.4 * half]
        for bounds in model.actuator_ctrlrange[actuators(model, joint)]:
            np.testing.assert_allclose(bounds, expected, atol=1e-3)


def test_the_dampings_of_motor_and_joint_add_up_to_a_tenth_of_the_stiffness(character, joints, actuators):
    model = character.spec().compile()
    for joint in joints(model):
        for index in actuators(model, joint):
            stiffness, damping = model.actuator_gainprm[index, 0], -model.actuator_biasprm[index, 2]
            assert damping + joint.damping[0] == pytest.approx(0.1 * stiffness)


def test_right_and_left_mirror_each_other(character, joints, actuators):
    model = character.spec().compile()
    data, mirror = at_rest(model), np.diag([1.0, -1.0, 1.0])
    for index in range(1, model.nbody):
        other = model.body(swapped(model.body(index).name)).id
        assert model.body_mass[index] == model.body_mass[other]
        np.testing.assert_allclose(mirror @ data.xpos[index], data.xpos[other], atol=1e-12)
        np.testing.assert_allclose(mirror @ data.xipos[index], data.xipos[other], atol=1e-12)
        mirrored = mirror @ inertia(model, data, index) @ mirror
        np.testing.assert_allclose(mirrored, inertia(model, data, other), atol=1e-9)
    for joint in joints(model):
        other = model.joint(swapped(joint.name))
        np.testing.assert_array_equal(joint.range, other.range)
        for field in (model.actuator_gainprm, model.actuator_biasprm, model.actuator_forcerange):
            np.testing.assert_array_equal(field[actuators(model, joint)], field[actuators(model, other)])


@pytest.mark.parametrize("self_collision", [False, True])
def test_bodies_that_no_joint_connects_collide_if_asked_to(character, self_collision, joints):
    model, generator = character.spec(self_collision=self_collision).compile(), np.random.default_rng(0)
    data, touching = mujoco.MjData(model), []
    for _ in range(30):
        for joint in joints(model):
            if joint.type == BALL:
                quat = Rotation.from_rotvec(generator.normal(0, 1, 3)).as_quat(scalar_first=True)
                data.joint(joint.id).qpos[:] = quat
        mujoco.mj_forward(model, data)
        touching += model.geom_bodyid[data.contact.geom].tolist()
    assert bool(touching) == self_collision
    assert all(model.body_parentid[second] != first for first, second in touching)


def test_at_rest_it_does_not_touch_itself(character):
    model = character.spec(self_collision=True).compile()
    assert at_rest(model).ncon == 0
