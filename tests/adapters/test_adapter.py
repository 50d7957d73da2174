"""Environments of TorchRL as the adapter shows them, against what a loop by hand over the environments shows."""

import warnings

import numpy as np
import pytest
import torch
from points import Lasting, Points, play
from refusals import refused
from torchrl.collectors import Collector
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import TransformedEnv, check_env_specs

from torchrl_mcp.adapters.adapter import Adapter, OwnEnvs
from torchrl_mcp.adapters.autoreset import RepeatObservation
from torchrl_mcp.adapters.check import require_contract, require_specs
from torchrl_mcp.adapters.reading import Scaling


def adapted(env=None, **settings):
    return Adapter(env or Points(), **{"observation": ["place"], "max_episode_steps": 4, **settings})


def test_an_adapted_environment_satisfies_the_contract_and_its_specs():
    env = adapted(metrics=["far"])
    require_contract(env)
    require_specs(env)
    check_env_specs(env)


def test_what_it_shows_is_what_the_environments_show():
    actions = torch.linspace(-1.5, 1.5, 27).view(9, 3, 1)
    outcome = play(adapted(Points(seed=0), metrics=["far"], max_episode_steps=100), actions)
    env = Points(seed=0)
    x = env.reset()["place"].flatten(1)[:, :1]
    for step, action in enumerate(actions):
        x = x + 1.0 + 2.0 * action.clamp(-1, 1)  # from -1 to 3
        torch.testing.assert_close(outcome["next", "observation"][:, step], torch.cat([x, -x, 2 * x, x * 0 + 1], -1))
        torch.testing.assert_close(outcome["next", "reward"][:, step], x)
        assert torch.equal(outcome["next", "far"][:, step], x > 2.0)
        assert torch.equal(outcome["next", "terminated"][:, step], x > 5.0)
        if (x > 5.0).any():
            break
    assert step > 3
    assert outcome["goal"].shape == (3, 9, 0)
    first = outcome["observation"][:, step + 1, 0][(x > 5.0).squeeze(-1)]
    assert ((first > 0) & (first < 1)).all()  # of the next episode


def test_the_time_limit_truncates_each_episode_by_itself_and_the_others_go_on():
    outcome = play(adapted(Points(2), max_episode_steps=4), torch.tensor([[[0.9], [-0.5]]]).repeat(8, 1, 1))
    terminated, truncated = (outcome["next", key].squeeze(-1) for key in ("terminated", "truncated"))
    assert terminated[0].tolist() == [False, True] * 4  # 2.8 a step, from at most 1
    assert not truncated[0].any()
    assert not terminated[1].any()
    assert truncated[1].tolist() == [False, False, False, True] * 2
    assert torch.equal(outcome["next", "done"], outcome["next", "terminated"] | outcome["next", "truncated"])
    place = outcome["observation"][1, :, 0]
    torch.testing.assert_close(place[:4], place[:1].expand(4))  # an action of -0.5 is 0
    assert place[4] != place[0]


def test_the_fast_step_is_that_of_torchrl():
    actions = torch.rand(20, 3, 1, generator=torch.Generator().manual_seed(1)) * 2 - 1
    fast = play(adapted(Points(seed=0)), actions)
    env = adapted(Points(seed=0))
    slow = play_with_torchrl(env, actions)
    assert fast["next", "done"].sum() > 6
    for key in ("observation", "reward", "terminated", "truncated", "done"):
        assert torch.equal(fast["next", key], slow["next", key]), key


def play_with_torchrl(env, actions):
    state, outcomes = env.reset(), []
    for action in actions:
        step = env.step(state.set("action", action))
        outcomes.append(step.clone())
        state = env.maybe_reset(env.step_mdp(step))
    return torch.stack(outcomes, 1)


def test_returns_are_scaled_to_the_worst_and_the_solved():
    returns = torch.tensor([-10.0, 0.0, 30.0])
    assert torch.equal(adapted().normalised_return(returns), returns)
    assert adapted(worst=-10, solved=30).normalised_return(returns).tolist() == [0.0, 0.25, 1.0]
    assert "worst" in refused(lambda: adapted(worst=3, solved=3), "worst", "solved")


def test_the_same_seed_gives_the_same_episodes():
    actions = torch.zeros(10, 3, 1)
    first, second, third = (
        play(OwnEnvs(Points, 3, seed=seed, observation=["place"], max_episode_steps=4), actions) for seed in (5, 5, 6)
    )
    assert torch.equal(first["observation"], second["observation"])
    assert not torch.equal(first["observation"], third["observation"])


def single():
    """A single environment, without a batch."""
    from torchrl.envs import GymEnv

    return GymEnv("Pendulum-v1")


def test_a_function_that_makes_a_single_environment_is_called_for_each():
    env = OwnEnvs(single, 2, seed=0, max_episode_steps=5)
    outcome = play(env, torch.zeros(6, 2, 1))
    assert outcome["next", "truncated"].squeeze(-1).tolist() == [[False] * 4 + [True] + [False]] * 2
    assert not torch.equal(outcome["observation"][0], outcome["observation"][1])
    env.close()


def test_environments_that_can_be_saved_go_on_from_where_they_were():
    actions = torch.rand(20, 3, 1, generator=torch.Generator().manual_seed(1)) * 2 - 1
    env = adapted(Lasting(seed=0), snapshots=True)
    play(env, actions[:9])
    saved = env.state_dict()
    state = env._emit(env._current, *torch.zeros(2, 3, 1, dtype=torch.bool))
    rest = []
    for action in actions[9:]:
        step, state = env.step_and_maybe_reset(state.set("action", action))
        rest.append(step.clone())
    rest = torch.stack(rest, 1)

    other = adapted(Lasting(seed=3), snapshots=True)
    other.load_state_dict(saved)
    again = play(other, actions[9:])
    for key in ("observation", ("next", "reward"), ("next", "done"), ("next", "truncated")):
        assert torch.equal(again[key], rest[key]), key
    assert other.resumes_episodes


def test_others_begin_new_episodes_with_another_seed_which_is_the_same_each_time():
    starts = []
    for _ in range(2):
        env = OwnEnvs(Points, 3, seed=0, observation=["place"], max_episode_steps=4)
        first = env.reset()["observation"]
        resumed = OwnEnvs(Points, 3, seed=0, observation=["place"], max_episode_steps=4)
        resumed.load_state_dict(env.state_dict())
        again = OwnEnvs(Points, 3, seed=0, observation=["place"], max_episode_steps=4)
        again.load_state_dict(resumed.state_dict())  # as a run that was interrupted twice
        starts.append((first, resumed.reset()["observation"], again.reset()["observation"]))
    assert not resumed.resumes_episodes
    assert torch.equal(starts[0][2], starts[1][2])
    assert not torch.equal(starts[0][2], starts[0][1])
    assert torch.equal(starts[0][1], starts[1][1])
    assert not torch.equal(starts[0][0], starts[0][1])


class Changed(Points):
    """Points with other specs or steps."""

    def __init__(self, action=None, observed=None, act=None):
        super().__init__()
        if action is not None:
            self.action_spec = action
        if observed is not None:
            self.observation_spec = Composite(place=observed, shape=[3])
        self.act = act

    def _step(self, tensordict):
        return self.act(super()._step(tensordict)) if self.act else super()._step(tensordict)


@pytest.mark.parametrize(
    ("env", "settings", "names"),
    [
        (Changed(action=Categorical(4, shape=(3,))), {}, ["action", "discrete"]),
        (Changed(action=Unbounded((3, 2))), {}, ["action_bounds"]),
        (Changed(action=Bounded(-torch.inf, 1.0, (3, 2))), {}, ["action_bounds"]),
        (Changed(observed=Unbounded((3, 64, 64, 3))), {}, ["place", "image", "(64, 64, 3)"]),
        (Changed(), {"observation": ["state"]}, ["observation", "state", "place"]),
        (Changed(), {"goal": ["target"]}, ["goal", "target", "place"]),
        (Changed(), {"max_episode_steps": None}, ["max_episode_steps"]),
        (single(), {}, ["SerialEnv"]),
    ],
)
def test_what_cannot_be_adapted_is_refused_with_the_reason(env, settings, names):
    refused(lambda: adapted(env, **settings), *names)


def test_bounds_of_ones_own_take_the_place_of_infinite_ones():
    env = adapted(Changed(action=Unbounded((3, 1))), action_bounds=[0.0, 4.0], max_episode_steps=9)
    outcome = play(env, torch.full((1, 3, 1), 0.5))
    moved = (outcome["next", "observation"] - outcome["observation"])[..., 0]
    torch.testing.assert_close(moved, torch.full_like(moved, 3.0))


def test_bounds_of_ones_own_are_on_the_device_of_the_environments():
    class Elsewhere:
        action_keys = ("action",)
        action_spec = Unbounded((3, 2), device="meta")

    scaling = Scaling(Elsewhere(), [-1.0, 1.0])
    assert scaling(torch.zeros(3, 2, device="meta")).device.type == "meta"


@pytest.mark.parametrize(("seed", "seeds"), [(5, [5, 6, 7]), (None, [None] * 3)])
def test_a_function_that_makes_a_single_environment_receives_a_seed(seed, seeds):
    received = []

    def seeded(seed):
        received.append(seed)
        return single()

    env = OwnEnvs(seeded, 3, seed=seed, max_episode_steps=5)
    env.reset()
    assert received[-3:] == seeds  # TorchRL may make one more environment before, for its specs
    env.close()


class Drawn(Points):
    """Points that draw the environment of an index."""

    def render(self, index):
        return np.full((2, 3, 3), index, np.uint8)


class Shown(Points):
    """Points whose method of the same name shows a window."""

    def render(self, mode="human"):
        raise AssertionError


def test_films_call_the_method_that_draws_an_environment_by_its_index():
    env = OwnEnvs(Drawn, 3, observation=["place"], max_episode_steps=4)
    assert env.render(2).unique().tolist() == [2]
    env = OwnEnvs(Shown, 3, observation=["place"], max_episode_steps=4)
    refused(env.render, "Shown", "render(index)", error=RuntimeError)


class Undrawable(Points):
    """Points whose drawing needs a package that is missing."""

    def render(self, index):
        raise ImportError("pygame is not installed")


def test_drawing_that_fails_is_an_error_that_names_the_environment_and_the_reason():
    env = OwnEnvs(Undrawable, 3, observation=["place"], max_episode_steps=4)
    refused(env.render, "Undrawable", "pygame is not installed", error=RuntimeError)


def test_an_observation_that_is_no_number_is_an_error_that_names_its_place():
    def corrupt(outcome):
        outcome["place"][1, 0, 1] = torch.nan
        return outcome

    env = adapted(Changed(act=corrupt))
    refused(
        lambda: play(env, torch.zeros(1, 3, 1)), "observation", "entry 1", "environment 1", error=FloatingPointError
    )


def test_a_reward_that_is_no_number_is_an_error_that_names_its_place():
    def corrupt(outcome):
        outcome["reward"][1] = torch.inf
        return outcome

    env = adapted(Changed(act=corrupt))
    refused(lambda: play(env, torch.zeros(1, 3, 1)), "the reward", "inf", "environment 1", error=FloatingPointError)


def test_an_environment_that_fails_is_an_error_that_names_it_and_the_line():
    def fail(outcome):
        raise EOFError("the simulator has died")

    env = adapted(Changed(act=fail), name="Robots")
    message = refused(lambda: play(env, torch.zeros(1, 3, 1)), "Robots", "EOFError", error=ChildProcessError)
    assert "test_adapter.py" in message


class SelfResetting(Points):
    """Points that begin anew in the step that ends an episode, and ignore the reset that follows."""

    def _step(self, tensordict):
        outcome = super()._step(tensordict)
        ended = outcome["done"]
        self.x = torch.where(ended, torch.rand(self.x.shape), self.x)
        return self._emit(reward=outcome["reward"]).update({"done": ended, "terminated": ended})

    def _reset(self, tensordict=None, **kwargs):
        return super()._reset() if tensordict is None or "_reset" not in tensordict else self._emit()


def test_environments_that_reset_themselves_are_pointed_out_once():
    env = adapted(SelfResetting(), max_episode_steps=100)
    with pytest.warns(UserWarning, match="reset itself") as warned:
        play(env, torch.full((12, 3, 1), 0.9))
    assert len(warned) == 1


def test_environments_that_reset_themselves_can_repeat_the_observation_before_the_last_step():
    env = adapted(TransformedEnv(SelfResetting(), RepeatObservation()), max_episode_steps=100)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        outcome = play(env, torch.full((12, 3, 1), 0.9))
    done = outcome["next", "done"].squeeze(-1)
    assert done.sum() > 6
    assert torch.equal(outcome["next", "observation"][done], outcome["observation"][done])
    first = outcome["observation"][:, 1:][done[:, :-1]][:, 0]
    assert ((first > 0) & (first < 1)).all()


def test_a_class_that_is_no_environment_or_lacks_a_member_is_refused_by_name():
    refused(lambda: require_contract(object()), "EnvBase", "Adapter")
    refused(lambda: require_contract(Points()), "max_episode_steps", "normalised_return", "Adapter")


def test_what_does_other_than_its_specs_say_is_refused():
    def wide(outcome):
        return outcome.set("far", torch.zeros(3, 2, dtype=torch.bool))

    refused(lambda: require_specs(adapted(Changed(act=wide), metrics=["far"])), "Adapter")


class Closing(Points):
    """Points that note whether they were closed, as those with processes of their own must be."""

    closed = False

    def close(self, **kwargs):
        self.closed = True
        super().close(**kwargs)


def test_a_collector_that_is_shut_down_closes_the_environments():
    points = Closing()
    env = adapted(points)
    collector = Collector(
        env, env.rand_action, frames_per_batch=6, total_frames=-1, auto_register_policy_transforms=False
    )
    next(iter(collector))
    assert not points.closed
    collector.shutdown()
    assert points.closed
