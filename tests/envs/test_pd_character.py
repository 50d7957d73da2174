import math

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.falls import falling_geoms, lowest_points

every_character = pytest.mark.parametrize("character", CHARACTERS)


def make(character="biped", num_envs=4, **kwargs):
    return Heading(character, num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def corners(half_size):
    return np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * half_size


@pytest.mark.parametrize("seed", range(5))
def test_the_lowest_point_of_a_shape_is_the_lowest_of_its_corners_or_ends(seed):
    rng = np.random.default_rng(seed)
    turn, half_size, length, radius = Rotation.random(random_state=seed), rng.uniform(0.1, 1, 3), 0.4, 0.1
    expected = [
        3.0 + turn.apply(corners(half_size))[:, 2].min(),
        3.0 + turn.apply([[0, 0, length], [0, 0, -length]])[:, 2].min() - radius,
        3.0 - radius,
    ]
    half_sizes = torch.tensor(np.array([half_size, [0, 0, length], [0, 0, 0]]))
    vertical = torch.tensor(turn.as_matrix()[2]).expand(3, 3)
    found = lowest_points(torch.full((3,), 3.0), vertical, half_sizes, torch.tensor([0, radius, radius]))
    np.testing.assert_allclose(found, expected)


@every_character
def test_a_fall_is_a_contact_of_mujocos_between_the_ground_and_anything_but_a_foot(character):
    env = make(character, 8, terminate_on_fall=False)
    state, script = env.reset(), torch.Generator().manual_seed(0)
    fallen, touching = [], []
    for _ in range(60):
        action = torch.rand(env.action_spec.shape, generator=script) * 0.6 - 0.3
        state = env.step(state.set("action", action))["next"]
        fallen += env.fallen().tolist()
        for index in range(8):
            data, model = env.simulation.data(index), env.simulation.model
            bodies = {model.body(model.geom_bodyid[geom]).name for geom in data.contact.geom.flatten()}
            touching.append(bool(bodies - {"world", *env.character.feet}))
    assert fallen == touching
    assert 0.05 < np.mean(fallen) < 0.95


@every_character
def test_a_fall_ends_the_episode_without_reward(character):
    lying = make(character, 2)
    qpos = torch.from_numpy(lying.simulation.model.qpos0).repeat(2, 1)
    qpos[1, 2], qpos[1, 3:7] = 0.05, torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])  # on its face
    state = TensorDict({"qpos": qpos, "qvel": torch.zeros(2, lying.simulation.model.nv)}, [2])
    for terminate_on_fall in (True, False):
        env = make(character, 2, terminate_on_fall=terminate_on_fall)
        carrier = env.reset(state.clone(), set_state=True).set("action", torch.zeros(env.action_spec.shape))
        outcome = env.step(carrier)["next"]
        assert outcome["terminated"].flatten().tolist() == [False, terminate_on_fall]
        assert outcome["reward"][1] == 0
        assert outcome["reward"][0] > 0


@every_character
def test_action_one_is_half_the_range_of_the_targets_and_zero_the_rest_pose(character):
    env = make(character, 3)
    size = env.action_spec.shape[-1]
    action = torch.stack([torch.zeros(size), torch.ones(size), torch.full((size,), -0.5)])
    env.step(env.reset().set("action", action))
    ranges = env.simulation.model.actuator_ctrlrange
    half = (ranges[:, 1] - ranges[:, 0]) / 2
    np.testing.assert_allclose(env.simulation.state["ctrl"], np.stack([0 * half, half, -0.5 * half]))
    assert env.action_spec.space.low.unique().tolist() == [-1]
    assert env.action_spec.space.high.unique().tolist() == [1]


@every_character
def test_outputs_are_those_of_the_state_after_the_step(character):
    env = make(character, 2)
    env.step(env.reset().set("action", torch.rand(env.action_spec.shape) - 0.5))
    model, data = env.simulation.model, mujoco.MjData(env.simulation.model)
    data.qpos, data.qvel = env.simulation.state["qpos"][1], env.simulation.state["qvel"][1]
    mujoco.mj_forward(model, data)
    for name in ("xpos", "xquat", "cvel", "geom_xpos"):
        np.testing.assert_allclose(env.simulation.outputs[name][1], getattr(data, name), atol=1e-12)


def test_self_collision_is_a_switch():
    """Both knees are bent into one place: they meet only if they may."""
    contacts = []
    for self_collision in (False, True):
        env = make("humanoid", 1, self_collision=self_collision)
        data = env.simulation.data(0)
        data.qpos[2] += 1
        for joint, side in (("right_hip", 1), ("left_hip", -1)):
            start = env.simulation.model.joint(joint).qposadr[0]
            data.qpos[start : start + 4] = Rotation.from_rotvec([side * 0.25, 0, 0]).as_quat(scalar_first=True)
        mujoco.mj_forward(env.simulation.model, data)
        contacts.append(data.ncon)
    assert contacts[0] == 0
    assert contacts[1] > 0


def drift(character, friction_cone, angle, steps=12):
    """How far the bodies of a motion and of the same motion turned about z are apart in the end, in metres."""
    env = make(character, 2, friction_cone=friction_cone, terminate_on_fall=False)
    env.reset()
    state, turn = env.get_state(), Rotation.from_euler("z", angle)
    generator = torch.Generator().manual_seed(0)
    state["qvel"][:] = 0.3 * torch.randn(state["qvel"].shape[1], generator=generator, dtype=torch.float64)
    state["qvel"][:, 0] += 0.5
    state["qpos"][:, 2] += 0.005  # where no two corners of a foot touch at once: rounding would choose between them
    for part in (state["qpos"], state["qvel"]):
        part[1, :3] = torch.from_numpy(turn.apply(part[1, :3].numpy()))
    root = Rotation.from_quat(state["qpos"][1, 3:7].numpy(), scalar_first=True)
    state["qpos"][1, 3:7] = torch.from_numpy((turn * root).as_quat(scalar_first=True))
    carrier, contacts = env.reset(state, set_state=True), 0
    for _ in range(steps):
        action = 0.4 * torch.rand(env.action_spec.shape[-1], generator=generator) - 0.2
        carrier = env.step(carrier.set("action", action.expand(2, -1)))["next"]
        contacts += env.simulation.data(0).ncon
    assert contacts, "in the air, friction has no part"
    here, there = env.simulation.outputs["xpos"][:, 1:].numpy()
    return np.linalg.norm(turn.inv().apply(there) - here, axis=-1).max()


@every_character
@pytest.mark.parametrize("angle", [math.pi / 4, 0.3])
def test_with_elliptic_cones_the_world_has_no_axes(character, angle):
    assert drift(character, "elliptic", angle) < 1e-9


def test_pyramidal_cones_have_edges_along_the_axes():
    assert drift("biped", "pyramidal", math.pi / 4) > 1e-3
    assert drift("biped", "pyramidal", math.pi / 2) < 1e-9


@every_character
def test_a_finer_time_step_takes_more_substeps(character):
    env = make(character, 1, physics_timestep=1 / 240)
    assert env.substeps == 8
    assert env.control_timestep == pytest.approx(1 / 30)


@every_character
def test_specs_describe_what_the_environment_does(character):
    check_env_specs(make(character), seed=0)


def test_a_body_of_one_shape_falls_too():
    spec = mujoco.MjSpec()
    for name in ("trunk", "foot"):
        spec.worldbody.add_body(name=name).add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.2, 0, 0])
    ids, half_sizes, radii = falling_geoms(spec.compile(), ("foot",), 2)
    assert (ids.tolist(), half_sizes.tolist(), radii.tolist()) == ([0], [[0, 0, 0]], [0.2])
