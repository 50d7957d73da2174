import json
import re
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.simulation import Simulation

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

SOURCES = {"biped": "biped/biped3d_mocap_character.txt", "humanoid": "deepmimic/humanoid3d_character.txt"}

every_character = pytest.mark.parametrize("character", CHARACTERS.values(), ids=lambda character: character.name)


def scene(character, **options):
    """The character with a floor at z = 0 and a ceiling, which it cannot reach, at z = 9."""
    spec = character.spec(**options)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="floor", type=plane, size=[0, 0, 1], contype=1)
    spec.worldbody.add_geom(name="ceiling", type=plane, size=[0, 0, 1], pos=[0, 0, 9], zaxis=[0, 0, -1], contype=1)
    return spec.compile()


def planes(model):
    return model.geom("floor").id, model.geom("ceiling").id


def floating(character):
    """The character in free space: without gravity, contact or a fixed root, so that only its inertia resists."""
    model = character.spec().compile()
    model.opt.gravity[:] = 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model


def at_rest(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


def joints(model):
    """Joints but the root's."""
    return [model.joint(index) for index in range(model.njnt) if model.jnt_type[index] != FREE]


def actuators(model, joint):
    return np.flatnonzero(model.actuator_trnid[:, 0] == joint.id)


def rotations(model, data):
    """Orientation of every body in its parent's frame, from MuJoCo's world orientations."""
    world = Rotation.from_quat(data.xquat, scalar_first=True)
    return world[model.body_parentid].inv() * world


def reach(joint):
    """Targets to try, within the limits and up to 2 rad: in the direction of each axis and diagonal of a ball joint."""
    if joint.type == HINGE:
        low, high = joint.range
        return [[max(-2.0, low + 0.05)], [min(2.0, high - 0.05)]]
    directions = np.array(
        [direction for direction in product((-1, 0, 1), repeat=3) if sum(map(abs, direction)) in (1, 3)]
    )
    return min(2.0, joint.range[1] - 0.05) * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def swapped(name):
    """Name of the other side."""
    return re.sub("right|left", lambda side: {"right": "left", "left": "right"}[side[0]], name)


def inertia(model, data, body):
    """Inertia tensor about the body's centre of mass in the world's axes, 3 x 3."""
    axes = data.ximat[body].reshape(3, 3)
    return axes @ np.diag(model.body_inertia[body]) @ axes.T


def character_file(mocap, name):
    """The published character's joints and bodies by name; the file has commas that JSON does not allow."""
    text = re.sub(r",(\s*[}\]])", r"\1", (mocap / SOURCES[name]).read_text())
    content = json.loads(text)
    skeleton = {joint["Name"]: joint for joint in content["Skeleton"]["Joints"]}
    return skeleton, {body["Name"]: body for body in content["BodyDefs"]}


def our_axes(x, y, z):
    """From x forward, y up, z right to x forward, y left, z up."""
    return [x, -z, y]


@every_character
def test_counts_and_mass_are_those_of_the_papers_table_3(character):
    model, paper = character.spec().compile(), TABLE_3[character.name]
    assert (model.nv, model.nu, model.nbody - 1) == paper[:3]
    assert model.body_mass.sum() == pytest.approx(paper.mass, abs=1e-9)


@every_character
def test_it_stands_on_the_ground_as_high_as_table_3_says(character):
    model = scene(character)
    data = at_rest(model)
    parts = np.flatnonzero((model.geom_bodyid > 0) & (model.geom_conaffinity == 1))
    gaps = [min(mujoco.mj_geomDistance(model, data, plane, part, 9, None) for part in parts) for plane in planes(model)]
    assert gaps[0] == pytest.approx(0, abs=1e-9)
    assert 9 - gaps[1] == pytest.approx(TABLE_3[character.name].height, abs=0.005)


@every_character
def test_both_feet_and_nothing_else_touch_the_ground(character):
    model = scene(character)
    data = mujoco.MjData(model)
    data.qpos[2] -= 0.001
    mujoco.mj_forward(model, data)
    touching = {model.body(model.geom_bodyid[geom]).name for geom in data.contact.geom[:, 1]}
    assert touching == set(character.feet)


@every_character
def test_every_body_hangs_at_a_joint_of_its_name_or_is_welded(character):
    model = character.spec().compile()
    assert model.joint("root").type == FREE
    for joint in joints(model):
        assert joint.name == model.body(joint.bodyid[0]).name
        assert model.jnt_type[joint.id] in {int(BALL), int(HINGE)}
    assert model.body_jntnum.max() == 1


@every_character
def test_every_joint_has_actuators_of_its_name(character):
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


@every_character
def test_named_bodies_exist(character):
    model = character.spec().compile()
    for name in {*character.feet, *character.key_bodies, character.carrier} - {None}:
        assert model.body(name).id > 0


@every_character
def test_frames_are_parallel_to_the_world_in_the_rest_pose(character):
    data = at_rest(character.spec().compile())
    np.testing.assert_allclose(data.xquat, np.eye(1, 4).repeat(len(data.xquat), 0), atol=1e-12)


@every_character
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


@every_character
def test_targets_reach_beyond_the_limits(character):
    model = character.spec().compile()
    for joint in joints(model):
        low, high = joint.range
        middle, half = (low + high) / 2, (high - low) / 2
        expected = [-1.2 * high, 1.2 * high] if joint.type == BALL else [middle - 1.4 * half, middle + 1.4 * half]
        for bounds in model.actuator_ctrlrange[actuators(model, joint)]:
            np.testing.assert_allclose(bounds, expected, atol=1e-3)


@every_character
def test_the_dampings_of_motor_and_joint_add_up_to_a_tenth_of_the_stiffness(character):
    model = character.spec().compile()
    for joint in joints(model):
        for index in actuators(model, joint):
            stiffness, damping = model.actuator_gainprm[index, 0], -model.actuator_biasprm[index, 2]
            assert damping + joint.damping[0] == pytest.approx(0.1 * stiffness)


@every_character
def test_right_and_left_mirror_each_other(character):
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


@every_character
def test_all_joints_at_once_reach_targets_in_every_direction_within_a_second(character):
    model = floating(character)
    for turn in range(14):
        data, expected = mujoco.MjData(model), np.zeros((model.nbody, 3))
        for joint in joints(model):
            targets = reach(joint)
            target = targets[(turn + joint.id) % len(targets)]
            data.ctrl[actuators(model, joint)] = target
            # Hinges turn about -y: a knee bends by negative, an elbow by positive angles.
            expected[joint.bodyid] = target if joint.type == BALL else [0, -target[0], 0]
        mujoco.mj_step(model, data, nstep=round(1 / model.opt.timestep))
        mujoco.mj_kinematics(model, data)
        errors = (rotations(model, data).inv() * Rotation.from_rotvec(expected)).magnitude()
        errors[1] = 0  # the free root answers the limbs' motion
        np.testing.assert_array_less(errors, 0.02)


@every_character
def test_zero_is_the_target_of_the_rest_pose(character):
    model = floating(character)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=500)
    np.testing.assert_allclose(data.qpos, model.qpos0, atol=1e-9)


@every_character
def test_in_free_space_it_returns_to_the_rest_pose_without_drifting(character):
    model, generator = floating(character), np.random.default_rng(0)
    data = mujoco.MjData(model)
    for joint in joints(model):
        if joint.type == BALL:
            data.joint(joint.id).qpos[:] = Rotation.from_rotvec(generator.normal(0, 0.2, 3)).as_quat(scalar_first=True)
        else:
            data.joint(joint.id).qpos[:] = np.clip(generator.normal(0, 0.2), *joint.range)
    mujoco.mj_forward(model, data)
    before = data.subtree_com[1].copy()
    mujoco.mj_step(model, data, nstep=round(2 / model.opt.timestep))
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qpos[7:], model.qpos0[7:], atol=1e-3)
    # Internal forces move no centre of mass; what remains is the time step's.
    np.testing.assert_allclose(data.subtree_com[1], before, atol=0.01)
    assert np.abs(data.qvel).max() < 0.02


@every_character
def test_it_stands_for_a_second_without_control(character):
    model = scene(character)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(1 / model.opt.timestep))
    assert data.qpos[2] == pytest.approx(model.qpos0[2], abs=0.02)
    assert rotations(model, data).magnitude().max() < 0.1
    assert np.abs(data.qvel).max() < 0.5


@pytest.mark.parametrize("push", [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.1)])
def test_the_biped_withstands_a_push(push):
    model = scene(CHARACTERS["biped"])
    data = mujoco.MjData(model)
    data.qvel[:2] = push
    mujoco.mj_step(model, data, nstep=round(4 / model.opt.timestep))
    assert data.qpos[2] == pytest.approx(model.qpos0[2], abs=0.002)
    assert np.abs(data.qvel).max() < 0.01


@every_character
@pytest.mark.parametrize("height", [0.0, 1.0])
def test_random_actions_do_not_make_it_diverge(character, height):
    model = scene(character)
    simulation = Simulation(model, 32, substeps=4, num_threads=1)
    qpos = torch.tensor(model.qpos0).repeat(32, 1)
    qpos[:, 2] += height
    simulation.reset(torch.arange(32), {"qpos": qpos})
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(model.actuator_ctrlrange).unbind(-1)
    for _ in range(45):
        faults = simulation.step(low + (high - low) * torch.rand(32, model.nu, generator=generator))
        assert len(faults) == 0
        assert simulation.state["qvel"].abs().max() < 60


@every_character
@pytest.mark.parametrize("self_collision", [False, True])
def test_bodies_that_no_joint_connects_collide_if_asked_to(character, self_collision):
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


@every_character
def test_at_rest_it_does_not_touch_itself(character):
    model = character.spec(self_collision=True).compile()
    assert at_rest(model).ncon == 0


@pytest.mark.parametrize("name", SOURCES)
def test_masses_offsets_and_torques_are_those_of_the_published_character(mocap, name):
    skeleton, bodies = character_file(mocap, name)
    model = CHARACTERS[name].spec().compile()
    for body, published in bodies.items():
        assert model.body(body).mass[0] == published["Mass"]
    for index in range(2, model.nbody):
        body = model.body(index)
        offset = our_axes(*(skeleton[body.name][f"Attach{axis}"] for axis in "XYZ"))
        np.testing.assert_allclose(body.pos, offset, atol=1e-9)
    for joint in joints(model):
        torques = model.actuator_forcerange[actuators(model, joint)]
        np.testing.assert_array_equal(np.abs(torques), skeleton[joint.name]["TorqueLim"])


@pytest.mark.parametrize("name", SOURCES)
def test_limits_are_those_of_the_published_character(mocap, name):
    skeleton, _ = character_file(mocap, name)
    model = CHARACTERS[name].spec().compile()
    for joint in joints(model):
        published = skeleton[joint.name]
        if joint.type == HINGE:
            assert joint.range.tolist() == [published["LimLow0"], published["LimHigh0"]]
        else:
            largest = max(abs(published[f"Lim{end}{axis}"]) for end, axis in product(("Low", "High"), range(3)))
            # The shoulders keep away from pi, where rotation vectors jump.
            assert joint.range[1] == (2.8 if "shoulder" in joint.name else largest)
