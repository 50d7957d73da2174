"""What torch asks of a distribution: shapes, types, gradients, ``expand``, pickling, compilation and ``vmap``."""

import itertools
import pickle

import pytest
import torch
from refusals import refused
from torch.export import Dim, export

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian, TanhMultiplicativeGaussian


@pytest.fixture(params=[MultiplicativeGaussian, AdditiveGaussian, TanhMultiplicativeGaussian])
def distribution_class(request):
    return request.param


@pytest.mark.parametrize("batch", [(), (5,), (2, 5)])
def test_shapes_are_torch_s(distribution_class, batch, random_primitives):
    policy = distribution_class(*random_primitives(*batch, num_primitives=4, action_dim=3))
    assert policy.batch_shape == batch
    assert policy.event_shape == (3,)
    assert policy.sample((7,)).shape == (7, *batch, 3)
    assert policy.log_prob(policy.sample((7,))).shape == (7, *batch)
    assert policy.entropy().shape == batch
    for statistic in (policy.mean, policy.variance, policy.stddev, policy.deterministic_sample):
        assert statistic.shape == (*batch, 3)


def test_the_primitives_and_gates_are_attributes(distribution_class, random_primitives):
    loc, scale, gates = random_primitives(5)
    policy = distribution_class(loc, scale[0, :, :1], gates)
    assert torch.equal(policy.loc, loc)
    assert torch.equal(policy.scale, scale[0, :, :1].expand(5, 3, 2))
    assert torch.equal(policy.gates, gates)


def test_it_prints_its_name_and_shapes(distribution_class, random_primitives):
    expected = f"{distribution_class.__name__}(loc (5, 3, 2), scale (5, 3, 2), gates (5, 3))"
    assert repr(distribution_class(*random_primitives(5))) == expected


def test_a_number_is_the_same_scale_for_all_primitives_and_actions(distribution_class, random_primitives):
    loc, scale, gates = random_primitives(5)
    policy, expected = (distribution_class(loc, value, gates) for value in (0.7, torch.full_like(scale, 0.7)))
    assert torch.equal(policy.stddev, expected.stddev)
    half = distribution_class(loc.bfloat16(), 0.7, gates.bfloat16())
    assert torch.equal(half.scale, torch.full((5, 3, 2), 0.7))  # not rounded to bfloat16


@pytest.mark.parametrize("name", ["cdf", "icdf", "mode", "rsample"])
def test_what_has_no_closed_form_is_refused(distribution_class, name, random_primitives):
    policy = distribution_class(*random_primitives())
    if name == "mode" and distribution_class is MultiplicativeGaussian:
        assert torch.equal(policy.mode, policy.mean)
    elif name == "rsample" and distribution_class is not AdditiveGaussian:
        assert policy.rsample().shape == (2,)
    else:
        remedy = {"mode": "deterministic_sample", "rsample": "TanhMultiplicativeGaussian"}.get(name, name)
        refused(lambda: getattr(policy, name)(torch.zeros(2)), remedy, error=NotImplementedError)


def test_a_batch_equals_its_rows_one_by_one(distribution_class, random_primitives):
    loc, scale, gates = random_primitives(2, 5)
    policy = distribution_class(loc, scale, gates)
    action = policy.sample()
    for i, j in itertools.product(range(2), range(5)):
        row = distribution_class(loc[i, j], scale[i, j], gates[i, j])
        torch.testing.assert_close(policy.log_prob(action)[i, j], row.log_prob(action[i, j]))


def test_arguments_broadcast(distribution_class, random_primitives, assert_same):
    loc, scale, _ = random_primitives(num_primitives=3)
    _, _, gates = random_primitives(5, num_primitives=3)
    policy = distribution_class(loc, scale[:, :1], gates)
    assert policy.batch_shape == (5,)
    assert_same(policy, distribution_class(loc.expand(5, 3, 2), scale[:, :1].expand(5, 3, 2), gates))


@pytest.mark.parametrize(
    ("dtype", "result"),
    [(torch.float64, torch.float64), (torch.float32, torch.float32), (torch.bfloat16, torch.float32)],
)
def test_it_computes_in_float32_at_least(distribution_class, dtype, result, random_primitives):
    primitives = random_primitives(50, num_primitives=8, action_dim=28, dtype=dtype)
    policy, exact = distribution_class(*primitives), distribution_class(*(x.double() for x in primitives))
    action = policy.sample()
    assert action.dtype == policy.log_prob(action).dtype == policy.entropy().dtype == policy.mean.dtype == result
    torch.testing.assert_close(policy.log_prob(action).double(), exact.log_prob(action.double()), atol=1e-3, rtol=0)


def test_gradients_return_in_the_type_of_the_arguments(distribution_class, random_primitives):
    primitives = [x.requires_grad_() for x in random_primitives(5, dtype=torch.bfloat16)]
    distribution_class(*primitives).log_prob(torch.zeros(2)).sum().backward()
    assert all(x.grad.dtype == torch.bfloat16 and x.grad.isfinite().all() for x in primitives)


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


def test_an_expanded_distribution_is_itself_over_a_larger_batch(distribution_class, random_primitives):
    policy = distribution_class(*random_primitives(5))
    expanded = policy.expand((2, 5))
    assert type(expanded) is distribution_class
    assert expanded.batch_shape == (2, 5)
    assert expanded.sample().shape == expanded.deterministic_sample.shape == (2, 5, 2)
    assert expanded.entropy().shape == (2, 5)
    assert expanded.loc.shape == expanded.scale.shape == (2, 5, 3, 2)
    assert torch.equal(expanded.gates, policy.gates.expand(2, 5, 3))
    action = policy.sample()
    torch.testing.assert_close(expanded.log_prob(action), policy.log_prob(action).expand(2, 5))


def test_a_subclass_expands_to_its_own_type(distribution_class, random_primitives):
    class Child(distribution_class):
        pass

    assert type(Child(*random_primitives()).expand((4,))) is Child


def test_it_survives_pickling(distribution_class, assert_same, random_primitives):
    policy = distribution_class(*random_primitives())
    assert_same(pickle.loads(pickle.dumps(policy)), policy)


def evaluate(distribution_class, loc, scale, gates, action):
    policy = distribution_class(loc, scale, gates)
    return policy.log_prob(action), policy.mean, policy.stddev, policy.deterministic_sample


@pytest.mark.parametrize("backend", ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_it_compiles_into_one_graph(distribution_class, backend, random_primitives):
    def loss(loc, scale, gates, action):
        policy = distribution_class(loc, scale, gates)
        assert policy.sample().shape == (*policy.expand((2, 5)).entropy().shape[1:], 2)
        return sum(x.sum() for x in evaluate(distribution_class, loc, scale, gates, action))

    torch.compiler.reset()
    *primitives, action = *random_primitives(5), torch.zeros(5, 2)
    gradients = []
    for function in (loss, torch.compile(loss, fullgraph=True, backend=backend)):
        inputs = [x.clone().requires_grad_() for x in primitives]
        gradients.append(torch.autograd.grad(function(*inputs, action), inputs))
    torch.testing.assert_close(*gradients)


@pytest.mark.parametrize("validate_args", [True, False, None])
def test_it_works_under_vmap_and_functional_grad(distribution_class, validate_args, random_primitives):
    *primitives, action = *random_primitives(5), torch.zeros(5, 2, dtype=torch.float64)

    def outputs(*args):
        return evaluate(lambda *a: distribution_class(*a, validate_args=validate_args), *args)

    torch.testing.assert_close(torch.func.vmap(outputs)(*primitives, action), outputs(*primitives, action))

    inputs = [x.clone().requires_grad_() for x in primitives]
    expected = torch.autograd.grad(outputs(*inputs, action)[0].sum(), inputs)
    per_row = torch.func.vmap(torch.func.grad(lambda *args: outputs(*args)[0], argnums=(0, 1, 2)))
    torch.testing.assert_close(per_row(*primitives, action), expected)


class Evaluated(torch.nn.Module):
    """The numbers of a policy as a module, which is what torch.export takes."""

    def __init__(self, distribution_class):
        super().__init__()
        self.distribution_class = distribution_class

    def forward(self, loc, scale, gates, action):
        return evaluate(lambda *x: self.distribution_class(*x, validate_args=False), loc, scale, gates, action)


def test_it_exports_with_any_batch_size(distribution_class, random_primitives):
    module, batch = Evaluated(distribution_class), Dim("batch")

    def inputs(size):
        return *random_primitives(size), torch.zeros(size, 2, dtype=torch.float64)

    exported = export(module, inputs(4), dynamic_shapes=[{0: batch}] * 4).module()
    for size in (2, 7):
        torch.testing.assert_close(exported(*inputs(size)), module(*inputs(size)))
