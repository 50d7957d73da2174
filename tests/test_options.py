"""The methods that choose among options: what acts, what is blind to the goal, what is counted, and that it learns."""

from functools import partial

import pytest
import torch
from hydra import compose, initialize_config_module
from hydra.utils import instantiate
from tensordict import TensorDict
from torch import nn
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, ExplorationType, TransformedEnv, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from torchrl_mcp.critics import value_critic
from torchrl_mcp.diagnostics import diagnostics
from torchrl_mcp.hierarchical import gated_actor, gated_parts, primitive_actor, primitive_parts
from torchrl_mcp.memory import OptionMemory
from torchrl_mcp.modules import GaussianPolicy, JointGating, Primitives
from torchrl_mcp.objectives import OptionAdvantages, OptionCriticLoss, SemiMarkovAdvantages
from torchrl_mcp.option_critic import option_critic_actor, option_critic_parts, option_values
from torchrl_mcp.options import EpsilonGreedy, SeparateOptions, Terminations, WhereBeginning, option_diagnostics

S, G, A, K, N = 6, 2, 3, 4, 12
FROZEN = ["primitives", "observation_normaliser"]


def gaussian(num_cells=(16, 8), gain=1.0):
    return partial(GaussianPolicy, num_cells=num_cells, std=0.3, output_gain=gain)


def hierarchical(steps_per_choice=3):
    """Return parts and actor of the hierarchical model at transfer."""
    torch.manual_seed(0)
    gating = partial(JointGating, num_cells=(16, 8))
    parts = gated_parts(S, G, A, gating=gating, primitives=partial(SeparateOptions, policy=gaussian()), num_options=K)
    return parts, gated_actor(parts, num_options=K, steps_per_choice=steps_per_choice, frozen=FROZEN)


def option_critic(initial=0.5, epsilon=0.1, frozen=()):
    """Return parts and actor of the option-critic."""
    torch.manual_seed(0)
    parts = option_critic_parts(
        S,
        G,
        A,
        options=partial(Primitives, trunk_cells=(16, 8), branch_cells=0, initial_std=0.3),
        terminations=partial(Terminations, num_cells=(16, 8), initial=initial),
        values_cells=(16, 8),
        num_options=K,
    )
    return parts, option_critic_actor(parts, num_options=K, epsilon=epsilon, frozen=frozen)


def pretraining():
    """Return parts and actor of the hierarchical model while its primitives are trained."""
    torch.manual_seed(0)
    parts = primitive_parts(S, G, A, primitives=partial(SeparateOptions, policy=gaussian()), num_options=K)
    return parts, primitive_actor(parts, num_options=K)


METHODS = {"hierarchical": hierarchical, "pretraining": pretraining, "option_critic": option_critic}


def situations(seed=0, held_steps=0):
    generator = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            "observation": torch.randn(N, S, generator=generator),
            "goal": torch.randn(N, G, generator=generator),
            "option": torch.randint(0, K, (N,), generator=generator),
            "held_option": torch.randint(0, K, (N,), generator=generator),
            "held_steps": torch.full((N,), held_steps),
            "next": {"observation": torch.randn(N, S, generator=generator)},
        },
        batch_size=N,
    )


def test_each_network_evaluates_the_states_in_which_it_acts():
    options = SeparateOptions(S, A, K, policy=gaussian())
    states, option = torch.randn(3, 5, S), torch.randint(0, K - 1, (3, 5))
    loc, scale = options(states, option)
    for n in range(3):
        for t in range(5):
            expected = options.policies[option[n, t]](states[n, t], torch.empty(0))
            torch.testing.assert_close((loc[n, t], scale[n, t]), expected)


def test_a_network_that_acts_nowhere_gets_no_gradient():
    options = SeparateOptions(S, A, K, policy=gaussian())
    loc, _ = options(torch.randn(N, S), torch.randint(0, K - 1, (N,)))
    loc.sum().backward()
    for k, policy in enumerate(options.policies):
        assert all(bool(p.grad.any()) == (k < K - 1) for p in policy.parameters()), k


def test_options_begin_with_the_configured_rate_of_termination():
    terminations = Terminations(S, K, num_cells=(16, 8), initial=0.1)(torch.randn(100, S))
    torch.testing.assert_close(terminations, torch.full((100, K), 0.1), atol=0.01, rtol=0.0)


def test_scores_are_evaluated_only_where_an_option_begins():
    class Counting(nn.Module):
        def forward(self, observation, goal):
            self.seen = len(observation)
            return torch.cat([observation, goal], -1)

    scores, begins = Counting(), torch.tensor([True, False, True])
    observation, goal = torch.randn(3, K - 1), torch.randn(3, 1)
    found = WhereBeginning(scores, K)(observation, goal, begins)
    assert scores.seen == 2
    assert not found[1].any()
    assert torch.equal(found[begins], torch.cat([observation, goal], -1)[begins])


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_the_best_option_is_chosen_but_for_random_choices(epsilon):
    torch.manual_seed(0)
    choice = EpsilonGreedy(torch.tensor([[0.0, 3.0, 1.0], [5.0, -1.0, 2.0]]), epsilon)
    shares = nn.functional.one_hot(choice.sample((20_000,)), 3).float().mean(0)
    best = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    torch.testing.assert_close(shares, (1 - epsilon) * best + epsilon / 3, atol=0.015, rtol=0.0)
    assert choice.deterministic_sample.tolist() == [1, 0]


def test_a_choice_lasts_as_many_steps_as_configured():
    _, actor = hierarchical(steps_per_choice=3)
    for held, begins in enumerate([True, False, False, True, False]):
        out = actor.policy(situations(held_steps=held))
        assert out["begins"].all() if begins else not out["begins"].any()
        if not begins:
            assert torch.equal(out["option"], out["held_option"])


def test_an_option_ends_with_its_own_probability_in_the_state_where_it_led():
    torch.manual_seed(0)
    parts, actor = option_critic()
    parts["terminations"].output.weight.data.normal_()
    held = situations(held_steps=3)
    many = held.expand(4000, N).reshape(-1)
    rate = actor.policy(many)["begins"].view(4000, N).float().mean(0)
    logits = parts["terminations"].output(parts["terminations"].body(held["observation"]))
    expected = logits.sigmoid()[torch.arange(N), held["held_option"]]
    torch.testing.assert_close(rate, expected, atol=0.03, rtol=0.0)
    assert expected.std() > 0.05


def test_at_the_beginning_of_an_episode_no_option_is_held():
    _, actor = option_critic(initial=1e-6)
    assert actor.policy(situations(held_steps=0))["begins"].all()
    out = actor.policy(situations(held_steps=1))
    assert not out["begins"].any()
    assert torch.equal(out["option"], out["held_option"])


@pytest.mark.parametrize("method", METHODS)
def test_options_see_no_goal_and_what_chooses_among_them_does(method):
    _, actor = METHODS[method]()
    sample = situations()
    sample["goal"] = sample["goal"].requires_grad_()
    acted = actor.policy(sample.clone(recurse=False))
    for key in {"loc", "scale", "terminations"} & set(acted.keys()):
        if acted[key].requires_grad:
            (slope,) = torch.autograd.grad(acted[key].sum(), sample["goal"], retain_graph=True, allow_unused=True)
            assert slope is None or not slope.any(), key
    for key in {"gate_logits", "option_values"} & set(acted.keys()):
        (slope,) = torch.autograd.grad(acted[key].square().sum(), sample["goal"], retain_graph=True)
        assert slope.any(), key
    assert ("gate_logits" in acted.keys()) == (method == "hierarchical")  # noqa: SIM118


@pytest.mark.parametrize("method", METHODS)
def test_the_loss_sees_the_probability_with_which_the_policy_drew(method):
    _, actor = METHODS[method]()
    with torch.no_grad():
        sample = actor.policy(situations())
    kept = sample.select("observation", "goal", "next", *actor.stored)
    log_prob = actor.trained.get_dist(kept).log_prob(sample[actor.sampled])
    torch.testing.assert_close(log_prob, sample[actor.log_prob])


def test_deterministic_choices_and_actions_repeat_themselves():
    for make in (hierarchical, partial(option_critic, initial=1e-6)):
        _, actor = make()
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            one, other = actor.policy(situations()), actor.policy(situations())
        assert torch.equal(one["option"], other["option"])
        assert torch.equal(one["action"], other["action"])
        assert torch.equal(one["action"], one["loc"])


def test_terminations_are_judged_where_the_option_led_and_not_where_it_acted():
    _, actor = option_critic()
    sample = situations()
    for key in ("observation", ("next", "observation")):
        sample[key] = sample[key].requires_grad_()
    termination = actor.trained.get_dist_params(sample)["termination"]
    here, there = torch.autograd.grad(
        termination.sum(), [sample["observation"], sample["next", "observation"]], allow_unused=True
    )
    assert here is None
    assert there.any()


def test_frozen_terminations_are_not_evaluated_in_the_update():
    _, actor = option_critic(frozen=["options", "terminations", "observation_normaliser"])
    assert ("next", "observation") not in actor.trained.in_keys


def test_the_gate_refuses_to_train_the_primitives():
    parts, _ = hierarchical()
    with pytest.raises(ValueError, match=r"transfer\.freeze"):
        gated_actor(parts, num_options=K, steps_per_choice=3)


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: SeparateOptions(S, A, 0, policy=gaussian()), "num_options"),
        (lambda: Terminations(S, K, num_cells=(8,), initial=1.0), "initial"),
        (lambda: hierarchical(steps_per_choice=0), "steps_per_choice"),
    ],
)
def test_arguments_out_of_range_are_named(make, name):
    with pytest.raises(ValueError, match=name):
        make()


def test_diagnostics_tell_who_acts_and_for_how_long():
    option = torch.tensor([[0, 0, 0, 0], [0, 0, 3, 3]])
    begins = torch.tensor([[1, 0, 0, 0], [1, 0, 1, 0]]).bool()
    found = option_diagnostics(option, begins, num_options=4)
    shares = torch.tensor([0.75, 0.0, 0.0, 0.25])
    assert [found[f"usage_{k}"].item() for k in range(4)] == shares.tolist()
    assert found["begin_rate"].item() == 3 / 8
    assert found["duration"].item() == pytest.approx(8 / 3)
    # exp of the entropy of 3/4 and 1/4: 4 / 3^(3/4).
    assert found["effective_options"].item() == pytest.approx(4 / 3**0.75)
    collapsed = option_diagnostics(torch.full((5,), 2), torch.ones(5).bool(), num_options=4)
    assert collapsed["effective_options"].item() == 1.0
    assert collapsed["duration"].item() == 1.0


def test_every_actor_that_chooses_options_has_its_diagnostics():
    for make in (hierarchical, option_critic):
        _, actor = make()
        found = diagnostics(actor, actor.policy(situations()).select(*actor.stored))
        assert {f"options/usage_{k}" for k in range(K)} | {"options/duration"} <= found.keys()
    _, actor = pretraining()
    assert diagnostics(actor, situations()) == {}


# Worked out by hand for a biped (S = 105, A = 17) whose goal has two numbers; a hidden body of 1024-512 on F inputs has
# 1024 F + 1024 + 1024 * 512 + 512 parameters: 633344 for F = 105, 635392 for F = 107.
COUNTS = {
    ("hierarchical", "pretrain"): {"primitives": 7 * (633_344 + 512 * 17 + 17)},
    ("hierarchical", "transfer"): {"primitives": 4_494_455, "gating": 635_392 + 512 * 7 + 7},
    ("option_critic", "pretrain"): {
        "options": 633_344 + 8 * (512 * 34 + 34),
        "terminations": 633_344 + 512 * 8 + 8,
        "critic": 635_392 + 512 * 8 + 8,
    },
}


@pytest.mark.parametrize(("method", "stage"), COUNTS)
def test_parameters_are_as_many_as_the_paper_s_layers_have(method, stage):
    with initialize_config_module("torchrl_mcp.conf", version_base="1.3"):
        cfg = compose("train", [f"method={method}", f"stage={stage}", "character=biped", "task=heading"])
    parts = instantiate(cfg.parts)(105, 2, 17)
    counts = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}
    assert {name: count for name, count in counts.items() if count} == COUNTS[method, stage]


class FourCorners(EnvBase):
    """A point in a square that is to go to one of its corners, of which only the goal tells which.

    The return is the distance won, as a share of all: of a policy that is blind to the goal it is at most 0 on average,
    because the mean distance from the corners is least in the middle.
    """

    batch_locked = True
    corners = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])

    def __init__(self, num_envs, num_steps=12):
        super().__init__(device="cpu", batch_size=[num_envs])
        self.num_steps = num_steps
        shape = (num_envs,)
        self.observation_spec = Composite(observation=Unbounded((*shape, 2)), goal=Unbounded((*shape, 4)), shape=shape)
        self.action_spec, self.reward_spec = Bounded(-1.0, 1.0, (*shape, 2)), Unbounded((*shape, 1))
        flag = Binary(1, shape=(*shape, 1), dtype=torch.bool)
        self.full_done_spec = Composite(done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=shape)

    def _set_seed(self, seed):
        pass

    def _emit(self, ended, **entries):
        goal = nn.functional.one_hot(self.corner, 4).float()
        no = torch.zeros_like(ended)
        done = {"done": ended, "truncated": ended.clone(), "terminated": no}
        return TensorDict({"observation": self.place.clone(), "goal": goal, **done, **entries}, self.batch_size)

    def _reset(self, tensordict=None, **kwargs):
        # All episodes are equally long: all environments are reset together.
        self.place = torch.zeros(*self.batch_size, 2)
        self.corner, self.elapsed = torch.randint(0, 4, self.batch_size), 0
        return self._emit(torch.zeros(*self.batch_size, 1, dtype=torch.bool))

    def _step(self, tensordict):
        corner, before = self.corners[self.corner], self.place
        self.place = (before + 0.15 * tensordict["action"].clamp(-1, 1)).clamp(-1, 1)
        won = torch.linalg.vector_norm(before - corner, dim=-1) - torch.linalg.vector_norm(self.place - corner, dim=-1)
        self.elapsed += 1
        ended = torch.full((*self.batch_size, 1), self.elapsed >= self.num_steps)
        return self._emit(ended, reward=won.unsqueeze(-1) / 2**0.5)


def test_the_option_critic_learns_options_that_beat_chance():
    torch.manual_seed(3)
    env = TransformedEnv(FourCorners(256), OptionMemory())
    parts = option_critic_parts(
        2,
        4,
        2,
        options=partial(Primitives, trunk_cells=(32,), branch_cells=0, initial_std=0.5),
        terminations=partial(Terminations, num_cells=(32,), initial=0.02),
        values_cells=(32,),
        num_options=4,
    )
    actor, critic = option_critic_actor(parts, num_options=4, epsilon=0.1), option_values(parts, 2, 4)
    advantages = OptionAdvantages(critic, gamma=0.95, lmbda=0.95, clip=4.0, epsilon=0.1, termination_cost=0.01)
    loss = OptionCriticLoss(actor.trained, critic, clip_epsilon=0.2, bound_coeff=0.0)
    optimizer = torch.optim.Adam(
        [{"params": actor.trained.parameters(), "lr": 3e-3}, {"params": parts["critic"].parameters(), "lr": 2e-2}]
    )

    def play():
        with torch.no_grad():
            return env.rollout(12, actor.policy)

    chance = play()["next", "reward"].sum(1).mean().item()
    for _ in range(25):
        samples = advantages(play()).flatten()
        for index in torch.cat([torch.randperm(len(samples)) for _ in range(2)]).split(1024):
            report = loss(samples[index])
            sum(value for key, value in report.items() if key.startswith("loss_")).backward()
            optimizer.step()
            optimizer.zero_grad()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        learned = play()
    assert chance < 0.1
    assert learned["next", "reward"].sum(1).mean().item() > 0.4
    assert diagnostics(actor, learned)["options/effective_options"] > 2.5


def test_the_gate_learns_to_sequence_primitives_that_it_is_given():
    torch.manual_seed(0)
    env = TransformedEnv(FourCorners(256), OptionMemory())
    parts = gated_parts(
        2,
        4,
        2,
        gating=partial(JointGating, num_cells=(32,)),
        primitives=partial(SeparateOptions, policy=gaussian(num_cells=(8,), gain=0.0)),
        num_options=4,
    )
    for policy, corner in zip(parts["primitives"].policies, FourCorners.corners, strict=True):
        policy.output.bias.data.copy_(corner)
    actor = gated_actor(parts, num_options=4, steps_per_choice=5, frozen=FROZEN)
    critic = value_critic(parts, 2, 4, num_cells=(32,))
    advantages = SemiMarkovAdvantages(critic, gamma=0.95, lmbda=0.95, clip=4.0)
    loss = ClipPPOLoss(actor.trained, critic, entropy_bonus=False, loss_critic_type="l2", functional=False)
    loss.set_keys(action=actor.sampled, sample_log_prob=actor.log_prob)
    optimizer = torch.optim.Adam(loss.parameters(), lr=2e-2)

    def play():
        with torch.no_grad():
            return env.rollout(12, actor.policy)

    chance = play()["next", "reward"].sum(1).mean().item()
    for _ in range(20):
        choices = advantages(play())
        assert len(choices) == 256 * 3
        for index in torch.cat([torch.randperm(len(choices)) for _ in range(3)]).split(256):
            report = loss(choices[index])
            sum(value for key, value in report.items() if key.startswith("loss_")).backward()
            optimizer.step()
            optimizer.zero_grad()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        learned = play()["next", "reward"].sum(1).mean().item()
    assert chance < 0.1
    assert learned > 0.7
