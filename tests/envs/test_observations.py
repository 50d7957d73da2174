import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.kinematics import BodyStates
from torchrl_mcp.envs.observations import character_state, state_layout
from torchrl_mcp.envs.rotations import heading

every_character = pytest.mark.parametrize("character", CHARACTERS)
angles = st.floats(-3.1, 3.1)


def wxyz(rotation):
    return torch.tensor(rotation.as_quat(scalar_first=True))


def moving(character, seed=0, **kwargs):
    """A character in the air in a random pose, tumbling; its environment in float64, to look into."""
    env = Heading(character, 1, seed=0, num_threads=1, dtype=torch.float64, terminate_on_fall=False, **kwargs)
    model, rng = env.simulation.model, np.random.default_rng(seed)
    qpos = model.qpos0.copy()
    mujoco.mj_integratePos(model, qpos, rng.normal(0, 0.3, model.nv), 1.0)
    qpos[2] += 2.0
    return env, torch.tensor(qpos)[None], torch.tensor(rng.normal(0, 1.0, (1, model.nv)))


def observe(env, qpos, qvel):
    state = env.get_state().update({"qpos": qpos, "qvel": qvel}).select("qpos", "qvel")
    return env.reset(state, set_state=True)["observation"][0]


def turned(qpos, qvel, angle, shift):
    """The same motion elsewhere in the world: turned about z, then moved along the ground."""
    turn = Rotation.from_euler("z", angle)
    qpos, qvel = qpos.clone(), qvel.clone()
    qpos[0, :3] = torch.tensor(turn.apply(qpos[0, :3])) + torch.tensor([*shift, 0.0])
    qpos[0, 3:7] = wxyz(turn * Rotation.from_quat(qpos[0, 3:7], scalar_first=True))
    qvel[0, :3] = torch.tensor(turn.apply(qvel[0, :3]))
    return qpos, qvel


@given(yaw=angles, pitch=st.floats(-1.4, 1.4), roll=angles)
def test_heading_is_the_yaw_of_yaw_pitch_and_roll(yaw, pitch, roll):
    orientation = wxyz(Rotation.from_euler("ZYX", [yaw, pitch, roll]))
    difference = heading(orientation) - yaw
    assert torch.atan2(difference.sin(), difference.cos()).abs() < 1e-9


@every_character
@given(angle=angles, x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_the_state_does_not_depend_on_the_place_or_heading_in_the_world(character, angle, x, y):
    env, qpos, qvel = moving(character)
    here, there = observe(env, qpos, qvel), observe(env, *turned(qpos, qvel, angle, (x, y)))
    torch.testing.assert_close(there, here, atol=1e-9, rtol=0)


@every_character
def test_every_feature_is_what_its_name_says(character):
    env, qpos, qvel = moving(character, seed=1)
    observation, data = observe(env, qpos, qvel), env.simulation.data(0)
    root = Rotation.from_quat(data.xquat[1], scalar_first=True)
    forward = root.apply([1.0, 0.0, 0.0])
    frame = Rotation.from_euler("z", np.arctan2(forward[1], forward[0])).inv()
    assert observation[env.observation_layout["root_height"]].item() == pytest.approx(qpos[0, 2].item())
    names = [name.removesuffix(".position") for name in env.observation_layout if name.endswith(".position")]
    assert names == [body.name for body in CHARACTERS[character].spec().bodies[1:]]
    for name in names:
        body = data.body(name)
        velocity = np.zeros(6)  # angular, then linear, of the body's origin, in world axes
        mujoco.mj_objectVelocity(env.simulation.model, data, mujoco.mjtObj.mjOBJ_XBODY, body.id, velocity, 0)
        orientation = wxyz(frame * Rotation.from_quat(body.xquat, scalar_first=True))
        expected = {
            "position": frame.apply(body.xpos - data.xpos[1]),
            "orientation": orientation * orientation[0].sign(),
            "linear_velocity": frame.apply(velocity[3:]),
            "angular_velocity": frame.apply(velocity[:3]),
        }
        for quantity, value in expected.items():
            found = observation[env.observation_layout[f"{name}.{quantity}"]].numpy()
            np.testing.assert_allclose(found, value, atol=1e-9, err_msg=f"{name}.{quantity}")


@every_character
def test_velocities_are_finite_differences_of_positions(character):
    env, qpos, qvel = moving(character, seed=2)
    model, data = env.simulation.model, env.simulation.data(0)
    observation, step, places = observe(env, qpos, qvel), 1e-6, []
    for sign in (-1, 1):
        data.qpos = qpos[0]
        mujoco.mj_integratePos(model, data.qpos, qvel[0].numpy(), sign * step)
        mujoco.mj_kinematics(model, data)
        places.append(data.xpos[1 : 1 + len(env._bodies)].copy())
    difference = (places[1] - places[0]) / (2 * step)
    angle = heading(qpos[0, 3:7])
    frame = Rotation.from_euler("z", -angle.item())
    bodies = observation[1:].unflatten(-1, (-1, 13))
    np.testing.assert_allclose(bodies[:, 7:10], frame.apply(difference), atol=1e-6)


def test_both_signs_of_a_quaternion_are_the_same_state():
    vectors, orientations = torch.randn(3, 2, 3), torch.nn.functional.normalize(torch.randn(2, 4), dim=-1)
    states = [
        character_state(torch.tensor(0.3), BodyStates(vectors[0], sign * orientations, *vectors[1:]))
        for sign in (1, -1)
    ]
    assert torch.equal(*states)
    assert (states[0][1:].unflatten(-1, (2, 13))[:, 3] >= 0).all()


def test_the_layout_covers_the_state_without_gaps():
    layout = state_layout(["one", "two"])
    assert list(layout)[:3] == ["root_height", "one.position", "one.orientation"]
    assert [index for part in layout.values() for index in range(27)[part]] == list(range(27))
