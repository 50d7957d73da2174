import math

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.envs import Dribble
from torchrl_mcp.envs.characters import CHARACTERS

RADIUS, MASS, FRICTION, GRAVITY = 0.2, 0.43, 0.4, 9.81
RATE = -math.log(0.6)  # per second: what loses 40 % in a second

every_character = pytest.mark.parametrize("character", CHARACTERS)


def make(num_envs=1, character="biped", **kwargs):
    return Dribble(character, num_envs, **{"seed": 0, "num_threads": 1, "terminate_on_fall": False, **kwargs})


def thrown(env, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0), height=RADIUS):
    """Begin with the ball far from the character, in motion."""
    env.reset()
    state = env.get_state()
    state["qpos"][:, -7:] = torch.tensor([5.0, 5.0, height, 1.0, 0.0, 0.0, 0.0])
    state["qvel"][:, -6:] = torch.tensor([*velocity, *spin])
    return env.reset(state, set_state=True)


def play(env, carrier, num_steps):
    """Velocity of the ball after each step, ``(T, 6)``: linear, then angular."""
    velocities = []
    for _ in range(num_steps):
        carrier = env.step(carrier.set("action", torch.zeros(env.action_spec.shape)))["next"]
        velocities.append(env.simulation.state["qvel"][0, -6:].numpy().copy())
    return np.array(velocities)


def test_a_rolling_ball_loses_two_fifths_of_its_speed_per_second():
    env = make()
    velocities = play(env, thrown(env, velocity=(3.0, 0.0, 0.0), spin=(0.0, 3.0 / RADIUS, 0.0)), 120)
    time = np.arange(1, 121) / 30
    np.testing.assert_allclose(velocities[:, 0], 3.0 * np.exp(-RATE * time), rtol=0.01)
    np.testing.assert_allclose(velocities[:, 0], np.linalg.norm(velocities[:, 3:], axis=-1) * RADIUS, rtol=0.01)
    assert np.abs(velocities[:, 1]).max() < 0.01


def test_a_ball_that_slides_is_braked_by_its_own_friction_until_it_rolls():
    env = make()
    carrier = thrown(env, velocity=(0.0, 4.0, 0.0))
    velocities, heights = [], []
    for _ in range(20):
        velocities.append(play(env, carrier, 1)[0])
        heights.append(env.simulation.state["qpos"][0, -5].item())
    velocities = np.array(velocities)
    speed, surface, time_step = 4.0, 0.0, 1e-4  # m dv/dt = -mu m g - m k v, 2/5 m r dw/dt = mu m g - 2/5 m r k w
    expected = []
    for step in range(1, 20 * 334):
        sliding = FRICTION * GRAVITY if speed > surface else 0.0
        speed += time_step * (-sliding - RATE * speed)
        surface += time_step * (2.5 * sliding - RATE * surface)
        if step in {round(k / 30 / time_step) for k in range(1, 21)}:
            expected.append(speed)
    np.testing.assert_allclose(
        velocities[:, 1], expected, atol=0.05 * 4
    )  # it hops by millimetres, so friction comes and goes
    np.testing.assert_allclose(velocities[-8:, 1], expected[-8:], rtol=0.005)  # it rolls
    assert max(heights) < RADIUS + 0.01


@pytest.mark.parametrize("drop", [0.3, 0.5, 1.0, 1.5])
def test_a_ball_that_is_dropped_bounces_like_a_football_on_turf(drop):
    """FIFA's manual for turf: from 2 m it comes back to between 0.6 and 1 m, with 0.55 to 0.71 of its speed."""
    model = make().simulation.model
    data = mujoco.MjData(model)
    data.qpos[:2], data.qpos[-7:-4] = [50, 50], [0, 0, RADIUS + drop]
    heights = []
    for _ in range(round(1.5 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        heights.append(data.qpos[-5] - RADIUS)
    heights = np.array(heights)
    touched = np.argmax(heights < 0)
    left = touched + np.argmax(heights[touched:] > 0)
    air = np.exp(-RATE * (math.sqrt(2 * drop / GRAVITY) + 0.3))  # its damping takes some, on the way down and up
    assert 0.55 * air < math.sqrt(heights[left:].max() / drop) < 0.75
    assert -0.04 < heights[touched:left].min() < 0  # a tenth of its width
    assert abs(data.qpos[-5] - RADIUS) < 0.2 * drop  # and comes to rest


def test_in_the_air_ball_and_spin_are_damped_alike():
    env = make()
    velocities = play(env, thrown(env, velocity=(2.0, 0.0, 0.0), spin=(0.0, 0.0, 10.0), height=9.0), 30)
    left = np.exp(-RATE * np.arange(1, 31) / 30)
    np.testing.assert_allclose(velocities[:, 0], 2.0 * left, rtol=0.005)
    np.testing.assert_allclose(velocities[:, 5], 10.0 * left, rtol=0.005)
    np.testing.assert_allclose(velocities[:, 2], -GRAVITY / RATE * (1 - left), rtol=0.02)


@every_character
def test_the_ball_is_solid_and_weighs_430_grams_whatever_the_character(character):
    model = make(character=character).simulation.model
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, inertia)
    expected = [MASS] * 3 + [0.4 * MASS * RADIUS**2] * 3
    np.testing.assert_allclose(np.diag(inertia)[-6:], expected, rtol=1e-9)


@every_character
def test_the_ball_meets_every_shape_of_the_body_and_the_ground(character):
    env = make(character=character)
    model = env.simulation.model
    data, ball = mujoco.MjData(model), model.geom("ball").id
    mujoco.mj_forward(model, data)
    bodies = range(1, model.body("target").id)
    for geom in [g for g in range(model.ngeom) if model.geom_bodyid[g] in bodies and model.geom_conaffinity[g]]:
        data.qpos[-7:-4] = data.geom_xpos[geom] + [0, 0, 0.01]
        mujoco.mj_forward(model, data)
        assert {geom, ball} in [set(pair) for pair in data.contact.geom], geom
    data.qpos[-7:-4] = [5, 5, RADIUS - 1e-3]
    mujoco.mj_forward(model, data)
    touching = next(contact for contact in data.contact if ball in contact.geom)
    assert set(touching.geom) == {ball, model.geom("ground").id}
    assert touching.friction[0] == FRICTION


def test_a_foot_sends_the_ball_away():
    env = make()
    env.reset()
    state = env.get_state()
    state["qpos"][:, 2] += 0.05
    state["qpos"][:, -7:-4] = torch.tensor([0.36, 0.085, RADIUS])
    state["qvel"][:, 0] = 2.0  # the whole character flies forward
    velocities = play(env, env.reset(state, set_state=True), 6)
    assert velocities[-1, 0] > 1.0
    assert env.simulation.state["qvel"][0, 0] < 2.0


def test_the_target_is_no_obstacle():
    env = make()
    thrown(env, velocity=(3.0, 0.0, 0.0), spin=(0.0, 15.0, 0.0))
    state = env.get_state()
    state["mocap_pos"][:, 0, :2] = torch.tensor([6.0, 5.0])
    velocities = play(env, env.reset(state, set_state=True), 30)
    assert velocities[-1, 0] == pytest.approx(3.0 * 0.6, rel=0.01)
    assert env.simulation.state["qpos"][0, -7] > 7


@every_character
def test_the_ball_begins_at_least_half_a_metre_away(character):
    env = make(500, character)
    env.reset()
    distances = env.simulation.state["qpos"][:, -7:-5].norm(dim=-1)
    assert 0.5 <= distances.min() < 1.0
    assert 9.5 < distances.max() <= 10
    assert (env.simulation.state["qpos"][:, -5] == RADIUS).all()


def test_success_needs_the_character_within_two_metres_of_the_ball():
    env = make(3)
    env.reset()
    state = env.get_state()
    state["qpos"][:, -7:-5] = torch.tensor([[1.9, 0.0], [2.1, 0.0], [1.9, 0.0]])
    state["mocap_pos"][:, 0, :2] = torch.tensor([[2.3, 0.0], [2.3, 0.0], [2.5, 0.0]])
    carrier = env.reset(state, set_state=True)
    assert carrier["success"].flatten().tolist() == [True, False, False]
    masses = torch.tensor(env.simulation.model.body_mass)[1:-2]
    com = (masses[:, None] * torch.tensor(env.simulation.data(0).xipos)[1:-2]).sum(0) / masses.sum()
    assert com[:2].abs().max() < 0.05
