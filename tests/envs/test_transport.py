import math

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torchrl.envs.utils import check_env_specs

from torchrl_mcp.envs import Carry, Dribble
from torchrl_mcp.envs.characters import CHARACTERS

every_task = pytest.mark.parametrize("task", [Carry, Dribble])
every_character = pytest.mark.parametrize("character", CHARACTERS)


@pytest.fixture(autouse=True)
def _log_elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs divergence in the working directory


def make(task, character="biped", num_envs=4, **kwargs):
    return task(character, num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def actions(env, num_steps, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(num_steps, *env.action_spec.shape, generator=generator) * 0.4 - 0.2


def play(env, carrier, script):
    """Step through ``script`` with partial resets; the stacked steps, and the last carrier."""
    steps = []
    for action in script:
        step, carrier = env.step_and_maybe_reset(carrier.set("action", action))
        steps.append(step.select("observation", "goal", "success", "action", "next").clone())
    return torch.stack(steps), carrier


def assert_identical(one, other):
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]), key


def things(env, index):
    """Target and object of a simulation, as bodies of MuJoCo's."""
    data = env.simulation.data(index)
    return data.body("target"), data.body(env.simulation.model.nbody - 1)


def centre_of_mass(env, index):
    """Of the character, from the masses and places of its bodies."""
    masses = env.simulation.model.body_mass.copy()
    masses[env.simulation.model.body("target").id :] = 0
    return masses @ env.simulation.data(index).xipos / masses.sum()


@every_task
@every_character
def test_specs_describe_what_the_environment_does(task, character):
    env = make(task, character, 2)
    check_env_specs(env, seed=0)
    assert env.observation_spec["goal"].shape == (2, {Carry: 27, Dribble: 16}[task])


@every_task
@every_character
def test_the_same_seed_gives_the_same_trajectory_at_any_number_of_threads(task, character):
    runs = []
    for num_threads in (1, 2):
        env = make(task, character, num_threads=num_threads, max_episode_steps=8)
        runs.append(play(env, env.reset(), actions(env, 20))[0])
    assert runs[0]["next", "done"].sum() >= 8
    assert_identical(*runs)


@every_task
@every_character
def test_a_partial_reset_leaves_the_neighbours_alone(task, character):
    env = make(task, character)
    _, carrier = play(env, env.reset(), actions(env, 3))
    before = env.get_state()
    after = env.reset(carrier.set("_reset", torch.tensor([[False], [True], [False], [False]])))
    state, others = env.get_state(), [0, 2, 3]
    assert_identical(state[others], before[others])
    assert torch.equal(after["goal"][others], carrier["goal"][others])
    assert not torch.equal(state["mocap_pos"][1], before["mocap_pos"][1])
    assert not torch.equal(state["qpos"][1, -7:-5], before["qpos"][1, -7:-5])


@every_task
@every_character
def test_a_restored_environment_continues_bit_for_bit(task, character):
    env = make(task, character, max_episode_steps=12)
    script = actions(env, 24)
    _, carrier = play(env, env.reset(), script[:9])
    state, generator = env.get_state(), env.generator.get_state()
    onward, _ = play(env, carrier.clone(), script[9:])
    other = make(task, character, max_episode_steps=12, seed=9)
    play(other, other.reset(), script[:2])
    other.generator.set_state(generator)
    restored = other.reset(state, set_state=True)
    assert_identical(
        restored.select("observation", "goal", "success"), carrier.select("observation", "goal", "success")
    )
    again, _ = play(other, restored, script[9:])
    assert_identical(onward, again)


@every_task
@every_character
def test_a_diverging_simulation_ends_its_own_episode_only(task, character):
    env, calm = make(task, character), make(task, character)
    calm.reset()
    state, script = calm.get_state(), actions(calm, 1)
    expected, _ = play(calm, calm.reset(state.clone(), set_state=True), script)
    state["qvel"][2] = 1e8
    before = env.reset(state, set_state=True)
    goal = before["goal"].clone()
    steps, _ = play(env, before, script)
    assert steps["next", "terminated"].flatten().tolist() == [False, False, True, False]
    assert steps["next", "reward"][0, 2] == 0
    assert torch.equal(steps["next", "goal"][0, 2], goal[2])
    assert steps["next", "goal"].isfinite().all()
    assert_identical(steps[:, [0, 1, 3]], expected[:, [0, 1, 3]])


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
def test_velocities_in_the_reward_are_displacements_over_the_step(task):
    env = make(task, num_envs=1, dtype=torch.float64, terminate_on_fall=False)
    env.reset()
    state = env.get_state()
    state["qpos"][:, [2, -5]] += 3.0  # both in the air, where they fall freely
    state["qvel"][:, :2], state["qvel"][:, -6:-4] = torch.tensor([0.4, 0.3]), torch.tensor([-0.2, 0.6])
    carrier = env.reset(state, set_state=True)
    before = centre_of_mass(env, 0), things(env, 0)[1].xpos.copy()
    reward = env.step(carrier.set("action", torch.zeros(env.action_spec.shape)))["next", "reward"].item()
    target, thing = things(env, 0)
    com, place, goal = (x[:2] for x in (centre_of_mass(env, 0), thing.xpos, target.xpos))
    terms = []
    for now, then, aim, pace in ((com, before[0], place, 1.5), (place, before[1], goal, 1.0)):
        along = (now - then[:2]) * 30 @ (aim - now) / np.linalg.norm(aim - now)
        terms.append(math.exp(-pace * min(0.0, along - 1) ** 2))
    scale, weights = {Carry: (0.25, (0.1, 0.2, 0.3, 0.4)), Dribble: (0.5, (0.1, 0.1, 0.3, 0.5))}[task]
    near = math.exp(-scale * np.square(place - com).sum()), math.exp(-0.5 * np.square(goal - place).sum())
    expected = np.dot(weights, [terms[0], near[0], terms[1], near[1]])
    assert reward == pytest.approx(expected, rel=1e-9)


def near_success(env):
    """A state of two simulations, of which the first is a success and the second is not by some centimetres."""
    env.reset()
    state = env.get_state()
    away = {Dribble: [[0.0, 0.47], [0.0, 0.53]], Carry: [[0.0, 0.1], [0.0, 0.15]]}[type(env)]
    state["mocap_pos"][:, 0, :2] = state["qpos"][:, -7:-5] + torch.tensor(away)
    if "taken" in state:  # a box that was put down on the target
        state["taken"].fill_(1)
        state["mocap_pos"][:, 0, 2], state["mocap_pos"][:, 1, 0] = state["mocap_pos"][:, 1, 2], 9.0
        state["mocap_quat"][:, 0] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    return state


@every_task
@pytest.mark.parametrize("success_reward", [False, True])
def test_success_has_a_limit_and_may_be_worth_one(task, success_reward):
    env = make(task, num_envs=2, object_distances=(1.0, 1.0), success_reward=success_reward)
    state = near_success(env)
    carrier = env.reset(state, set_state=True)
    assert carrier["success"].flatten().tolist() == [True, False]
    outcome = env.step(carrier.set("action", torch.zeros(2, 17)))["next"]
    assert outcome["success"].flatten().tolist() == [True, False]
    assert (outcome["reward"] == 1).flatten().tolist() == [success_reward, False]


@every_task
def test_a_fallen_character_earns_nothing_from_success(task):
    env = make(task, num_envs=2, success_reward=True, object_distances=(1.0, 1.0))
    state = near_success(env)
    state["qpos"][:, 2], state["qpos"][:, 3:7] = 0.05, torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])
    outcome = env.step(env.reset(state, set_state=True).set("action", torch.zeros(2, 17)))["next"]
    assert outcome["success"][0]
    assert outcome["terminated"].all()
    assert (outcome["reward"] == 0).all()


@every_task
def test_positions_and_velocities_alone_are_a_state(task):
    env = make(task)
    env.reset()
    whole = env.get_state()
    env.reset(whole.select("qpos", "qvel"), set_state=True)
    state = env.get_state()
    assert torch.equal(state["qpos"], whole["qpos"])
    assert not torch.equal(state["mocap_pos"], whole["mocap_pos"])
    assert torch.equal(state["object"], whole["qpos"][:, -7:-4])


@every_task
def test_the_best_possible_return_is_one_and_the_worst_zero(task):
    env = make(task, num_envs=1, max_episode_steps=50)
    torch.testing.assert_close(env.normalised_return(torch.tensor([0.0, 25.0, 50.0])), torch.tensor([0.0, 0.5, 1.0]))
    assert make(task, num_envs=1).max_episode_steps == 3000


@every_task
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"object_distances": (-1.0, 2.0)}, "object_distances=.*begins below 0"),
        ({"object_distances": (3.0, 2.0)}, "object_distances=.*is no interval"),
        ({"object_distances": (0.0, 0.3)}, "object_distances=.*where bodies overlap: let it end beyond"),
        ({"target_distances": (-0.1, 2.0)}, "target_distances=.*begins below 0"),
        ({"target_distances": (1.0, math.inf)}, "target_distances=.*is no interval"),
        ({"speed": -1.0}, "speed=-1.0 is out of range"),
        ({"target_distance_power": 3}, "target_distance_power=3 is out of range"),
        ({"character": "horse"}, "character='horse' is unknown"),
    ],
)
def test_wrong_arguments_are_named_with_a_remedy(task, arguments, message):
    with pytest.raises(ValueError, match=message):
        make(task, **arguments)


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
