"""The option-critic's estimates against their definitions, its gradients against exact ones, and that it learns."""

from statistics import mean, stdev

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torch.distributions import Categorical
from torchrl.objectives import SoftUpdate

from torchrl_mcp.objectives import OptionAdvantages, OptionCriticLoss, OptionValueLoss

GAMMA, STATES, OPTIONS, ACTIONS = 0.9, 4, 2, 3
SETTINGS = {"clip_epsilon": 0.2, "bound_coeff": 0.0, "entropy_bonus": False, "functional": False}


class Options(nn.Module):
    """Policies and terminations as tables."""

    def __init__(self, seed=0):
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.policies = nn.Parameter(torch.randn(OPTIONS, STATES, ACTIONS, generator=generator).double())
        self.terminations = nn.Parameter(torch.randn(OPTIONS, STATES, generator=generator).double())

    def forward(self, state, option, arrival):
        return self.policies[option, state], self.terminations[option, arrival].sigmoid()


class Problem:
    """A random Markov decision process with a fixed policy over options, solved exactly."""

    def __init__(self, seed=1):
        generator = torch.Generator().manual_seed(seed)
        self.transitions = torch.randn(STATES, ACTIONS, STATES, generator=generator).double().softmax(-1)
        self.rewards = torch.randn(STATES, ACTIONS, generator=generator).double()
        self.choice = torch.randn(STATES, OPTIONS, generator=generator).double().softmax(-1)

    def resolvent(self, pi, beta):
        """Discounted visits to states and options from states and options, ``(S K, S K)``."""
        moves = torch.einsum("ksa,sat->skt", pi, self.transitions)
        same = torch.eye(OPTIONS, dtype=torch.float64)
        arrivals = (1 - beta).unsqueeze(-1) * same.unsqueeze(1) + beta.unsqueeze(-1) * self.choice
        chain = torch.einsum("skt,ktj->sktj", moves, arrivals).reshape(STATES * OPTIONS, -1)
        return torch.linalg.inv(torch.eye(STATES * OPTIONS, dtype=torch.float64) - GAMMA * chain)

    def values(self, pi, beta):
        """Q(s, omega) of the Markov chain over states and options, ``(S, K)``."""
        rewards = torch.einsum("ksa,sa->sk", pi, self.rewards)
        return (self.resolvent(pi, beta) @ rewards.flatten()).view(STATES, OPTIONS)


def tabular_loss(options, **kwargs):
    actor = ProbabilisticTensorDictSequential(
        TensorDictModule(
            options, in_keys=["observation", "option", ("next", "observation")], out_keys=["logits", "termination"]
        ),
        ProbabilisticTensorDictModule(["logits"], ["action"], distribution_class=Categorical, return_log_prob=True),
    )
    return OptionCriticLoss(actor, **SETTINGS | kwargs)


def every_step():
    """All states, options, actions and next states, each ``(n,)``."""
    index = torch.cartesian_prod(*[torch.arange(n) for n in (STATES, OPTIONS, ACTIONS, STATES)]).unbind(-1)
    return dict(zip(("observation", "option", "action", "arrival"), index, strict=True))


def exact_samples(problem, options, start):
    """Every step once, its estimates weighted by its discounted probability from ``start`` on."""
    step = every_step()
    s, k, a, t = step.values()
    pi, beta = options.policies.detach().softmax(-1), options.terminations.detach().sigmoid()
    values = problem.values(pi, beta)
    over_options = (problem.choice * values).sum(-1)
    upon_arrival = values - beta.T * (values - over_options.unsqueeze(-1))
    weight = problem.resolvent(pi, beta)[start].view(STATES, OPTIONS)[s, k] * pi[k, s, a]
    weight = weight * problem.transitions[s, a, t] * len(s)
    advantage = problem.rewards[s, a] + GAMMA * upon_arrival[t, k] - values[s, k]
    return TensorDict(
        {
            **{key: step[key] for key in ("observation", "option", "action")},
            "next": {"observation": t},
            "action_log_prob": pi.log()[k, s, a],
            "advantage": (weight * advantage).unsqueeze(-1),
            "termination_advantage": (weight * GAMMA * (values[t, k] - over_options[t])).unsqueeze(-1),
            "value_target": values[s, k].unsqueeze(-1),
        },
        batch_size=len(s),
    )


@pytest.mark.parametrize("start", [0, 5])
def test_its_gradients_are_those_of_the_exact_value(start):
    problem, options = Problem(), Options()
    value = problem.values(options.policies.softmax(-1), options.terminations.sigmoid()).flatten()[start]
    expected = torch.autograd.grad(-value, [options.policies, options.terminations])

    report = tabular_loss(options)(exact_samples(problem, options, start))
    (report["loss_objective"] + report["loss_termination"]).backward()
    torch.testing.assert_close(options.policies.grad, expected[0], atol=1e-10, rtol=1e-8)
    torch.testing.assert_close(options.terminations.grad, expected[1], atol=1e-10, rtol=1e-8)
    assert options.terminations.grad.abs().max() > 1e-3


def test_values_regress_to_their_targets_where_the_option_acted():
    problem, options = Problem(), Options()
    table = nn.Embedding(STATES, OPTIONS, dtype=torch.float64)
    critic = TensorDictSequential(TensorDictModule(table, in_keys=["observation"], out_keys=["option_values"]))
    values = problem.values(options.policies.softmax(-1), options.terminations.sigmoid())
    OptionValueLoss(critic, coeff=0.5)(exact_samples(problem, options, 0))["loss_critic"].backward()
    # Each of the S K entries has the same share of the samples.
    torch.testing.assert_close(table.weight.grad, ((table.weight - values) / (STATES * OPTIONS)).detach())


def test_the_ratio_is_clipped_when_samples_are_used_again():
    options = Options()
    samples = exact_samples(Problem(), options, 0)
    samples["advantage"] = torch.ones_like(samples["advantage"])
    samples["action_log_prob"] = samples["action_log_prob"] - 1.0
    report = tabular_loss(options)(samples)
    assert report["loss_objective"].item() == pytest.approx(-1.2)
    assert report["mean_ratio"].item() == pytest.approx(torch.tensor(1.0).exp().item())
    assert report["kl_approx"].item() == pytest.approx(-1.0)
    report["loss_objective"].backward()
    assert not options.policies.grad.any()


def test_frozen_terminations_leave_the_options_to_learn():
    options = Options()
    samples, whole = exact_samples(Problem(), options, 0), tabular_loss(options)
    acting = TensorDictModule(
        lambda state, option: options.policies[option, state], in_keys=["observation", "option"], out_keys=["logits"]
    )
    actor = ProbabilisticTensorDictSequential(acting, whole.actor_network[-1])
    actor.policies = options.policies
    report, expected = OptionCriticLoss(actor, **SETTINGS)(samples), whole(samples)
    assert set(expected.keys()) == {*report.keys(), "loss_termination"}
    for key, value in report.items():
        assert torch.equal(value, expected[key]), key


def test_samples_may_be_passed_by_keys():
    samples, acting = exact_samples(Problem(), Options(), 0), Options()
    logits = TensorDictModule(lambda s, k: acting.policies[k, s], ["observation", "option"], ["logits"])
    actor = ProbabilisticTensorDictSequential(logits, tabular_loss(acting).actor_network[-1])
    critic = TensorDictModule(nn.Embedding(STATES, 1).double(), ["observation"], ["state_value"])
    loss = OptionCriticLoss(actor, critic, **SETTINGS)
    loss.in_keys = ["observation", "option", "action", "action_log_prob", "advantage", "value_target"]
    found = loss(**{key: samples[key] for key in loss.in_keys})
    for value, key in zip(found, loss.out_keys, strict=True):
        assert torch.equal(value, loss(samples)[key]), key


GOES_ON, TERMINATED, TRUNCATED = range(3)


def random_batch(outcomes, seed=0):
    """Rows of steps between numbered states, of which a time limit cuts off one that the next step does not show."""
    generator = torch.Generator().manual_seed(seed)
    outcomes = torch.tensor(outcomes)
    shape = tuple(outcomes.shape)
    states = torch.randint(0, STATES, (shape[0], shape[1] + 1), generator=generator)
    ended = outcomes != GOES_ON
    arrived = torch.where(ended, torch.randint(0, STATES, shape, generator=generator), states[:, 1:])
    following = {
        "observation": arrived,
        "goal": 1 - arrived % 2,
        "reward": torch.randn(*shape, 1, generator=generator),
        "terminated": (outcomes == TERMINATED).unsqueeze(-1),
        "truncated": (outcomes == TRUNCATED).unsqueeze(-1),
        "done": ended.unsqueeze(-1),
    }
    option = torch.randint(0, OPTIONS, shape, generator=generator)
    state = {"observation": states[:, :-1], "goal": 1 - states[:, :-1] % 2, "option": option}
    return TensorDict(state, batch_size=shape).set("next", TensorDict(following, batch_size=shape))


VALUES = torch.tensor([[0.5, -1.0], [2.0, 1.5], [-0.3, 0.4], [1.0, 3.0]])
TERMINATIONS = torch.tensor([[0.1, 0.9], [0.5, 0.3], [0.7, 0.2], [0.05, 0.6]])


def tabular_critic():
    return TensorDictModule(
        lambda state, goal: (VALUES[state] + goal.unsqueeze(-1), TERMINATIONS[state]),
        in_keys=["observation", "goal"],
        out_keys=["option_values", "terminations"],
    )


@pytest.mark.parametrize("lmbda", [0.0, 0.6, 1.0])
@pytest.mark.parametrize("epsilon", [0.0, 0.2])
def test_estimates_follow_the_definition(epsilon, lmbda):
    gamma, cost, clip = 0.9, 0.01, 1.5
    batch = random_batch(
        [[GOES_ON] * 6, [GOES_ON, TERMINATED, GOES_ON, TRUNCATED, GOES_ON, GOES_ON], [GOES_ON] * 5 + [TERMINATED]]
    )
    values = (VALUES + (1 - torch.arange(STATES) % 2).unsqueeze(-1)).tolist()
    advantages, targets, regrets = [], [], []
    for row in batch.unbind(0):
        later, estimated = 0.0, []
        for step in reversed(row.unbind(0)):
            here, there, option = step["observation"].item(), step["next", "observation"].item(), step["option"].item()
            over_options = (1 - epsilon) * max(values[there]) + epsilon * mean(values[there])
            gain = values[there][option] - over_options
            ended, terminated = step["next", "done"].item(), step["next", "terminated"].item()
            arrival = 0.0 if terminated else values[there][option] - TERMINATIONS[there][option].item() * gain
            delta = (1 - gamma) * step["next", "reward"].item() + gamma * arrival - values[here][option]
            later = delta + (0.0 if ended else gamma * lmbda * later)
            regret = 0.0 if terminated else gain / (1 - gamma) + cost
            estimated.insert(0, (later, later + values[here][option], regret))
        for numbers, list_ in zip(zip(*estimated, strict=True), (advantages, targets, regrets), strict=True):
            list_ += numbers
    centre, spread = mean(advantages), stdev(advantages)
    expected = {
        "advantage": [min(max((number - centre) / spread, -clip), clip) for number in advantages],
        "value_target": targets,
        "termination_advantage": regrets,
    }
    settings = {"gamma": gamma, "lmbda": lmbda, "clip": clip, "epsilon": epsilon, "termination_cost": cost}
    samples = OptionAdvantages(tabular_critic(), **settings)(batch)
    for key, numbers in expected.items():
        torch.testing.assert_close(samples[key].flatten(), torch.tensor(numbers), atol=1e-5, rtol=1e-5, msg=key)


def test_the_termination_cost_makes_options_last():
    options = Options()
    samples = exact_samples(Problem(), options, 0)
    samples["termination_advantage"] = torch.full_like(samples["termination_advantage"], 0.01)
    tabular_loss(options)(samples)["loss_termination"].backward()
    assert (options.terminations.grad > 0).all()


def test_with_a_delayed_actor_the_terminations_that_learn_get_the_gradient():
    options = Options()
    samples, loss = exact_samples(Problem(), options, 0), tabular_loss(options, functional=True, delay_actor=True)
    SoftUpdate(loss, eps=0.99)
    with torch.no_grad():
        options.terminations.add_(1.0)
    ended = options.terminations.detach().sigmoid()[samples["option"], samples["next", "observation"]]
    regret = samples["termination_advantage"].squeeze(-1)
    report = loss(samples)
    torch.testing.assert_close(report["loss_termination"], (ended * regret).mean())
    report["loss_termination"].backward()
    assert options.terminations.grad.abs().max() > 1e-3


def test_terminations_are_reduced_like_torchrl_s_terms_and_listed():
    options = Options()
    samples, loss = exact_samples(Problem(), options, 0), tabular_loss(options, reduction="none")
    ended = options.terminations.sigmoid()[samples["option"], samples["next", "observation"]]
    expected = ended * samples["termination_advantage"].squeeze(-1)
    assert "loss_termination" in loss.out_keys
    torch.testing.assert_close(loss(samples)["loss_termination"], expected)
    samples["collector", "mask"] = torch.arange(len(samples)) < 10
    torch.testing.assert_close(tabular_loss(options)(samples)["loss_termination"], expected[:10].mean())


def test_estimates_are_the_same_for_any_batch_dimensions():
    batch = random_batch([[GOES_ON, TERMINATED, GOES_ON], [GOES_ON, TRUNCATED, GOES_ON]] * 2)
    settings = {"gamma": 0.9, "lmbda": 0.8, "clip": 4.0, "epsilon": 0.2, "termination_cost": 0.01}
    estimate = OptionAdvantages(tabular_critic(), **settings)
    expected, found = estimate(batch.clone()), estimate(batch.reshape(2, 2, 3).clone())
    for key in ("advantage", "value_target", "termination_advantage"):
        torch.testing.assert_close(found[key].flatten(0, 1), expected[key])
