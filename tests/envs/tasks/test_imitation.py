import math

import mujoco
import numpy as np
import pytest
import torch
from refusals import refused
from scipy.spatial.transform import Rotation
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_mcp.envs import Imitation
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions import MotionClip
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.motions.placement import Placement
from torchrl_mcp.envs.tasks.imitation_reward import ERRORS

every_character = pytest.mark.parametrize("character", CHARACTERS)
TERMS = {"pose": {"weight": 0.6, "scale": 3.0}, "root_pose": {"weight": 0.4, "scale": 5.0}}
SPEED, TURN = 0.6, 0.5


def gliding(character, *, seconds=2.0, turn=0.0, loop=False):
    """The rest pose, sliding forward at SPEED while turning at the rate ``turn``, 30 frames per second."""
    frames = round(seconds * 30) + 1
    qpos = torch.from_numpy(CHARACTERS[character].spec().compile().qpos0).repeat(frames, 1)
    angle = turn * torch.arange(frames, dtype=torch.float64) / 30
    steps = torch.stack([angle.cos(), angle.sin()], -1) * SPEED / 30
    qpos[1:, :2] = steps[:-1].cumsum(0)
    qpos[:, 3:7] = torch.tensor(Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_quat(scalar_first=True))
    return MotionClip(character, qpos, 30.0, loop)


def make(character="biped", num_envs=4, clips=None, **kwargs):
    library = MotionLibrary(clips or {"glide": gliding(character, loop=True)})
    defaults = {"terms": TERMS, "seed": 0, "num_threads": 1, "switch_interval": math.inf, "dtype": torch.float64}
    return Imitation(character, library, num_envs, **{**defaults, **kwargs})


def reference_of(env):
    """Where the references are now."""
    clip, time, turn, shift = (env.episode[key] for key in ("clip", "time", "turn", "shift"))
    return env.library.at(clip, time, Placement(turn, shift))


def idle(env, state):
    return env.step(state.set("action", torch.zeros(env.action_spec.shape, dtype=torch.float64)))["next"]


def test_a_reset_of_nobody_draws_no_motion():
    env = make()
    step = env.rand_step(env.reset())["next"]
    after = env.reset(step.clone().set("_reset", torch.zeros(4, 1, dtype=torch.bool)))
    assert torch.equal(after["observation"], step["observation"])


@every_character
def test_specs_describe_what_the_environment_does(character):
    check_env_specs(make(character), seed=0)


@every_character
def test_an_episode_begins_in_a_state_of_the_reference(character):
    env = make(character, 64, clips={"turn": gliding(character, turn=TURN)})
    env.reset()
    state = env.get_state()
    assert state["time"].min() < 0.3
    assert state["time"].max() > 1.7
    reference = reference_of(env)
    torch.testing.assert_close(reference.qpos, state["qpos"])
    torch.testing.assert_close(state["qvel"][:, 5], torch.full((64,), TURN, dtype=torch.float64), atol=1e-3, rtol=0)
    torch.testing.assert_close(state["qpos"][:, :2], torch.zeros(64, 2, dtype=torch.float64))
    assert all(env._error(name, reference).max() < 1e-9 for name in ERRORS)


@every_character
def test_the_goal_shows_the_next_two_states_as_the_character_sees_them(character):
    env = make(character, 1)
    goal = env.reset()["goal"].view(2, -1, 13)
    model = env.simulation.model
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for step, target in enumerate(goal, start=1):
        shift = [SPEED * step / 30, 0, 0]
        np.testing.assert_allclose(target[:, :3], data.xpos[1 : 1 + len(target)] + shift, atol=1e-9)
        np.testing.assert_allclose(target[:, 3:7].abs(), np.abs(data.xquat[1 : 1 + len(target)]), atol=1e-9)
        np.testing.assert_allclose(target[:, 7:10], np.tile([SPEED, 0, 0], (len(target), 1)), atol=1e-9)
        np.testing.assert_allclose(target[:, 10:], 0, atol=1e-9)


def test_the_goal_does_not_depend_on_the_place_or_heading_in_the_world():
    env = make(num_envs=2)
    env.reset()
    state, angle = env.get_state(), 1.2
    state["clip"], state["time"] = state["clip"][:1].expand(2), state["time"][:1].expand(2)
    state["qpos"][1, :2] += torch.tensor([3.0, -4.0])
    turn = Rotation.from_euler("z", angle)
    state["qpos"][1, 3:7] = torch.tensor((turn * Rotation.identity()).as_quat(scalar_first=True))
    state["qvel"][1, :3] = torch.tensor(turn.apply(state["qvel"][0, :3]))
    state["turn"][1], state["shift"][0] = angle, state["shift"][0]
    place = env.library.at(state["clip"][:1], state["time"][:1]).qpos[0, :3]
    state["shift"][1] = state["qpos"][1, :2] - torch.tensor(turn.apply(place))[:2]
    goal = env.reset(state, set_state=True)["goal"]
    torch.testing.assert_close(goal[1], goal[0])


def test_a_shifted_character_has_the_errors_of_the_shift():
    env = make(num_envs=1)
    env.reset()
    state = env.get_state()
    state["qpos"][:, 0] += 0.1
    state["qvel"][:, 2] += 0.5
    start = env.simulation.model.joint("right_knee").qposadr[0]
    state["qpos"][:, start] -= 0.2
    env.reset(state, set_state=True)
    errors = {name: env._error(name, reference_of(env)).item() for name in ERRORS}
    assert errors["pose"] == pytest.approx(0.2**2 / 7)  # of seven joints
    assert errors["root_pose"] == pytest.approx(0.1**2)
    others = [body for body in env.library.body_names if body not in ("right_knee", "right_ankle")]
    assert errors["bodies"] >= 0.1**2 * len(others) / 8
    assert errors["bodies"] == pytest.approx(0.1**2, abs=0.005)
    assert errors["orientations"] == pytest.approx(0.2**2 * 2 / 8)  # of shank and foot
    assert errors["root_velocity"] == pytest.approx(0.5**2)
    assert errors["velocity"] == pytest.approx(0)
    assert errors["com"] == pytest.approx(0.1**2, abs=0.002)  # the shank has moved a little, too


@pytest.mark.parametrize(("distance", "lost"), [(0.27, False), (0.33, True)])
def test_losing_the_reference_ends_the_episode_without_reward(distance, lost):
    env = make(num_envs=2, max_error=0.3)
    env.reset()
    state = env.get_state()
    state["qpos"][1, 1] += distance
    outcome = idle(env, env.reset(state, set_state=True))
    assert outcome["terminated"].flatten().tolist() == [False, lost]
    assert outcome["tracking_error"][1].item() == pytest.approx(distance, abs=0.02)
    assert outcome["reward"][0] > 0.9
    assert (outcome["reward"][1] == 0) == lost


def test_the_end_of_a_clip_truncates_and_the_end_of_a_cycle_does_not():
    for loop in (False, True):
        env = make(num_envs=1, clips={"short": gliding("biped", seconds=0.5, loop=loop)})
        state = env.reset()
        env.reset(env.get_state().update({"time": torch.zeros(1, dtype=torch.float64)}), set_state=True)
        ends = []
        for _ in range(14):
            state = idle(env, state)
            ends.append((state["truncated"].item(), state["terminated"].item()))
        assert ends[:12] == [(False, False)] * 12
        assert ends[13] == (not loop, False)  # the goal looks two steps beyond the 14th of 15


def test_the_end_of_a_clip_may_lead_to_another_reference_instead():
    clips = {"short": gliding("biped", seconds=1.0)}
    env = make(num_envs=16, clips=clips, clip_end="switch", max_error=10.0, terminate_on_fall=False)
    state = env.reset()
    for _ in range(60):
        state = idle(env, state)
        assert not state["done"].any()
    assert (env.episode["time"] <= 1.0).all()


def test_a_new_reference_begins_where_the_character_is_and_faces():
    clips = {"turn": gliding("biped", turn=TURN), "other": gliding("biped", turn=-TURN)}
    env = make(num_envs=256, clips=clips, switch_interval=0.5)
    state = idle(env, env.reset())
    before, during = env.get_state(), idle(env, state)
    after = env.get_state()
    switched = (after["time"] - before["time"] - 1 / 30).abs() > 1e-9
    assert switched.float().mean().item() == pytest.approx(1 / 15, abs=4 * math.sqrt(1 / 15 / 256))
    reference = reference_of(env)
    torch.testing.assert_close(reference.qpos[switched, :2], after["qpos"][switched, :2])
    facing = [
        Rotation.from_quat(q[switched, 3:7], scalar_first=True).apply([1, 0, 0])[:, :2]
        for q in (reference.qpos, after["qpos"])
    ]
    cross = facing[0][:, 0] * facing[1][:, 1] - facing[0][:, 1] * facing[1][:, 0]
    np.testing.assert_allclose(cross, 0, atol=1e-9)
    assert not during["terminated"].any()


def test_of_several_candidates_the_most_similar_becomes_the_reference():
    clips = {"turn": gliding("biped", turn=TURN), "other": gliding("biped", turn=-TURN)}
    found = {}
    for candidates in (1, 64):
        env = make(num_envs=256, clips=clips, switch_candidates=candidates)
        state, clip = env.reset(), env.episode["clip"].clone()
        env.switch_probability = 1.0
        idle(env, state)
        # Nothing but the turn tells the clips apart, and everything else is alike all along.
        found[candidates] = (env.episode["clip"] == clip).double().mean().item()
    assert found[1] == pytest.approx(0.5, abs=0.13)
    assert found[64] == 1.0


def test_a_reference_may_stay_the_same_and_come_back_to_the_character():
    clips = {"turn": gliding("biped", turn=TURN, loop=True), "other": gliding("biped", turn=-TURN, loop=True)}
    env = make(num_envs=64, clips=clips, switch_to="same", max_error=10.0, terminate_on_fall=False)
    state = env.reset()
    for _ in range(30):
        state = idle(env, state)
    assert state["tracking_error"].min() > 0.2
    clip = env.episode["clip"].clone()
    env.switch_probability = 1.0
    idle(env, state)
    assert torch.equal(env.episode["clip"], clip)
    torch.testing.assert_close(reference_of(env).qpos[:, :2], env.get_state()["qpos"][:, :2])


def test_the_terms_of_the_reward_are_told():
    env = make(num_envs=2)
    outcome = idle(env, env.reset())
    assert env.metric_names["reward_terms"] == ["reward_pose", "reward_root_pose"]
    torch.testing.assert_close(outcome["reward_terms"].sum(-1, keepdim=True), outcome["reward"])


def test_the_same_state_continues_alike():
    env = make(num_envs=8, switch_interval=0.3)
    env.reset()
    saved, generator, runs = env.get_state(), env.generator.get_state(), []
    for _ in range(2):
        env.generator.set_state(generator)
        state = env.reset(saved.clone(), set_state=True)
        runs.append(torch.stack([(state := idle(env, state))["goal"].clone() for _ in range(20)]))
    assert torch.equal(*runs)


def test_a_checkpoint_knows_its_motions():
    states = [make(clips={"glide": gliding("biped", turn=turn)}).get_extra_state() for turn in (0.0, TURN)]
    env = make(clips={"glide": gliding("biped", turn=TURN)})
    env.set_extra_state(states[1])
    refused(lambda: env.set_extra_state(states[0]), "motions")


def test_the_best_possible_return_is_one():
    env = make(num_envs=1, max_episode_steps=20)
    assert env.normalised_return(torch.tensor(20.0)).item() == pytest.approx(1.0)
    state = TensorDict({"qpos": env.get_state()["qpos"], "qvel": env.get_state()["qvel"]}, [1])
    assert env.reset(state, set_state=True)["tracking_error"].item() == 0


def test_a_fall_near_the_reference_ends_the_episode_without_reward():
    env = make(num_envs=2, max_error=10.0)
    env.reset()
    state = env.get_state()
    state["qpos"][1, 2] = 0.05
    state["qpos"][1, 3:7] = torch.tensor([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])  # on its face
    outcome = idle(env, env.reset(state, set_state=True))
    assert outcome["terminated"].flatten().tolist() == [False, True]
    assert outcome["reward"][0] > 0
    assert outcome["reward"][1] == 0
    assert outcome["reward_terms"][1].sum() > 0  # they are told as they were before the fall


def test_after_a_partial_reset_the_new_reference_counts_from_the_first_step_on():
    env = make(num_envs=8, clips={"turn": gliding("biped", turn=TURN)})
    env.reset()
    state = env.get_state()
    state["qpos"][::2, 1] += 1.0  # every other one has lost its reference
    carrier = env.reset(state, set_state=True).set("action", torch.zeros(env.action_spec.shape, dtype=torch.float64))
    outcome, carrier = env.step_and_maybe_reset(carrier)
    assert outcome["next", "terminated"].flatten().tolist() == [True, False] * 4
    after = idle(env, carrier)
    distances = (env.simulation.outputs["xpos"][:, 1:] - reference_of(env).positions).norm(dim=-1).mean(-1)
    torch.testing.assert_close(after["tracking_error"].squeeze(-1), distances)
