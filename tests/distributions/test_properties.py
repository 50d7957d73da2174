import itertools
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.distributions import Distribution, kl_divergence
from torch.utils._python_dispatch import TorchDispatchMode

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian

both = pytest.mark.parametrize("distribution_class", [MultiplicativeGaussian, AdditiveGaussian])


def random_primitives(*batch, num_primitives=3, action_dim=2, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    loc = torch.randn(*batch, num_primitives, action_dim, generator=generator, dtype=torch.float64)
    scale = torch.rand(*batch, num_primitives, action_dim, generator=generator, dtype=torch.float64) + 0.5
    gates = torch.rand(*batch, num_primitives, generator=generator, dtype=torch.float64) + 0.1
    return loc.to(dtype), scale.to(dtype), gates.to(dtype)


def assert_same(p, q):
    action = torch.randn(20, *p.batch_shape, *p.event_shape, dtype=torch.float64)
    torch.testing.assert_close(p.log_prob(action), q.log_prob(action))
    torch.testing.assert_close(p.mean, q.mean)
    torch.testing.assert_close(p.stddev, q.stddev)


@both
@pytest.mark.parametrize("batch", [(), (5,), (2, 5)])
def test_shapes_are_torch_s(distribution_class, batch):
    policy = distribution_class(*random_primitives(*batch, num_primitives=4, action_dim=3))
    assert policy.batch_shape == batch
    assert policy.event_shape == (3,)
    assert policy.sample((7,)).shape == (7, *batch, 3)
    assert policy.log_prob(policy.sample((7,))).shape == (7, *batch)
    assert policy.entropy().shape == batch
    for statistic in (policy.mean, policy.variance, policy.stddev, policy.deterministic_sample):
        assert statistic.shape == (*batch, 3)


@both
def test_a_batch_equals_its_rows_one_by_one(distribution_class):
    loc, scale, gates = random_primitives(2, 5)
    policy = distribution_class(loc, scale, gates)
    action = policy.sample()
    for i, j in itertools.product(range(2), range(5)):
        row = distribution_class(loc[i, j], scale[i, j], gates[i, j])
        torch.testing.assert_close(policy.log_prob(action)[i, j], row.log_prob(action[i, j]))


@both
def test_arguments_broadcast(distribution_class):
    loc, scale, _ = random_primitives(num_primitives=3)
    _, _, gates = random_primitives(5, num_primitives=3)
    policy = distribution_class(loc, scale[:, :1], gates)
    assert policy.batch_shape == (5,)
    assert_same(policy, distribution_class(loc.expand(5, 3, 2), scale[:, :1].expand(5, 3, 2), gates))


@both
@pytest.mark.parametrize(
    ("dtype", "result"),
    [(torch.float64, torch.float64), (torch.float32, torch.float32), (torch.bfloat16, torch.float32)],
)
def test_it_computes_in_float32_at_least(distribution_class, dtype, result):
    primitives = random_primitives(50, num_primitives=8, action_dim=28, dtype=dtype)
    policy, exact = distribution_class(*primitives), distribution_class(*(x.double() for x in primitives))
    action = policy.sample()
    assert action.dtype == policy.log_prob(action).dtype == policy.entropy().dtype == policy.mean.dtype == result
    torch.testing.assert_close(policy.log_prob(action).double(), exact.log_prob(action.double()), atol=1e-3, rtol=0)


@both
def test_gradients_return_in_the_type_of_the_arguments(distribution_class):
    primitives = [x.requires_grad_() for x in random_primitives(5, dtype=torch.bfloat16)]
    distribution_class(*primitives).log_prob(torch.zeros(2)).sum().backward()
    assert all(x.grad.dtype == torch.bfloat16 and x.grad.isfinite().all() for x in primitives)


@both
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extreme_scales_and_gates_give_finite_values_and_gradients(distribution_class, dtype):
    torch.manual_seed(0)
    scales, openings = [1e-6, 1e-3, 1.0, 1e3], [0.0, 1e-30, 1e-9, 1.0]
    grid = torch.tensor(list(itertools.product(scales, scales, openings, openings)), dtype=dtype)
    scale = grid[:, :2, None].repeat(1, 1, 2).requires_grad_()
    gates = grid[:, 2:].clone().requires_grad_()
    loc = torch.tensor([[1.0, -3.0], [2.0, 0.5]], dtype=dtype).repeat(len(grid), 1, 1).requires_grad_()

    policy = distribution_class(loc, scale, gates, validate_args=False)
    outputs = [policy.log_prob(policy.mean.detach() + offset) for offset in (0.0, 1.0, -100.0)]
    outputs += [policy.mean, policy.stddev, policy.entropy(), policy.deterministic_sample]
    outputs += [policy.rsample()] if policy.has_rsample else []
    for output in outputs:
        gradients = torch.autograd.grad(output.sum(), (loc, scale, gates), retain_graph=True, allow_unused=True)
        assert output.isfinite().all()
        assert all(gradient is None or gradient.isfinite().all() for gradient in gradients)


@both
def test_an_expanded_distribution_is_itself_over_a_larger_batch(distribution_class):
    policy = distribution_class(*random_primitives(5))
    expanded = policy.expand((2, 5))
    assert type(expanded) is distribution_class
    assert expanded.batch_shape == (2, 5)
    assert expanded.sample().shape == expanded.deterministic_sample.shape == (2, 5, 2)
    assert expanded.entropy().shape == (2, 5)
    action = policy.sample()
    torch.testing.assert_close(expanded.log_prob(action), policy.log_prob(action).expand(2, 5))


@both
def test_a_subclass_expands_to_its_own_type(distribution_class):
    class Child(distribution_class):
        pass

    assert type(Child(*random_primitives()).expand((4,))) is Child


@both
def test_it_survives_pickling(distribution_class):
    policy = distribution_class(*random_primitives())
    assert_same(pickle.loads(pickle.dumps(policy)), policy)


def evaluate(distribution_class, loc, scale, gates, action):
    policy = distribution_class(loc, scale, gates)
    return policy.log_prob(action), policy.mean, policy.stddev, policy.deterministic_sample


@both
@pytest.mark.parametrize("backend", ["eager", "aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_it_compiles_into_one_graph(distribution_class, backend):
    def loss(loc, scale, gates, action):
        policy = distribution_class(loc, scale, gates)
        assert policy.sample().shape == (*policy.expand((2, 5)).entropy().shape[1:], 2)
        return sum(x.sum() for x in evaluate(distribution_class, loc, scale, gates, action))

    *primitives, action = *random_primitives(5), torch.zeros(5, 2)
    gradients = []
    for function in (loss, torch.compile(loss, fullgraph=True, backend=backend)):
        inputs = [x.clone().requires_grad_() for x in primitives]
        gradients.append(torch.autograd.grad(function(*inputs, action), inputs))
    torch.testing.assert_close(*gradients)


@both
@pytest.mark.parametrize("validate_args", [True, False])
def test_it_works_under_vmap_and_functional_grad(distribution_class, validate_args):
    *primitives, action = *random_primitives(5), torch.zeros(5, 2, dtype=torch.float64)

    def outputs(*args):
        return evaluate(lambda *a: distribution_class(*a, validate_args=validate_args), *args)

    torch.testing.assert_close(torch.func.vmap(outputs)(*primitives, action), outputs(*primitives, action))

    inputs = [x.clone().requires_grad_() for x in primitives]
    expected = torch.autograd.grad(outputs(*inputs, action)[0].sum(), inputs)
    per_row = torch.func.vmap(torch.func.grad(lambda *args: outputs(*args)[0], argnums=(0, 1, 2)))
    torch.testing.assert_close(per_row(*primitives, action), expected)


BAD_ARGUMENTS = {
    "scale of another length": ({"scale": torch.ones(3, 5)}, r"loc \(3, 2\), scale \(3, 5\).* do not broadcast.*\*B"),
    "gates of another length": ({"gates": torch.ones(4)}, r"gates \(4,\) do not broadcast.*\(\*B, K\)"),
    "no primitive dimension": ({"loc": torch.zeros(2)}, r"loc \(2,\).* lack a dimension for the primitives"),
    "negative gates": ({"gates": torch.tensor([1.0, -0.5, 1.0])}, r"gates of shape \(3,\) holds -0\.5.*sigmoid"),
    "NaN gates": ({"gates": torch.tensor([1.0, torch.nan, 1.0])}, r"gates of shape \(3,\) holds nan.*sigmoid"),
    "infinite gates": ({"gates": torch.tensor([1.0, torch.inf, 1.0])}, r"gates of shape \(3,\) holds inf"),
    "zero scale": ({"scale": torch.zeros(3, 2)}, r"scale of shape \(3, 2\) holds 0\.0.*softplus"),
    "negative scale": ({"scale": -torch.ones(3, 2)}, r"scale of shape \(3, 2\) holds -1\.0.*softplus"),
    "NaN scale": ({"scale": torch.full((3, 2), torch.nan)}, r"scale of shape \(3, 2\) holds nan"),
    "NaN loc": ({"loc": torch.full((3, 2), torch.nan)}, r"loc of shape \(3, 2\) holds nan.*network"),
}


@both
@pytest.mark.parametrize(("bad", "message"), BAD_ARGUMENTS.values(), ids=BAD_ARGUMENTS.keys())
def test_bad_arguments_are_named_with_their_remedy(distribution_class, bad, message):
    good = {"loc": torch.zeros(3, 2), "scale": torch.ones(3, 2), "gates": torch.ones(3)}
    with pytest.raises(ValueError, match=message):
        distribution_class(**good | bad, validate_args=True)


def test_a_mixture_refuses_gates_that_are_all_zero_and_a_product_does_not():
    gates = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    primitives = torch.zeros(2, 2, 3), torch.ones(2, 2, 3)
    with pytest.raises(ValueError, match=r"gates of shape \(2, 2\) hold a row of zeros.*softmax"):
        AdditiveGaussian(*primitives, gates, validate_args=True)
    MultiplicativeGaussian(*primitives, gates, validate_args=True)


@both
def test_a_bad_action_is_refused_when_validation_is_on(distribution_class):
    with pytest.raises(ValueError, match="value"):
        distribution_class(*random_primitives(), validate_args=True).log_prob(torch.full((2,), torch.nan))


def test_a_mixture_refuses_an_action_of_another_length_when_validation_is_on():
    with pytest.raises(ValueError, match="event"):
        AdditiveGaussian(*random_primitives(), validate_args=True).log_prob(torch.zeros(1))


@both
@pytest.mark.parametrize("default", [True, False])
def test_validation_follows_torch_s_default_unless_told(distribution_class, default, monkeypatch):
    monkeypatch.setattr(Distribution, "_validate_args", default)
    bad = torch.zeros(3, 2), torch.ones(3, 2), -torch.ones(3)
    distribution_class(*bad, validate_args=False)
    with pytest.raises(ValueError, match="gates"):
        distribution_class(*bad, validate_args=True)
    if default:
        with pytest.raises(ValueError, match="gates"):
            distribution_class(*bad)
    else:
        distribution_class(*bad)


class Operations(TorchDispatchMode):
    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.add(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


@both
def test_validation_costs_nothing_when_it_is_off(distribution_class):
    primitives = random_primitives(5)
    checks = {"all", "isfinite", "ge", "gt", "_is_all_true", "_local_scalar_dense", "is_nonzero"}
    with Operations() as off:
        distribution_class(*primitives, validate_args=False)
    with Operations() as on:
        distribution_class(*primitives, validate_args=True)
    assert not checks & off.names
    assert checks & on.names


# Properties, over primitives and gates of any sensible size.

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


@both
@properties
@given(arguments=primitives(), data=st.data())
def test_the_order_of_primitives_does_not_matter(distribution_class, arguments, data):
    order = data.draw(st.permutations(range(len(arguments[2]))))
    assert_same(distribution_class(*arguments), distribution_class(*(x[list(order)] for x in arguments)))


@both
@properties
@given(arguments=primitives(), share=st.floats(0.0, 1.0))
def test_splitting_a_primitive_and_its_gate_changes_nothing(distribution_class, arguments, share):
    loc, scale, gates = arguments
    split = torch.cat([gates[:1] * share, gates[:1] * (1 - share), gates[1:]])
    policy = distribution_class(torch.cat([loc[:1], loc]), torch.cat([scale[:1], scale]), split)
    assert_same(policy, distribution_class(*arguments))


@both
@properties
@given(arguments=primitives())
def test_a_closed_primitive_changes_nothing(distribution_class, arguments):
    loc, scale, gates = arguments
    extra = torch.cat([loc, loc[:1] + 100]), torch.cat([scale, scale[:1] / 100]), torch.cat([gates, gates[:1] * 0])
    assert_same(distribution_class(*extra), distribution_class(*arguments))


@both
@properties
@given(arguments=primitives(), shift=st.floats(-10, 10), factor=st.floats(0.1, 10))
def test_moving_and_stretching_the_primitives_moves_and_stretches_the_policy(
    distribution_class, arguments, shift, factor
):
    loc, scale, gates = arguments
    policy, moved = distribution_class(*arguments), distribution_class(factor * loc + shift, factor * scale, gates)
    torch.testing.assert_close(moved.mean, factor * policy.mean + shift)
    torch.testing.assert_close(moved.stddev, factor * policy.stddev)


@both
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
def test_scaling_the_gates_leaves_the_mixture_as_it_was(arguments, factor):
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
