"""The pieces of methods that choose among options: networks, terminations, scores, random choices and diagnostics."""

from functools import partial

import pytest
import torch
from refusals import refused
from torch import nn

from torchrl_mcp.methods.options import EpsilonGreedy, SeparateOptions, Terminations, WhereBeginning, option_diagnostics
from torchrl_mcp.modules import GaussianPolicy

S, A, K, N = 6, 3, 4, 12
POLICY = partial(GaussianPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0)


def test_each_network_evaluates_the_states_in_which_it_acts():
    options = SeparateOptions(S, A, K, policy=POLICY)
    states, option = torch.randn(3, 5, S), torch.randint(0, K - 1, (3, 5))
    loc, scale = options(states, option)
    for n in range(3):
        for t in range(5):
            expected = options.policies[option[n, t]](states[n, t], torch.empty(0))
            torch.testing.assert_close((loc[n, t], scale[n, t]), expected)


def test_a_single_state_needs_no_batch_dimension():
    options = SeparateOptions(S, A, K, policy=POLICY)
    state = torch.randn(S)
    expected = options.policies[2](state, torch.empty(0))
    torch.testing.assert_close(options(state, torch.tensor(2)), expected)


def test_a_network_that_acts_nowhere_gets_no_gradient():
    options = SeparateOptions(S, A, K, policy=POLICY)
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


def test_scores_stay_float32_if_the_default_is_float64():
    torch.set_default_dtype(torch.float64)
    try:
        found = WhereBeginning(lambda observation, goal: observation, K)(
            torch.ones(3, K), torch.ones(3, 1), torch.tensor([True, False, True])
        )
    finally:
        torch.set_default_dtype(torch.float32)
    assert found.dtype == torch.float32
    assert found.sum(-1).tolist() == [K, 0, K]


def test_choices_expand_to_larger_batches():
    choice = EpsilonGreedy(torch.tensor([[0.0, 3.0, 1.0], [5.0, -1.0, 2.0]]), 0.3)
    larger = choice.expand((4, 2))
    assert larger.sample((5,)).shape == (5, 4, 2)
    assert torch.equal(larger.probs, choice.probs.expand(4, 2, 3))
    assert torch.equal(larger.deterministic_sample, torch.tensor([[1, 0]] * 4))


@pytest.mark.parametrize("epsilon", [0.0, 0.3, 1.0])
def test_the_best_option_is_chosen_but_for_random_choices(epsilon):
    torch.manual_seed(0)
    choice = EpsilonGreedy(torch.tensor([[0.0, 3.0, 1.0], [5.0, -1.0, 2.0]]), epsilon)
    shares = nn.functional.one_hot(choice.sample((20_000,)), 3).float().mean(0)
    best = torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    torch.testing.assert_close(shares, (1 - epsilon) * best + epsilon / 3, atol=0.015, rtol=0.0)
    assert choice.deterministic_sample.tolist() == [1, 0]


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


def test_an_empty_batch_has_empty_outputs():
    loc, scale = SeparateOptions(S, A, K, policy=POLICY)(torch.zeros(0, S), torch.zeros(0, dtype=torch.int64))
    assert loc.shape == scale.shape == (0, A)


@pytest.mark.parametrize("epsilon", [-0.1, 1.1, float("nan")])
def test_a_random_choice_needs_a_probability(epsilon):
    refused(lambda: EpsilonGreedy(torch.zeros(K), epsilon), f"epsilon={epsilon}")
