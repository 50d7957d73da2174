import pytest
import torch
from refusals import refused
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import check_env_specs

from torchrl_mcp.envs import Holdout

CONTACTS = pytest.mark.parametrize("contact_forces", [False, True], ids=["no_contacts", "contacts"])


def make(num_envs=4, **kwargs):
    return Holdout(num_envs, (0.0, 4.0), **{"seed": 0, "num_threads": 1, **kwargs})


def actions(num_steps, num_envs=4, seed=1):
    return torch.rand(num_steps, num_envs, 8, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def play(env, tensordict, script):
    """Step through ``script`` with partial resets; the stacked steps, and the last carrier."""
    steps = []
    for action in script:
        step, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
        steps.append(step.select("observation", "goal", "action", "next").clone())
    return torch.stack(steps), tensordict


def assert_identical(one, other):
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]), key


@CONTACTS
def test_specs_describe_what_the_environment_does(contact_forces):
    check_env_specs(make(contact_forces=contact_forces), seed=0)


def test_the_same_seed_gives_the_same_trajectory_at_any_number_of_threads():
    runs = []
    for num_threads in (1, 2, 4):
        env = make(8, num_threads=num_threads, max_episode_steps=20)
        runs.append(play(env, env.reset(), actions(60, 8))[0])
    assert runs[0]["next", "done"].sum() > 16
    assert_identical(runs[0], runs[1])
    assert_identical(runs[0], runs[2])


def test_setting_the_seed_again_repeats_the_trajectory():
    env = make()
    env.set_seed(5)
    first, _ = play(env, env.reset(), actions(5))
    env.set_seed(5)
    again, _ = play(env, env.reset(), actions(5))
    env.set_seed(6)
    other, _ = play(env, env.reset(), actions(5))
    assert_identical(first, again)
    assert not torch.equal(first["observation"], other["observation"])


def test_a_reset_may_give_the_seed_and_refuses_what_it_does_not_know():
    first, other = make(seed=1), make(seed=2)
    assert torch.equal(first.reset(seed=5)["observation"], other.reset(seed=5)["observation"])
    refused(lambda: first.reset(sead=5), "'sead'", error=TypeError)


def test_the_physics_does_not_move_to_another_device():
    env = make()
    assert env.to("cpu") is env
    refused(lambda: env.to("cuda"), "device=cuda", "cpu")


def test_a_reset_of_nobody_changes_nothing():
    env = make()
    _, carrier = play(env, env.reset(), actions(3))
    before = env.get_state()
    after = env.reset(carrier.set("_reset", torch.zeros(4, 1, dtype=torch.bool)))
    assert_identical(env.get_state(), before)
    assert torch.equal(after["observation"], carrier["observation"])


def test_an_environment_without_a_seed_draws_one_from_torch():
    torch.manual_seed(3)
    first = make(seed=None).reset()
    torch.manual_seed(3)
    again = make(seed=None).reset()
    assert torch.equal(first["observation"], again["observation"])
    assert not torch.equal(first["observation"], make(seed=None).reset()["observation"])


def test_the_time_limit_truncates_and_does_not_terminate():
    env = make(max_episode_steps=7, terminate_when_unhealthy=False)
    steps, _ = play(env, env.reset(), actions(14))
    assert steps["next", "truncated"].nonzero()[:, 0].unique().tolist() == [6, 13]
    assert torch.equal(steps["next", "truncated"], steps["next", "done"])
    assert not steps["next", "terminated"].any()


def test_a_collector_stores_the_last_observation_of_an_episode_and_goes_on_from_a_new_one():
    env = make(max_episode_steps=5)
    batch = next(iter(Collector(env, env.rand_action, frames_per_batch=4 * 12, total_frames=4 * 12)))
    assert batch.shape == (4, 12)
    done = batch["next", "done"].squeeze(-1)[:, :-1]
    assert done.any(1).all()
    gap = (batch["observation"][:, 1:] - batch["next", "observation"][:, :-1]).abs().amax(-1)
    assert (gap[done] > 0.01).all()
    assert (gap[~done] == 0).all()


def test_a_partial_reset_leaves_the_neighbours_alone():
    env = make()
    _, carrier = play(env, env.reset(), actions(3))
    before = env.get_state()
    mask = torch.tensor([[False], [True], [False], [False]])
    after = env.reset(carrier.set("_reset", mask))
    state, others = env.get_state(), [0, 2, 3]
    assert_identical(state[others], before[others])
    assert torch.equal(after["observation"][others], carrier["observation"][others])
    assert state["elapsed_steps"].flatten().tolist() == [3, 0, 3, 3]
    assert (state["qpos"][1, 2] - 0.75).abs() <= 0.1


def test_steps_and_partial_resets_are_those_that_torchrl_makes():
    (ours, torchrls) = (make(8, max_episode_steps=20) for _ in range(2))
    state, expected_state, num_ended = ours.reset(), torchrls.reset(), 0
    for action in actions(60, 8):
        step, state = ours.step_and_maybe_reset(state.set("action", action))
        expected, expected_state = EnvBase.step_and_maybe_reset(torchrls, expected_state.set("action", action))
        assert_identical(step, expected)
        assert_identical(state.exclude("action"), expected_state.exclude("action"))  # zeros where episodes begin
        num_ended += step["next", "done"].sum()
    assert num_ended > 16


def test_an_outcome_that_the_caller_prescribes_is_kept():
    env = make()
    start = env.reset().set("action", torch.zeros(4, 8)).set("next", TensorDict({"note": torch.ones(4)}, [4]))
    step, _ = env.step_and_maybe_reset(start)
    assert torch.equal(step["next", "note"], torch.ones(4))


def test_what_was_emitted_does_not_change_later():
    env = make(dtype=torch.float64)  # the type of the physics: nothing is converted
    start = env.reset()
    first = env.step(start.clone().set("action", torch.zeros(4, 8, dtype=torch.float64)))["next"]
    kept_start, kept_first = start.clone(), first.clone()
    play(env, first.clone(), actions(3).double())
    env.reset()
    assert_identical(start, kept_start)
    assert_identical(first, kept_first)


def test_the_environment_does_not_depend_on_what_it_emitted():
    one, other = make(), make()
    start, spoiled = one.reset(), other.reset()
    for value in spoiled.values():
        value.zero_()
    first, _ = play(one, start, actions(3))
    second, _ = play(other, spoiled, actions(3))
    assert torch.equal(first["next", "observation"], second["next", "observation"])
    assert torch.equal(first["next", "reward"], second["next", "reward"])


@CONTACTS
def test_a_diverging_simulation_ends_its_own_episode_only(contact_forces):
    env, calm = make(contact_forces=contact_forces), make(contact_forces=contact_forces)
    calm.reset()
    state, script = calm.get_state(), actions(10)
    kept = calm.reset(state.clone(), set_state=True)
    state["qvel"][2] = 1e8
    start = env.reset(state, set_state=True)
    before = start["observation"].clone()
    first, _ = play(env, start, script[:1])
    expected, _ = play(calm, kept, script[:1])
    assert first["next", "terminated"].flatten().tolist() == [False, False, True, False]
    assert not first["next", "truncated"].any()
    assert first["next", "reward"][0, 2] == 0
    assert torch.equal(first["next", "observation"][0, 2], before[2])
    assert env.num_diverged == 1
    assert_identical(first[:, [0, 1, 3]], expected[:, [0, 1, 3]])


@CONTACTS
def test_faults_never_emit_a_number_that_is_not_finite(contact_forces):
    env = make(contact_forces=contact_forces)
    script = actions(30)
    script[3, 0, 2], script[10, 1, 7], script[11:20, 2] = float("nan"), float("inf"), 1e20
    steps, _ = play(env, env.reset(), script)
    assert env.num_diverged == 1 + 1 + 9
    for key in ("observation", "goal", "reward"):
        assert steps["next", key].isfinite().all(), key
    assert steps["next", "terminated"][11:20, 2].all()


def test_stepping_on_after_a_fault_without_a_reset_stays_finite():
    env = make(terminate_when_unhealthy=False)
    carrier, script = env.reset(), actions(6)
    script[1, 0] = float("nan")
    for action in script:
        carrier = env.step(carrier.set("action", action))["next"]
        assert carrier["observation"].isfinite().all()
        assert carrier["reward"].abs().max() < 100


@CONTACTS
def test_a_restored_environment_continues_bit_for_bit(contact_forces):
    env = make(6, contact_forces=contact_forces, max_episode_steps=25)
    script = actions(90, 6)
    _, carrier = play(env, env.reset(), script[:40])
    state, generator = env.get_state(), env.generator.get_state()
    onward, _ = play(env, carrier.clone(), script[40:])
    assert onward["next", "done"].sum() > 6

    other = make(6, contact_forces=contact_forces, max_episode_steps=25, seed=9)
    play(other, other.reset(), script[:7])
    other.generator.set_state(generator)
    restored = other.reset(state, set_state=True)
    assert torch.equal(restored["observation"], carrier["observation"])
    assert torch.equal(restored["goal"], carrier["goal"])
    again, _ = play(other, restored, script[40:])
    assert_identical(onward, again)


def test_a_state_dict_carries_the_run_over():
    env = make(max_episode_steps=25)
    script = actions(60)
    _, carrier = play(env, env.reset(), script[:30])
    saved = env.state_dict()
    onward, _ = play(env, carrier.clone(), script[30:])
    other = make(max_episode_steps=25, seed=9)
    other.load_state_dict(saved)
    again, _ = play(other, other.reset(), script[30:])
    assert torch.equal(onward["next", "observation"], again["next", "observation"])
    assert torch.equal(onward["next", "reward"], again["next", "reward"])


def test_a_state_can_be_restored_twice():
    env = make()
    env.reset()
    state = env.get_state()
    first, _ = play(env, env.reset(state, set_state=True), actions(5))
    again, _ = play(env, env.reset(state, set_state=True), actions(5))
    assert_identical(first, again)


def test_positions_and_velocities_alone_are_a_state():
    env = make()
    play(env, env.reset(), actions(4))
    whole = env.get_state()
    after = env.reset(whole.select("qpos", "qvel"), set_state=True)
    state = env.get_state()
    assert torch.equal(state["qpos"], whole["qpos"])
    assert torch.equal(state["qvel"], whole["qvel"])
    assert not state["elapsed_steps"].any()
    assert not state["time"].any()
    assert torch.equal(state["position"], state["qpos"][:, :2])
    assert torch.equal(after["goal"], state["goal"])
    assert not torch.equal(state["goal"], whole["goal"])


def test_a_goal_may_be_given_with_positions_and_velocities():
    env = make()
    env.reset()
    state = env.get_state().select("qpos", "qvel").set("goal", torch.tensor([[0.0, 1.0]]).expand(4, 2))
    assert env.reset(state, set_state=True)["goal"].tolist() == [[0.0, 1.0]] * 4


def test_a_state_may_be_set_in_some_simulations_only():
    env = make()
    env.reset()
    state, before = env.get_state(), env.get_state()
    state["qvel"] += 1
    state["qpos"][0] = float("nan")  # in a row that is not set
    env.reset(state.set("_reset", torch.tensor([[False], [True], [False], [True]])), set_state=True)
    assert_identical(env.get_state()[[0, 2]], before[[0, 2]])
    assert torch.equal(env.get_state()["qvel"][[1, 3]], before["qvel"][[1, 3]] + 1)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (lambda s: s.exclude("qvel"), ["'qvel'"]),
        (lambda s: s.set("qpos", torch.zeros(4, 14)), ["qpos", "(4, 14)", "(4, 15)"]),
        (lambda s: s.set("speed", torch.zeros(4)), ["'speed'"]),
        (lambda s: s.set("qvel", torch.full((4, 14), float("nan"))), ["qvel"]),
        (lambda s: s.set("qvel", torch.full((4, 14), 1e11)), ["qvel", "1e+10"]),
        (lambda s: None, ["'qpos'", "'qvel'"]),
    ],
)
def test_a_state_that_does_not_fit_is_refused(change, names):
    env = make()
    env.reset()
    refused(lambda: env.reset(change(env.get_state()), set_state=True), *names)


@pytest.mark.parametrize("action", [torch.zeros(4, 7), torch.zeros(4, 8, 1), torch.zeros(4, 8, device="meta")])
def test_an_action_that_does_not_fit_is_refused(action):
    env = make()
    env.reset()
    refused(lambda: env.step(TensorDict({"action": action}, [4])), "action", "(4, 8)")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("num_envs", 0),
        ("num_envs", -3),
        ("max_episode_steps", 0),
        ("num_threads", -1),
        pytest.param("pin_memory", True, marks=pytest.mark.skipif(torch.cuda.is_available(), reason="has CUDA")),
    ],
)
def test_an_argument_out_of_range_is_refused(name, value):
    refused(lambda: make(**{name: value}), f"{name}={value}")


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_pinned_tensors_are_emitted_for_cuda():
    env = make(pin_memory=True)
    assert env.reset()["observation"].is_pinned()


def test_no_frames_are_skipped_behind_the_users_back():
    env = make()
    assert type(env) is Holdout
    assert not hasattr(env, "frame_skip")
    assert env.control_timestep == pytest.approx(0.05)
