import math

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian

GRID = torch.linspace(-12, 12, 401, dtype=torch.float64)


def random_primitives(*batch, num_primitives=3, action_dim=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    loc = 2 * torch.randn(*batch, num_primitives, action_dim, generator=generator, dtype=torch.float64)
    scale = torch.rand(*batch, num_primitives, action_dim, generator=generator, dtype=torch.float64) + 0.5
    gates = torch.rand(*batch, num_primitives, generator=generator, dtype=torch.float64) + 0.1
    return loc, scale, gates


def actions_on_a_grid(action_dim):
    return torch.cartesian_prod(*[GRID] * action_dim).reshape(-1, action_dim)


def mixture_density(actions, loc, scale, gates):
    """Eq. 1 written from the Gaussian density itself."""
    density = (-((actions[:, None] - loc) ** 2) / (2 * scale**2)).exp() / (scale * math.sqrt(2 * math.pi))
    return density.prod(-1) @ (gates / gates.sum())


def entropy_by_quadrature(loc, scale, gates):
    density = mixture_density(actions_on_a_grid(loc.shape[-1]), loc, scale, gates)
    return -torch.special.xlogy(density, density).sum() * (GRID[1] - GRID[0]) ** loc.shape[-1]


@pytest.mark.parametrize("action_dim", [1, 2])
def test_it_is_the_gated_sum_of_densities(action_dim):
    loc, scale, gates = random_primitives(action_dim=action_dim)
    actions, cell = actions_on_a_grid(action_dim), (GRID[1] - GRID[0]) ** action_dim
    density = mixture_density(actions, loc, scale, gates)
    mean = (density[:, None] * actions).sum(0) * cell
    variance = (density[:, None] * (actions - mean) ** 2).sum(0) * cell

    policy = AdditiveGaussian(loc, scale, gates)
    torch.testing.assert_close(policy.log_prob(actions).exp(), density)
    torch.testing.assert_close(policy.log_prob(actions).exp().sum() * cell, torch.ones_like(cell))
    torch.testing.assert_close(policy.mean, mean)
    torch.testing.assert_close(policy.variance, variance)
    torch.testing.assert_close(policy.stddev, variance.sqrt())


@pytest.mark.parametrize("action_dim", [1, 2])
def test_entropy_has_the_value_and_the_gradient_of_the_integral(action_dim):
    torch.manual_seed(0)
    primitives = [x.requires_grad_() for x in random_primitives(action_dim=action_dim)]
    exact, estimate = entropy_by_quadrature(*primitives), AdditiveGaussian(*primitives).entropy(40_000)
    torch.testing.assert_close(estimate, exact, atol=0.01, rtol=0)
    for ours, true in zip(
        torch.autograd.grad(estimate, primitives), torch.autograd.grad(exact, primitives), strict=True
    ):
        torch.testing.assert_close(ours, true, atol=0.02, rtol=0)


def test_entropy_of_one_sample_is_unbiased():
    torch.manual_seed(0)
    primitives = random_primitives(action_dim=1)
    estimates = AdditiveGaussian(*primitives).expand((40_000,)).entropy()
    assert estimates.shape == (40_000,)
    torch.testing.assert_close(estimates.mean(), entropy_by_quadrature(*primitives), atol=0.01, rtol=0)


def test_a_single_primitive_is_torch_s_normal():
    loc, scale, gates = random_primitives(5, num_primitives=1)
    policy, normal = AdditiveGaussian(loc, scale, gates), Independent(Normal(loc[:, 0], scale[:, 0]), 1)
    action = normal.sample((7,))
    torch.testing.assert_close(policy.log_prob(action), normal.log_prob(action))
    torch.testing.assert_close(policy.mean, normal.mean)
    torch.testing.assert_close(policy.stddev, normal.stddev)
    torch.manual_seed(0)
    torch.testing.assert_close(policy.entropy(20_000), normal.entropy(), atol=0.03, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_open_gate_recovers_that_primitive_even_in_its_tails(dtype):
    loc, scale, _ = (x.to(dtype) for x in random_primitives())
    for k, gates in enumerate(torch.eye(3, dtype=dtype)):
        policy, normal = AdditiveGaussian(loc, scale, gates), Independent(Normal(loc[k], scale[k]), 1)
        far = loc[k] + 20 * scale[k] * torch.tensor([[0.0], [1.0], [-1.0]], dtype=dtype)
        torch.testing.assert_close(policy.log_prob(far), normal.log_prob(far))
        torch.testing.assert_close(policy.mean, loc[k])


def test_gates_are_normalised_to_sum_to_one():
    loc, scale, gates = random_primitives(5)
    probs = AdditiveGaussian(loc, scale, gates).mixture_distribution.probs
    torch.testing.assert_close(probs, gates / gates.sum(-1, keepdim=True))


def test_samples_come_from_one_primitive_at_a_time():
    torch.manual_seed(0)
    loc = torch.tensor([[-5.0, 5.0], [5.0, -5.0]])
    samples = AdditiveGaussian(loc, torch.full((2, 2), 0.1), torch.tensor([3.0, 1.0])).sample((20_000,))
    distance = (samples.unsqueeze(-2) - loc).abs().amax(-1)
    assert (distance.min(-1).values < 0.6).all()
    torch.testing.assert_close((distance.argmin(-1) == 0).float().mean(), torch.tensor(0.75), atol=0.015, rtol=0)


def test_deterministic_sample_is_the_mean_of_the_most_likely_primitive():
    loc, scale, _ = random_primitives(2, 5)
    gates = torch.nn.functional.one_hot(torch.arange(10).reshape(2, 5) % 3, 3) + 0.5
    expected = torch.stack([loc[i, j, (5 * i + j) % 3] for i in range(2) for j in range(5)]).reshape(2, 5, 2)
    assert torch.equal(AdditiveGaussian(loc, scale, gates).deterministic_sample, expected)


def test_gradients_of_everything_match_finite_differences():
    action = torch.tensor([0.3, -0.7], dtype=torch.float64)

    def outputs(loc, scale, gates):
        policy = AdditiveGaussian(loc, scale, gates)
        torch.manual_seed(0)
        return policy.log_prob(action), policy.entropy(2), policy.mean, policy.stddev, policy.deterministic_sample

    primitives = [x.requires_grad_() for x in random_primitives()]
    assert torch.autograd.gradcheck(outputs, primitives, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(outputs, primitives)


def test_the_gradient_at_a_closed_gate_is_the_slope_of_opening_it():
    loc, scale, gates = random_primitives()
    gates[0] = 0.0
    action, step = loc[0] / 2, torch.tensor([1e-10, 0, 0], dtype=torch.float64)

    def log_prob(gates):
        return AdditiveGaussian(loc, scale, gates).log_prob(action)

    slope = (log_prob(gates + step) - log_prob(gates)) / step[0]
    torch.testing.assert_close(torch.autograd.functional.jacobian(log_prob, gates)[0], slope, rtol=1e-3, atol=0)


def test_all_gates_closed_are_a_mixture_in_equal_parts_when_validation_is_off():
    loc, scale, gates = random_primitives(4)
    closed, equal = (AdditiveGaussian(loc, scale, g, validate_args=False) for g in (gates * 0, gates * 0 + 1))
    torch.testing.assert_close(closed.log_prob(loc[:, 0]), equal.log_prob(loc[:, 0]))
    assert closed.sample().isfinite().all()


@pytest.mark.parametrize("gate", [1e-30, 1e-38, 5e-39, 1e-42, 2e-45])
def test_a_primitive_with_a_subnormal_gate_counts_where_it_alone_explains_the_action(gate):
    loc, scale, action = torch.tensor([[0.0, 0.0], [10.0, 10.0]]), torch.full((2, 2), 0.5), torch.tensor([10.2, 9.9])
    gates = torch.tensor([1.0, gate])
    exact = Normal(10.0, 0.5).log_prob(action.double()).sum() + gates[1].double().log()
    gates.requires_grad_()
    log_prob = AdditiveGaussian(loc, scale, gates).log_prob(action)
    torch.testing.assert_close(log_prob.double(), exact, atol=1e-4, rtol=0)
    (gradient,) = torch.autograd.grad(log_prob, gates)
    assert gradient.isfinite().all()
    if gate >= 3e-39:  # the inverse of a smaller one is beyond float32
        torch.testing.assert_close(gradient[1] * gates[1].detach(), torch.tensor(1.0))


@pytest.mark.parametrize("action_dim", [1, 2])
def test_kl_divergence_has_the_value_and_the_gradient_of_the_integral(action_dim):
    torch.manual_seed(0)
    first = [x.requires_grad_() for x in random_primitives(action_dim=action_dim, seed=1)]
    second = [x.requires_grad_() for x in random_primitives(num_primitives=2, action_dim=action_dim, seed=2)]
    actions, cell = actions_on_a_grid(action_dim), (GRID[1] - GRID[0]) ** action_dim
    p, q = mixture_density(actions, *first), mixture_density(actions, *second)
    exact = (torch.special.xlogy(p, p) - torch.special.xlogy(p, q)).sum() * cell
    estimate = kl_divergence(AdditiveGaussian(*first).expand((20_000,)), AdditiveGaussian(*second)).mean()
    torch.testing.assert_close(estimate, exact, atol=0, rtol=0.02)
    for ours, true in zip(
        torch.autograd.grad(estimate, first + second), torch.autograd.grad(exact, first + second), strict=True
    ):
        torch.testing.assert_close(ours, true, atol=0.05, rtol=0.05)


def test_kl_divergence_broadcasts_and_is_zero_to_itself():
    policy = AdditiveGaussian(*random_primitives(5))
    torch.testing.assert_close(kl_divergence(policy, policy.expand((2, 5))), torch.zeros(2, 5, dtype=torch.float64))


def test_divergences_between_a_mixture_and_a_gaussian_have_the_value_of_the_integral():
    torch.manual_seed(0)
    mixture = AdditiveGaussian(torch.tensor([[-1.0], [1.0]]), torch.tensor([[0.5], [0.8]]), torch.tensor([0.3, 0.7]))
    gaussian = MultiplicativeGaussian(torch.tensor([[0.4]]), torch.tensor([[1.1]]), torch.ones(1))
    x = torch.linspace(-12, 12, 40_001).unsqueeze(-1)
    for p, q in ((mixture, gaussian), (gaussian, mixture)):
        exact = torch.trapezoid(p.log_prob(x).exp() * (p.log_prob(x) - q.log_prob(x)), x.squeeze(-1))
        drawn = kl_divergence(p.expand((20_000,)), q).mean()
        torch.testing.assert_close(drawn, exact, atol=0.02, rtol=0.0)
