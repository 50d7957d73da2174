import pytest
import torch

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian


@pytest.fixture(scope="session", params=[MultiplicativeGaussian, AdditiveGaussian])
def distribution_class(request):
    """Either mixer."""
    return request.param


@pytest.fixture(scope="session")
def random_primitives():
    """Means, positive scales and open gates of a given shape."""

    def random_primitives(*batch, num_primitives=3, action_dim=2, seed=0, dtype=torch.float64):
        generator = torch.Generator().manual_seed(seed)
        loc = torch.randn(*batch, num_primitives, action_dim, generator=generator, dtype=torch.float64)
        scale = torch.rand(*batch, num_primitives, action_dim, generator=generator, dtype=torch.float64) + 0.5
        gates = torch.rand(*batch, num_primitives, generator=generator, dtype=torch.float64) + 0.1
        return loc.to(dtype), scale.to(dtype), gates.to(dtype)

    return random_primitives


@pytest.fixture(scope="session")
def assert_same():
    """Compare the densities, means and deviations of two distributions."""

    def assert_same(p, q):
        action = p.sample((20,))
        torch.testing.assert_close(p.log_prob(action), q.log_prob(action))
        torch.testing.assert_close(p.mean, q.mean)
        torch.testing.assert_close(p.stddev, q.stddev)

    return assert_same
