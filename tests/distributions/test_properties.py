"""Properties of products and mixtures, over primitives and gates of any sensible size."""

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import kl_divergence

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian

properties = settings(max_examples=50, deadline=None)


@st.composite
def primitives(draw, max_primitives=5, max_actions=3):
    k, a = draw(st.integers(1, max_primitives)), draw(st.integers(1, max_actions))

    def tensor(low, high, *shape):
        size = int(torch.Size(shape).numel())
        values = draw(st.lists(st.floats(low, high), min_size=size, max_size=size))
        return torch.tensor(values, dtype=torch.float64).reshape(shape)

    gates = tensor(0.0, 3.0, k)
    gates[draw(st.integers(0, k - 1))] = 1.0  # at least one is open
    return tensor(-3, 3, k, a), 10 ** tensor(-1.5, 1.5, k, a), gates


@properties
@given(arguments=primitives(), data=st.data())
def test_the_order_of_primitives_does_not_matter(distribution_class, arguments, data, assert_same):
    order = data.draw(st.permutations(range(len(arguments[2]))))
    assert_same(distribution_class(*arguments), distribution_class(*(x[list(order)] for x in arguments)))


@properties
@given(arguments=primitives(), share=st.floats(0.0, 1.0))
def test_splitting_a_primitive_and_its_gate_changes_nothing(distribution_class, arguments, share, assert_same):
    loc, scale, gates = arguments
    split = torch.cat([gates[:1] * share, gates[:1] * (1 - share), gates[1:]])
    policy = distribution_class(torch.cat([loc[:1], loc]), torch.cat([scale[:1], scale]), split)
    assert_same(policy, distribution_class(*arguments))


@properties
@given(arguments=primitives())
def test_a_closed_primitive_changes_nothing(distribution_class, arguments, assert_same):
    loc, scale, gates = arguments
    extra = torch.cat([loc, loc[:1] + 100]), torch.cat([scale, scale[:1] / 100]), torch.cat([gates, gates[:1] * 0])
    assert_same(distribution_class(*extra), distribution_class(*arguments))


@properties
@given(arguments=primitives(), shift=st.floats(-10, 10), factor=st.floats(0.1, 10))
def test_moving_and_stretching_the_primitives_moves_and_stretches_the_policy(
    distribution_class, arguments, shift, factor
):
    loc, scale, gates = arguments
    policy, moved = distribution_class(*arguments), distribution_class(factor * loc + shift, factor * scale, gates)
    torch.testing.assert_close(moved.mean, factor * policy.mean + shift)
    torch.testing.assert_close(moved.stddev, factor * policy.stddev)


@properties
@given(arguments=primitives())
def test_the_mean_lies_in_the_hull_of_the_primitive_means(distribution_class, arguments):
    # Per action, since each dimension of a product weights the primitives anew.
    loc, _, gates = arguments
    opened = loc[gates > 0]
    mean = distribution_class(*arguments).mean
    assert (mean >= opened.amin(0) - 1e-12).all()
    assert (mean <= opened.amax(0) + 1e-12).all()


@properties
@given(arguments=primitives(), factor=st.floats(1e-3, 1e3))
def test_scaling_the_gates_divides_the_variance_of_the_product(arguments, factor):
    loc, scale, gates = arguments
    policy, scaled = MultiplicativeGaussian(*arguments), MultiplicativeGaussian(loc, scale, factor * gates)
    torch.testing.assert_close(scaled.mean, policy.mean)
    torch.testing.assert_close(scaled.variance, policy.variance / factor)


@properties
@given(arguments=primitives(), factor=st.floats(1e-3, 1e3))
def test_scaling_the_gates_leaves_the_mixture_as_it_was(arguments, factor, assert_same):
    loc, scale, gates = arguments
    assert_same(AdditiveGaussian(*arguments), AdditiveGaussian(loc, scale, factor * gates))


@properties
@given(arguments=primitives())
def test_opening_a_gate_never_widens_the_product(arguments):
    loc, scale, gates = arguments
    narrow = MultiplicativeGaussian(loc, scale, gates + 0.5)
    assert (narrow.stddev <= MultiplicativeGaussian(*arguments).stddev).all()


@properties
@given(arguments=primitives())
def test_products_compose(arguments):
    # The product of composites under gates of one is the composite of all primitives together.
    loc, scale, gates = arguments
    parts = [MultiplicativeGaussian(loc[k : k + 1], scale[k : k + 1], gates[k : k + 1]) for k in range(len(gates))]
    whole = MultiplicativeGaussian(
        torch.stack([p.mean for p in parts]), torch.stack([p.stddev for p in parts]), torch.ones(len(parts)).double()
    )
    # Closed primitives enter here at the floor of the precision.
    torch.testing.assert_close(whole.mean, MultiplicativeGaussian(*arguments).mean, rtol=1e-4, atol=1e-4)


@properties
@given(arguments=primitives())
def test_the_mixture_is_nowhere_below_its_weighted_primitives(arguments):
    policy = AdditiveGaussian(*arguments)
    action = policy.sample((20,))
    parts = policy.component_distribution.log_prob(action.unsqueeze(-2)) + policy.mixture_distribution.probs.log()
    assert (policy.log_prob(action) >= parts.amax(-1) - 1e-9).all()


@properties
@given(arguments=primitives())
def test_kl_divergence_to_itself_is_zero(arguments):
    policy = MultiplicativeGaussian(*arguments)
    torch.testing.assert_close(kl_divergence(policy, policy.expand((3,))), torch.zeros(3, dtype=torch.float64))
