import math

import pytest
import torch
from torch.distributions import Independent, Normal, kl_divergence

from torchrl_mcp.distributions import MultiplicativeGaussian

GRID = torch.linspace(-30, 30, 1201, dtype=torch.float64)


def random_primitives(*batch, num_primitives=3, action_dim=2, seed=0):
    generator = torch.Generator().manual_seed(seed)
    loc = torch.randn(*batch, num_primitives, action_dim, generator=generator, dtype=torch.float64)
    scale = torch.rand(*batch, num_primitives, action_dim, generator=generator, dtype=torch.float64) + 0.5
    gates = torch.rand(*batch, num_primitives, generator=generator, dtype=torch.float64) + 0.1
    return loc, scale, gates


def actions_on_a_grid(action_dim):
    return torch.cartesian_prod(*[GRID] * action_dim).reshape(-1, action_dim)


def product_of_powers(actions, loc, scale, gates):
    """Eq. 3 without its 1 / Z, written from the Gaussian density itself."""
    density = (-((actions[:, None] - loc) ** 2) / (2 * scale**2)).exp() / (scale * math.sqrt(2 * math.pi))
    return (density.prod(-1) ** gates).prod(-1)


@pytest.mark.parametrize("action_dim", [1, 2])
def test_it_is_the_renormalised_product_of_powers(action_dim):
    loc, scale, gates = random_primitives(action_dim=action_dim)
    actions, cell = actions_on_a_grid(action_dim), (GRID[1] - GRID[0]) ** action_dim
    product = product_of_powers(actions, loc, scale, gates)
    density = product / (product.sum() * cell)
    mean = (density[:, None] * actions).sum(0) * cell
    variance = (density[:, None] * (actions - mean) ** 2).sum(0) * cell
    entropy = -torch.special.xlogy(density, density).sum() * cell

    policy = MultiplicativeGaussian(loc, scale, gates)
    torch.testing.assert_close(policy.log_prob(actions).exp(), density)
    torch.testing.assert_close(policy.mean, mean)
    torch.testing.assert_close(policy.variance, variance)
    torch.testing.assert_close(policy.stddev, variance.sqrt())
    torch.testing.assert_close(policy.entropy(), entropy)


def test_mode_and_deterministic_sample_are_where_the_density_peaks():
    policy = MultiplicativeGaussian(*random_primitives(action_dim=1))
    peak = GRID[policy.log_prob(GRID[:, None]).argmax()]
    for point in (policy.mode, policy.deterministic_sample):
        torch.testing.assert_close(point[0], peak, atol=0.03, rtol=0)


def test_a_single_primitive_under_a_gate_of_one_is_torch_s_normal():
    loc, scale, _ = random_primitives(5, num_primitives=1)
    policy = MultiplicativeGaussian(loc, scale, torch.ones(5, 1))
    normal = Independent(Normal(loc.squeeze(-2), scale.squeeze(-2)), 1)
    torch.manual_seed(0)
    action = policy.rsample((7,))
    torch.manual_seed(0)
    torch.testing.assert_close(action, normal.rsample((7,)))
    torch.testing.assert_close(policy.log_prob(action), normal.log_prob(action))
    torch.testing.assert_close(policy.entropy(), normal.entropy())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_open_gate_recovers_that_primitive(dtype):
    loc, scale, _ = (x.to(dtype) for x in random_primitives(4))
    for k, gates in enumerate(torch.eye(3, dtype=dtype)):
        policy = MultiplicativeGaussian(loc, scale, gates)
        torch.testing.assert_close(policy.mean, loc[..., k, :])
        torch.testing.assert_close(policy.stddev, scale[..., k, :])


def test_samples_have_the_composite_moments():
    torch.manual_seed(0)
    policy = MultiplicativeGaussian(*random_primitives())
    samples = policy.rsample((40_000,))
    torch.testing.assert_close(samples.mean(0), policy.mean, atol=0.02, rtol=0)
    torch.testing.assert_close(samples.var(0), policy.variance, atol=0, rtol=0.05)


def test_gradients_of_everything_match_finite_differences():
    action = torch.tensor([0.3, -0.7], dtype=torch.float64)

    def outputs(loc, scale, gates):
        policy = MultiplicativeGaussian(loc, scale, gates)
        torch.manual_seed(0)
        return policy.log_prob(action), policy.entropy(), policy.mean, policy.stddev, policy.rsample()

    primitives = [x.requires_grad_() for x in random_primitives()]
    assert torch.autograd.gradcheck(outputs, primitives, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(outputs, primitives)


# 1e-3 and 1e3: a closed primitive may be far sharper or far flatter than the open ones.
@pytest.mark.parametrize("closed_scale", [1e-3, 1.0, 1e3])
def test_the_gradient_at_a_closed_gate_is_the_slope_of_opening_it(closed_scale):
    loc, scale, gates = random_primitives()
    scale[0], gates[0] = closed_scale, 0.0
    step = torch.tensor([1e-7 * min(closed_scale, 1.0) ** 2, 0, 0], dtype=torch.float64)

    def outputs(gates):
        policy = MultiplicativeGaussian(loc, scale, gates)
        return torch.cat([policy.log_prob(torch.full((1, 2), 0.3)), policy.mean, policy.stddev])

    slope = (outputs(gates + step) - outputs(gates)) / step[0]
    jacobian = torch.autograd.functional.jacobian(outputs, gates)
    torch.testing.assert_close(jacobian[:, 0], slope, rtol=1e-5, atol=1e-8)


def test_all_gates_closed_leave_the_documented_broad_gaussian():
    loc, scale, gates = (x.float() for x in random_primitives(4))
    policy = MultiplicativeGaussian(loc, scale, gates * 0)
    torch.testing.assert_close(policy.mean, torch.zeros(4, 2))
    torch.testing.assert_close(policy.stddev, torch.full((4, 2), 1e4))
    assert policy.sample((1000,)).half().isfinite().all()


@pytest.mark.parametrize("scale", [1e-16, 1e-25, 1e-38])
def test_a_closed_primitive_however_narrow_leaves_the_others_as_they_are(scale):
    loc = torch.tensor([[3.0], [1.0]], requires_grad=True)
    for gates, mean, stddev in ((torch.tensor([0.0, 1.0]), 1.0, 2.0), (torch.zeros(2), 0.0, 1e4)):
        policy = MultiplicativeGaussian(loc, torch.tensor([[scale], [2.0]]), gates.requires_grad_())
        assert (policy.mean.item(), policy.stddev.item()) == pytest.approx((mean, stddev))
        policy.log_prob(torch.ones(1)).backward()
        assert loc.grad.isfinite().all()


def test_an_open_primitive_is_at_least_as_wide_as_documented_and_has_finite_gradients():
    loc, scale = torch.tensor([[3.0], [1.0]]), torch.tensor([[1e-38], [2.0]], requires_grad=True)
    gates = torch.tensor([0.25, 1.0], requires_grad=True)
    policy = MultiplicativeGaussian(loc, scale, gates)
    assert (policy.mean.item(), policy.stddev.item()) == pytest.approx((3.0, 2e-12))
    policy.log_prob(torch.tensor([3.0])).backward()
    assert scale.grad.isfinite().all()
    assert gates.grad.isfinite().all()


def test_the_floor_on_the_precision_is_reached_without_a_jump():
    loc, scale = torch.full((1, 1), 3.0, dtype=torch.float64), torch.ones(1, 1, dtype=torch.float64)
    above, below = (MultiplicativeGaussian(loc, scale, torch.tensor([1e-8 * r])) for r in (1.001, 0.999))
    torch.testing.assert_close(above.mean, loc[0], rtol=1e-6, atol=0)
    torch.testing.assert_close(above.mean, below.mean, rtol=2e-3, atol=0)
    torch.testing.assert_close(above.stddev, below.stddev, rtol=2e-3, atol=0)


def as_diagonal(loc, scale, gates):
    return Independent(Normal(loc[..., 0, :], scale[..., 0, :]), 1)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        (MultiplicativeGaussian, MultiplicativeGaussian),
        (MultiplicativeGaussian, as_diagonal),
        (as_diagonal, MultiplicativeGaussian),
    ],
)
@pytest.mark.parametrize("expanded", [False, True])
def test_kl_divergence_is_the_integral_it_stands_for(first, second, expanded):
    p = first(*random_primitives(action_dim=1, seed=1))
    q = second(*random_primitives(action_dim=1, seed=2))
    log_p, log_q = p.log_prob(GRID[:, None]), q.log_prob(GRID[:, None])
    integral = (log_p.exp() * (log_p - log_q)).sum() * (GRID[1] - GRID[0])
    if expanded:
        p, q, integral = p.expand((4,)), q.expand((4,)), integral.expand(4)
    torch.testing.assert_close(kl_divergence(p, q), integral)
