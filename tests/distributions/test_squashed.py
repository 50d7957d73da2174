"""The squashed product, against TorchRL's squashed Gaussian, quadrature of its own density, and float64."""

import pytest
import torch
from torch.distributions import TransformedDistribution, kl_divergence
from torch.distributions.transforms import AffineTransform, TanhTransform
from torchrl.modules import TanhNormal

from torchrl_mcp.distributions import MultiplicativeGaussian, TanhMultiplicativeGaussian

LOW, HIGH = torch.tensor([-1.0, -0.1], dtype=torch.float64), torch.tensor([1.0, 0.3], dtype=torch.float64)


def test_a_single_primitive_is_torchrl_s_tanh_normal(random_primitives):
    loc, scale, _ = random_primitives(5, num_primitives=1)
    policy = TanhMultiplicativeGaussian(loc, scale, torch.ones(5, 1).double(), LOW, HIGH)
    other = TanhNormal(loc[:, 0], scale[:, 0], low=LOW, high=HIGH)
    action = other.sample((100,))
    torch.testing.assert_close(policy.log_prob(action), other.log_prob(action))
    torch.testing.assert_close(policy.deterministic_sample, other.deterministic_sample)
    torch.manual_seed(0)
    ours = policy.rsample((7,))
    torch.manual_seed(0)
    torch.testing.assert_close(ours, other.rsample((7,)))


def test_it_is_the_composite_under_torch_s_transforms(random_primitives):
    primitives = random_primitives(5)
    squash = [TanhTransform(), AffineTransform((HIGH + LOW) / 2, (HIGH - LOW) / 2)]
    other = TransformedDistribution(MultiplicativeGaussian(*primitives), squash)
    action = LOW + (HIGH - LOW) * torch.rand(100, 5, 2, dtype=torch.float64)
    policy = TanhMultiplicativeGaussian(*primitives, LOW, HIGH)
    torch.testing.assert_close(policy.log_prob(action), other.log_prob(action))


def on_a_grid(policy):
    """Actions between the bounds, their density and their distances; the policy has one action in [0, 2]."""
    x = torch.linspace(-16, 16, 20_001, dtype=torch.float64)  # closer to the bounds, where the density may peak
    action = 1 + x.tanh()
    return action, policy.log_prob(action.unsqueeze(-1)).exp(), x.cosh().square().reciprocal() * (x[1] - x[0])


@pytest.mark.parametrize("factor", [0.1, 1.0, 3.0])
def test_density_mean_variance_and_entropy_agree_with_integrals(random_primitives, factor):
    loc, scale, gates = random_primitives(action_dim=1)
    policy = TanhMultiplicativeGaussian(loc, factor * scale, gates, 0.0, 2.0)
    action, density, cell = on_a_grid(policy)
    mean = (density * action * cell).sum()
    torch.testing.assert_close((density * cell).sum(), torch.ones_like(mean), atol=1e-4, rtol=0)
    torch.testing.assert_close(policy.mean[0], mean, atol=1e-4, rtol=0)
    variance = (density * (action - mean) ** 2 * cell).sum()
    torch.testing.assert_close(policy.variance[0], variance, atol=1e-4, rtol=0)
    torch.testing.assert_close(policy.stddev[0], variance.sqrt(), atol=1e-4, rtol=0)
    torch.manual_seed(0)
    entropy = -(torch.special.xlogy(density, density) * cell).sum()
    torch.testing.assert_close(policy.entropy(100_000), entropy, atol=0.02, rtol=0)


@pytest.mark.parametrize("scale", [0.01, 1.0, 5.0])
@pytest.mark.parametrize("loc", [0.0, -3.0])
def test_the_quadrature_of_the_mean_has_its_documented_accuracy(loc, scale):
    policy = TanhMultiplicativeGaussian(torch.full((1, 1), loc).double(), scale, torch.ones(1).double())
    noise = torch.linspace(-9, 9, 100_001, dtype=torch.float64)
    expected = ((loc + scale * noise).tanh() * (-noise.square() / 2).softmax(0)).sum()
    torch.testing.assert_close(policy.mean[0], expected, atol=1e-6, rtol=0)


def test_the_entropy_has_the_gradient_of_the_integral(random_primitives):
    torch.manual_seed(0)
    primitives = [x.requires_grad_() for x in random_primitives(action_dim=1)]
    policy = TanhMultiplicativeGaussian(*primitives, 0.0, 2.0)
    _, density, cell = on_a_grid(policy)
    exact, estimate = -(torch.special.xlogy(density, density) * cell).sum(), policy.entropy(100_000)
    exact, estimate = (torch.autograd.grad(x, primitives, retain_graph=True) for x in (exact, estimate))
    for ours, true in zip(estimate, exact, strict=True):
        torch.testing.assert_close(ours, true, atol=0.02, rtol=0)


def test_the_deterministic_sample_is_the_median(random_primitives):
    torch.manual_seed(0)
    policy = TanhMultiplicativeGaussian(*random_primitives(), LOW, HIGH)
    below = (policy.sample((40_000,)) < policy.deterministic_sample).double().mean(0)
    torch.testing.assert_close(below, torch.full((2,), 0.5).double(), atol=0.01, rtol=0)


def test_gradients_of_samples_match_finite_differences(random_primitives):
    def outputs(loc, scale, gates):
        policy = TanhMultiplicativeGaussian(loc, scale, gates, LOW, HIGH)
        torch.manual_seed(0)
        action = policy.rsample()
        return action, policy.log_prob(action), policy.log_prob(LOW + 0.05), policy.entropy(), policy.mean

    primitives = [x.requires_grad_() for x in random_primitives()]
    assert torch.autograd.gradcheck(outputs, primitives)


@pytest.mark.parametrize("bounds", [(-1.0, 1.0), (0.0, 2.0), (-0.1, 0.3), (10.0, 11.0)])
def test_densities_in_float32_agree_with_float64_up_to_the_bounds(bounds):
    low, high = (torch.tensor(bound, dtype=torch.float32) for bound in bounds)
    steps = [2, 3, 10, 1000, 100_000]  # of rounding, from either bound
    size = torch.maximum(low.abs(), high.abs()) * torch.finfo(torch.float32).eps
    action = torch.cat([low + size * torch.tensor(steps), high - size * torch.tensor(steps)]).unsqueeze(-1)
    loc, scale, gates = torch.tensor([[4.0], [-4.0]]), torch.tensor([[1.0], [2.0]]), torch.tensor([0.2, 0.9])
    exact = TanhMultiplicativeGaussian(loc.double(), scale.double(), gates.double(), low.double(), high.double())
    policy = TanhMultiplicativeGaussian(loc, scale, gates, low, high)
    torch.testing.assert_close(policy.log_prob(action).double(), exact.log_prob(action.double()), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bounds", [(-1.0, 1.0), (-0.1, 0.3), (10.0, 11.0)])
def test_saturated_samples_stay_inside_the_bounds_and_have_finite_densities_and_gradients(dtype, bounds):
    low, high = (torch.tensor(bound, dtype=dtype) for bound in bounds)
    loc = torch.tensor([[50.0, -50.0, 10.0]], dtype=dtype, requires_grad=True)
    policy = TanhMultiplicativeGaussian(loc, 1.0, torch.ones(1, dtype=dtype), low, high)
    action = policy.rsample((100,))
    assert (action > low).all()
    assert (action < high).all()
    for value in (action, action.detach().clone(), low.expand(3), high.expand(3)):
        log_prob = policy.log_prob(value)
        (gradient,) = torch.autograd.grad(log_prob.sum(), loc, retain_graph=True)
        assert log_prob.isfinite().all()
        assert gradient.isfinite().all()


def test_the_density_of_a_saturated_sample_is_that_of_what_was_drawn():
    torch.manual_seed(0)
    loc = torch.tensor([[20.0, -20.0]])
    policy = TanhMultiplicativeGaussian(loc, 0.5, torch.ones(1))
    exact = TanhMultiplicativeGaussian(loc.double(), 0.5, torch.ones(1).double())
    torch.manual_seed(0)
    x = policy.base_dist.rsample((5,)).double()
    expected = exact.base_dist.log_prob(x) - torch.log(torch.cosh(x).reciprocal().square()).sum(-1)
    torch.manual_seed(0)
    action = policy.rsample((5,))
    assert policy.deterministic_sample.isfinite().all()  # and does not disturb the sample
    torch.testing.assert_close(policy.log_prob(action).double(), expected)


def test_the_divergence_is_that_before_squashing(random_primitives):
    first, second = random_primitives(5, seed=1), random_primitives(5, seed=2)
    p, q = (TanhMultiplicativeGaussian(*x, LOW, HIGH) for x in (first, second))
    expected = kl_divergence(MultiplicativeGaussian(*first), MultiplicativeGaussian(*second))
    torch.testing.assert_close(kl_divergence(p, q), expected)
    torch.manual_seed(0)
    action = p.sample((100_000,))
    torch.testing.assert_close((p.log_prob(action) - q.log_prob(action)).mean(0), expected, atol=0.05, rtol=0.05)


def test_no_divergence_is_computed_between_different_bounds(random_primitives):
    p = TanhMultiplicativeGaussian(*random_primitives(), LOW, HIGH)
    with pytest.raises(NotImplementedError):
        kl_divergence(p, TanhMultiplicativeGaussian(*random_primitives(), LOW, 2 * HIGH))


def test_the_support_is_the_interval(random_primitives):
    policy = TanhMultiplicativeGaussian(*random_primitives(), LOW, HIGH)
    inside = policy.support.check(torch.stack([LOW, HIGH, LOW - 0.01, HIGH + 0.01]))
    assert inside.tolist() == [True, True, False, False]


def test_numbers_and_tensors_as_bounds_have_the_same_density_in_float64(random_primitives):
    loc, scale, gates = random_primitives(5, action_dim=4)
    numbers = TanhMultiplicativeGaussian(loc, scale, gates, low=-0.1, high=0.1)
    tensors = TanhMultiplicativeGaussian(loc, scale, gates, low=[-0.1], high=torch.tensor(0.1, dtype=torch.float64))
    actions = numbers.sample()
    torch.testing.assert_close(numbers.log_prob(actions), tensors.log_prob(actions), atol=1e-12, rtol=0.0)


def test_the_mean_keeps_its_precision_under_autocast(random_primitives):
    policy = TanhMultiplicativeGaussian(*random_primitives(5, dtype=torch.float32))
    expected = policy.mean
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(policy.mean, expected)


def test_bounds_are_the_same_as_numbers_and_as_tensors(random_primitives):
    first, second = random_primitives(seed=1), random_primitives(seed=2)
    p = TanhMultiplicativeGaussian(*first, low=-0.1, high=0.1)
    bounds = torch.tensor([[-0.1, -0.1], [0.1, 0.1]], dtype=torch.float64)
    q = TanhMultiplicativeGaussian(*second, *bounds)
    expected = kl_divergence(MultiplicativeGaussian(*first), MultiplicativeGaussian(*second))
    torch.testing.assert_close(kl_divergence(p, q), expected)
