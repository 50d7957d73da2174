"""Carrying: who takes the box, and how a joint then holds it."""

import math

import mujoco
import numpy as np
import pytest
import scipy.optimize
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs import Carry
from torchrl_mcp.envs.characters import CHARACTERS

HALF_SIZE = 0.15  # of the box
GRAVITY = 9.81


def make(num_envs=2, character="biped", **kwargs):
    return Carry(character, num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def play(env, carrier, num_steps, action=None):
    for _ in range(num_steps):
        carrier = env.step(carrier.set("action", torch.zeros(env.action_spec.shape) if action is None else action))
        carrier = carrier["next"]
    return carrier


def joined(env):
    return env.simulation.state["eq_active"].flatten().tolist()


def held_pose(env, index=0):
    """Place and orientation of the box as the torso sees it."""
    data = env.simulation.data(index)
    torso, box = data.body("torso"), data.body("box")
    turn = torso.xmat.reshape(3, 3).T
    return turn @ (box.xpos - torso.xpos), turn @ box.xmat.reshape(3, 3)


def force_on_the_ground(env, index=0):
    """Sum of MuJoCo's contact forces on the plane, upwards, in N."""
    data, model, force = env.simulation.data(index), env.simulation.model, np.zeros(6)
    total = 0.0
    for number, contact in enumerate(data.contact):
        if model.geom("ground").id in contact.geom:
            mujoco.mj_contactForce(model, data, number, force)
            total += force[0]
    return total


@pytest.mark.parametrize(("gap", "taken"), [(-0.002, 1.0), (0.002, 0.0)])
def test_the_torso_takes_the_box_by_touching_it(gap, taken, ahead):
    env = make()
    carrier = play(env, env.reset(ahead(env, gap), set_state=True), 1)
    assert joined(env) == [taken] * 2
    assert carrier["box_taken"].flatten().tolist() == [bool(taken)] * 2


@pytest.mark.parametrize("character", CHARACTERS)
def test_every_character_can_take_the_box_by_walking_up_to_it(character):
    env = make(1, character, terminate_on_fall=False)
    env.reset()
    state, model = env.get_state(), env.simulation.model
    carrier = model.body(env.character.carrier)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert state["qpos"][0, -5].item() == pytest.approx(data.body(carrier.id).xipos[2])

    def gap(distance):
        """From the nearest of the carrier's shapes to a box that far ahead."""
        data.joint("box").qpos[:2], data.joint("box").qpos[3:] = (distance, 0.0), (1.0, 0.0, 0.0, 0.0)
        mujoco.mj_kinematics(model, data)
        shapes = carrier.geomadr[0] + np.flatnonzero(model.geom_conaffinity[model.geom_bodyid == carrier.id])
        return min(mujoco.mj_geomDistance(model, data, shape, model.geom("box").id, 5.0, None) for shape in shapes)

    inside = data.body(carrier.id).xipos[0] + HALF_SIZE
    distance = scipy.optimize.brentq(lambda distance: gap(distance) + 0.002, inside, inside + 2.0)
    state["qpos"][:, -7:-5] = state["mocap_pos"][:, 1, :2] = torch.tensor([distance, 0.0])
    state["qpos"][:, -4:] = state["mocap_quat"][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    state["mocap_pos"][:, 0, :2] = torch.tensor([-5.0, 0.0])
    play(env, env.reset(state, set_state=True), 1)
    assert joined(env) == [1.0]


def test_other_bodies_do_not_take_the_box(ahead):
    env = make()
    state = ahead(env, 0.05)
    state["qpos"][:, 7:11] = torch.tensor([math.cos(0.2), 0.0, -math.sin(0.2), 0.0])  # leans back at the waist
    state["qpos"][:, -7] = state["mocap_pos"][:, 1, 0] = 0.06 + 0.15 - 0.003
    state["qpos"][:, -5] -= 0.1
    state["mocap_pos"][:, 1, 2] -= 0.1
    env.reset(state, set_state=True)
    names = [env.simulation.model.body(env.simulation.model.geom_bodyid[g]).name for g in contacts(env)]
    assert "root" in names
    play(env, env.reset(state, set_state=True), 1)
    assert joined(env) == [0.0, 0.0]


def contacts(env):
    """Shapes in contact with the box."""
    box = env.simulation.model.geom("box").id
    return [geom for pair in env.simulation.data(0).contact.geom if box in pair for geom in pair if geom != box]


def test_a_box_that_does_not_stand_on_the_source_is_not_taken(ahead):
    env = make(3)
    state = ahead(env, -0.002)
    state["mocap_pos"][0, 1, 2] -= 0.03
    state["mocap_pos"][1, 1, 0] += 5
    play(env, env.reset(state, set_state=True), 1)
    assert joined(env) == [0.0, 0.0, 1.0]


def test_the_source_sinks_where_the_box_is_taken_until_the_next_episode(ahead):
    env = make(2, max_episode_steps=3)
    state = ahead(env, -0.002)
    state["qpos"][1, -7] = state["mocap_pos"][1, 1, 0] = 3.0
    carrier = play(env, env.reset(state, set_state=True), 2)
    sunk = state["mocap_pos"][:, 1, 2] - env.get_state()["mocap_pos"][:, 1, 2]
    assert sunk.tolist() == pytest.approx([0.1, 0.0])
    assert carrier["goal"][:, env.goal_layout["source.position"]][:, 2].diff().item() == pytest.approx(0.1, abs=2e-3)
    env.reset()
    assert torch.equal(env.get_state()["mocap_pos"][:, :, 2], state["mocap_pos"][:, :, 2])


@pytest.mark.parametrize("table", ["source", "target"])
def test_a_box_in_hand_that_dips_while_its_carrier_walks_passes_over_the_tops(table, ahead):
    env = make(1)
    play(env, env.reset(ahead(env, -0.002), set_state=True), 2)
    data, model = env.simulation.data(0), env.simulation.model
    data.joint("box").qpos[:2] = data.body(table).xpos[:2]
    for dip, touching in ((0.0, 0), (0.09, 0), (0.11, 1)):
        data.joint("box").qpos[2] = env.get_state()["qpos"][0, -5] - dip
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        tops = set(np.flatnonzero(model.geom_bodyid == model.body(table).id))
        assert any(tops & {*contact} for contact in data.contact.geom.tolist()) == touching


def test_the_joint_closes_without_a_jump(ahead):
    env, free = make(1), make(1)
    state = ahead(env, -0.001)
    angle = Rotation.from_euler("z", 0.02).as_quat()[[3, 0, 1, 2]]
    state["qpos"][:, -4:] = torch.from_numpy(angle)
    one, other = env.reset(state.clone(), set_state=True), free.reset(state, set_state=True)
    free.episode["taken"].fill_(1)
    one, other = play(env, one, 1), play(free, other, 1)
    assert joined(env) == [1.0]
    assert joined(free) == [0.0]
    assert torch.equal(env.simulation.state["qpos"], free.simulation.state["qpos"])
    place, turn = held_pose(env)
    play(env, one, 1)
    play(free, other, 1)
    moved = env.simulation.state["qpos"] - free.simulation.state["qpos"]
    assert moved.abs().max() < 4e-3  # its carrier yields to its weight, which the source bore; a free fall is 5 mm
    for _ in range(20):
        play(env, one, 1)
        now, turned = held_pose(env)
        assert np.linalg.norm(now - place) < 1e-3
        assert np.abs(turned - turn).max() < 1e-3


def test_the_weight_of_the_box_is_felt_while_it_is_held(holding):
    env = make(2)
    state = holding(env)
    state["mocap_pos"][:, 1, 0] += 5  # the table is taken away
    state["eq_active"][1] = 0
    state["qpos"][1, -7] += 5  # the second character stands there without the box
    carrier = env.reset(state, set_state=True)
    forces = []
    for _ in range(30):
        carrier = play(env, carrier, 1)
        forces.append([force_on_the_ground(env, index) for index in range(2)])
    held, free = np.mean(forces[10:], 0)
    data = env.simulation.data(1)
    on_its_own = 5 * GRAVITY if data.body("box").xpos[2] < 0.2 else 0.0
    assert held == pytest.approx(47 * GRAVITY, rel=0.03)
    assert free - on_its_own == pytest.approx(42 * GRAVITY, rel=0.03)
    assert env.simulation.state["qpos"][0, -5] > 1.1


def test_a_partial_reset_opens_the_joint_of_its_own_simulation_only(holding):
    env = make(3)
    state = holding(env)
    default = torch.from_numpy(env.simulation.model.eq_data)
    assert not torch.equal(state["eq_data"][1], default)
    carrier = env.reset(state, set_state=True)
    env.reset(carrier.set("_reset", torch.tensor([[False], [True], [False]])))
    after = env.get_state()
    assert joined(env) == [1.0, 0.0, 1.0]
    assert torch.equal(after["eq_data"][1], default)
    assert after["taken"].tolist() == [1.0, 0.0, 1.0]
    for key, value in after.items():
        assert torch.equal(value[[0, 2]], state[key][[0, 2]]), key


def test_a_restored_hold_continues_bit_for_bit(holding):
    env, other = make(2, terminate_on_fall=False), make(2, terminate_on_fall=False, seed=5)
    carrier = env.reset(holding(env), set_state=True)
    action = torch.rand(2, 17, generator=torch.Generator().manual_seed(0)) * 0.2 - 0.1
    carrier = play(env, carrier, 4, action)
    state = env.get_state()
    play(env, carrier, 10, action)
    play(other, other.reset(), 2, action)
    play(other, other.reset(state, set_state=True), 10, action)
    for key, value in env.get_state().items():
        assert torch.equal(value, other.get_state()[key]), key
    assert joined(env) == [1.0, 1.0]


def test_a_simulation_is_looked_into_with_its_own_joint(holding):
    env = make(2)
    state = holding(env)
    state["eq_data"][1, 0, 3] += 0.1
    env.reset(state, set_state=True)
    strains = []
    for index in range(2):
        data = env.simulation.data(index)
        weld = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
        strains.append(np.abs(data.efc_pos[weld]).max())
    assert strains[0] < 1e-3
    assert strains[1] == pytest.approx(0.1, abs=2e-3)
