"""The errors of imitation, of poses far from the reference, against MuJoCo's kinematics and SciPy's rotations."""

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs import Imitation
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions import MotionClip
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.motions.placement import Placement
from torchrl_mcp.envs.tasks.imitation_reward import ERRORS


def follower(character):
    """A character whose reference moves in all joints at constant rates."""
    model = CHARACTERS[character].spec().compile()
    poses, rates = np.tile(model.qpos0, (61, 1)), np.random.default_rng(1).normal(0, 0.3, model.nv)
    for frame, pose in enumerate(poses):
        mujoco.mj_integratePos(model, pose, rates, frame / 30)
    library = MotionLibrary({"drift": MotionClip(character, torch.from_numpy(poses), 30.0)})
    terms = {"pose": {"weight": 1.0, "scale": 1.0}}
    return Imitation(character, library, 1, terms=terms, seed=0, num_threads=1, dtype=torch.float64)


@pytest.mark.parametrize("character", CHARACTERS)
def test_the_errors_of_any_pose_are_those_that_mujoco_and_scipy_find(character):
    env = follower(character)
    env.reset()
    state, model, rng = env.get_state(), env.simulation.model, np.random.default_rng(0)
    qpos = state["qpos"][0].numpy().copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(0, 0.2, model.nv), 1.0)
    state["qpos"][0], state["qvel"][0] = torch.from_numpy(qpos), torch.from_numpy(rng.normal(0, 1.0, model.nv))
    state["time"][:] = 0.5  # a frame: between frames the library interpolates positions
    env.reset(state, set_state=True)
    clip, time, turn, shift = (env.episode[key] for key in ("clip", "time", "turn", "shift"))
    reference, sides = env.library.at(clip, time, Placement(turn, shift)), []
    for positions, velocities in ((state["qpos"], state["qvel"]), (reference.qpos, reference.qvel)):
        data = mujoco.MjData(model)
        data.qpos, data.qvel = positions[0], velocities[0]
        mujoco.mj_forward(model, data)
        sides.append(data)
    one, other = sides

    def angle(here, there):
        """Squared, between quaternions."""
        turns = (Rotation.from_quat(q, scalar_first=True) for q in (here, there))
        return (next(turns).inv() * next(turns)).magnitude() ** 2

    joints = []
    for joint in range(1, model.njnt):
        start = model.jnt_qposadr[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            joints.append(angle(one.qpos[start : start + 4], other.qpos[start : start + 4]))
        else:
            joints.append((one.qpos[start] - other.qpos[start]) ** 2)
    keys = [model.body(name).id for name in CHARACTERS[character].key_bodies]
    reach = [data.xpos[keys] - data.xpos[1] for data in sides]
    speed = np.square(one.qvel - other.qvel)
    expected = {
        "pose": np.mean(joints),
        "velocity": speed[6:].sum() / len(joints),
        "root_pose": np.square(one.qpos[:3] - other.qpos[:3]).sum() + 0.1 * angle(one.qpos[3:7], other.qpos[3:7]),
        "root_velocity": speed[:3].sum() + 0.1 * speed[3:6].sum(),
        "key_positions": np.square(reach[0] - reach[1]).sum(-1).mean(),
        "bodies": np.square(one.xpos[1:] - other.xpos[1:]).sum(-1).mean(),
        "orientations": np.mean([angle(*pair) for pair in zip(one.xquat[1:], other.xquat[1:], strict=True)]),
        "com": np.square(one.subtree_com[1] - other.subtree_com[1]).sum(),
    }
    assert expected.keys() == set(ERRORS)
    assert min(expected.values()) > 1e-3
    for name, value in expected.items():
        assert env._error(name, reference).item() == pytest.approx(value, rel=1e-6), name
