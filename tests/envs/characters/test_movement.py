"""How a character moves: it reaches its targets, stands, withstands a push and does not diverge."""

from itertools import product

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.physics.batch import BatchSimulation

BALL, HINGE = mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_HINGE


def floating(character):
    """The character in free space: without gravity, contact or a fixed root, so that only its inertia resists."""
    model = character.spec().compile()
    model.opt.gravity[:] = 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model


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


def test_all_joints_at_once_reach_targets_in_every_direction_within_a_second(character, joints, actuators):
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


def test_zero_is_the_target_of_the_rest_pose(character):
    model = floating(character)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=500)
    np.testing.assert_allclose(data.qpos, model.qpos0, atol=1e-9)


def test_in_free_space_it_returns_to_the_rest_pose_without_drifting(character, joints):
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


def test_it_stands_for_a_second_without_control(character, scene):
    model = scene(character)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=round(1 / model.opt.timestep))
    assert data.qpos[2] == pytest.approx(model.qpos0[2], abs=0.02)
    assert rotations(model, data).magnitude().max() < 0.1
    assert np.abs(data.qvel).max() < 0.5


@pytest.mark.parametrize("push", [(0.1, 0.0), (-0.1, 0.0), (0.0, 0.1)])
def test_the_biped_withstands_a_push(push, scene):
    model = scene(CHARACTERS["biped"])
    data = mujoco.MjData(model)
    data.qvel[:2] = push
    mujoco.mj_step(model, data, nstep=round(4 / model.opt.timestep))
    assert data.qpos[2] == pytest.approx(model.qpos0[2], abs=0.002)
    assert np.abs(data.qvel).max() < 0.01


@pytest.mark.trajectories
@pytest.mark.parametrize("height", [0.0, 1.0])
def test_random_actions_do_not_make_it_diverge(character, height, scene):
    model = scene(character)
    simulation = BatchSimulation(model, 32, substeps=4, num_threads=1)
    qpos = torch.tensor(model.qpos0).repeat(32, 1)
    qpos[:, 2] += height
    simulation.reset(torch.arange(32), {"qpos": qpos})
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(model.actuator_ctrlrange).unbind(-1)
    for _ in range(45):
        faults = simulation.step(low + (high - low) * torch.rand(32, model.nu, generator=generator))
        assert len(faults) == 0
        assert simulation.state["qvel"].abs().max() < 60
