"""Where objects and targets of carrying and dribbling are, and how goals and pictures show them."""

import math

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs import Carry, Dribble
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.tasks.places import logarithmic

every_task = pytest.mark.parametrize("task", [Carry, Dribble])
every_character = pytest.mark.parametrize("character", CHARACTERS)


def make(task, character="biped", num_envs=4, **kwargs):
    return task(character, num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


@every_task
@every_character
def test_the_goal_holds_what_mujoco_says_of_the_things_as_seen_by_the_character(task, character):
    env = make(task, character, 3, dtype=torch.float64)
    env.reset()
    state, random = env.get_state(), np.random.default_rng(0)
    state["qpos"][:, 3:7] = torch.from_numpy(Rotation.random(3, random_state=1).as_quat()[:, [3, 0, 1, 2]])
    state["qpos"][:, 2] += 3
    state["qpos"][:, -4:] = torch.from_numpy(Rotation.random(3, random_state=2).as_quat()[:, [3, 0, 1, 2]])
    state["qvel"][:, -6:] = torch.from_numpy(random.normal(size=(3, 6)))
    goal = env.reset(state, set_state=True)["goal"].numpy()
    for index in range(3):
        data = env.simulation.data(index)
        forward = data.body("root").xmat.reshape(3, 3)[:, 0]
        turn = Rotation.from_euler("z", -math.atan2(forward[1], forward[0]))
        for name, place in env.goal_layout.items():
            thing, quantity = name.split(".")
            body, shown = data.body(thing), goal[index, place]
            velocity = np.zeros(6)
            mujoco.mj_objectVelocity(env.simulation.model, data, mujoco.mjtObj.mjOBJ_BODY, body.id, velocity, 0)
            match quantity:
                case "position":
                    expected = turn.apply(body.xpos - data.body("root").xpos)
                case "orientation":
                    assert shown[0] >= 0
                    shown = Rotation.from_quat(shown[[1, 2, 3, 0]]).as_matrix()
                    expected = turn.as_matrix() @ body.xmat.reshape(3, 3)
                case "linear_velocity":
                    expected = turn.apply(velocity[3:])
                case "angular_velocity":
                    expected = turn.apply(velocity[:3])
            np.testing.assert_allclose(shown, expected, atol=1e-12, err_msg=name)


@every_task
def test_logarithmic_goals_have_the_same_directions_and_logarithmic_distances(task):
    goals = [make(task, goal_positions=form, dtype=torch.float64).reset()["goal"] for form in ("metres", "logarithmic")]
    layout = make(task).goal_layout
    for name, place in layout.items():
        plain, other = (goal[:, place].numpy() for goal in goals)
        if name.endswith(".position"):
            way, changed = (positions[:, 0] + 1j * positions[:, 1] for positions in (plain, other))
            np.testing.assert_allclose(np.angle(changed), np.angle(way), atol=1e-12, err_msg=name)
            np.testing.assert_allclose(np.expm1(np.abs(changed)), np.abs(way) / 0.25, rtol=1e-12, err_msg=name)
            plain, other = plain[:, 2:], other[:, 2:]
        np.testing.assert_array_equal(other, plain, err_msg=name)


def test_a_thing_at_the_character_is_at_the_origin_of_logarithmic_goals():
    assert torch.equal(logarithmic(torch.zeros(1, 2)), torch.zeros(1, 2))


@every_task
def test_the_layout_of_the_goal_leaves_nothing_out(task):
    env = make(task, num_envs=1)
    places = [index for place in env.goal_layout.values() for index in range(place.start, place.stop)]
    assert places == list(range(env.observation_spec["goal"].shape[-1]))


@every_task
@every_character
def test_nothing_touches_at_first_but_what_stands_on_something(task, character):
    env = make(task, character, 64, object_distances=(0.0, 1.5), target_distances=(0.0, 1.5))
    env.reset()
    allowed = [{"world", foot} for foot in env.character.feet]
    allowed += [{"world", "ball"}, {"source", "box"}]
    for index in range(64):
        data, model = env.simulation.data(index), env.simulation.model
        for pair in data.contact.geom:
            bodies = {model.body(model.geom_bodyid[geom]).name for geom in pair}
            assert bodies in allowed, index


@every_task
def test_distances_are_drawn_evenly_and_directions_in_all_directions(task):
    env = make(task, num_envs=1000, object_distances=(2.0, 6.0), target_distances=(1.0, 3.0))
    env.reset()
    places = env.simulation.state["qpos"][:, -7:-5]
    targets = env.simulation.state["mocap_pos"][:, 0, :2]
    for way, low, high in ((places, 2.0, 6.0), (targets - places, 1.0, 3.0)):
        share = (way.norm(dim=-1) - low) / (high - low)
        assert (share >= 0).all()
        assert (share <= 1).all()
        quarters = torch.histc(share, 4, 0, 1)
        assert (quarters - 250).abs().max() < 5 * math.sqrt(250 * 0.75)
        directions = torch.histc(torch.atan2(way[:, 1], way[:, 0]), 4, -math.pi, math.pi)
        assert (directions - 250).abs().max() < 5 * math.sqrt(250 * 0.75)


@every_task
def test_pictures_show_the_target_and_the_arrows_to_it(task):
    env = make(task, num_envs=2, target_distances=(0.6, 0.6))
    env.reset()
    state = env.get_state()
    state["qpos"][:, -7:-5] = torch.tensor([1.0, 0.0])
    state["mocap_pos"][:, 0, :2] = torch.tensor([[1.6, 0.0], [-1.6, 0.0]])
    env.reset(state, set_state=True)
    try:
        pictures = [env.render(index, width=320, height=240, distance=5.0).long() for index in range(2)]
    except (RuntimeError, mujoco.FatalError) as error:
        pytest.skip(str(error))
    red = [((p[..., 0] > 110) & (p[..., 1] < 70) & (p[..., 2] < 70)).nonzero()[:, 1].float() for p in pictures]
    env.close()
    assert red[0].max() > 230  # the camera looks along y at the character: x points right
    assert red[1].min() < 90
