"""Bad shapes are always refused, bad values where validation is on, and checks cost nothing where it is off."""

import pytest
import torch
from torch.distributions import Distribution
from torch.utils._python_dispatch import TorchDispatchMode

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian, TanhMultiplicativeGaussian


@pytest.fixture(params=[MultiplicativeGaussian, AdditiveGaussian, TanhMultiplicativeGaussian])
def distribution_class(request):
    return request.param


BAD_SHAPES = {
    "scale of another length": ({"scale": torch.ones(3, 5)}, r"loc \(3, 2\), scale \(3, 5\).* do not broadcast.*\*B"),
    "gates of another length": ({"gates": torch.ones(4)}, r"gates \(4,\) do not broadcast.*\(\*B, K\)"),
    "a key that TorchRL did not find": (
        {"gates": None},
        "gates is None, must be a tensor. TorchRL passes",
    ),
    "no primitive dimension": ({"loc": torch.zeros(2)}, r"loc \(2,\).* lack a dimension for the primitives"),
    "gates without a dimension": ({"gates": torch.tensor(1.0)}, r"gates \(\) lack a dimension for the primitives"),
    "one gate for all": ({"gates": torch.ones(1)}, r"gates \(1,\) do not have a gate for each primitive"),
    "gates with one dimension more": (
        {"loc": torch.zeros(5, 3, 2), "gates": torch.ones(5, 1, 3)},
        r"loc \(5, 3, 2\), scale \(3, 2\), gates \(5, 1, 3\) have different batch shapes.* batch of \(5, 5\)",
    ),
}

BAD_VALUES = {
    "negative gates": ({"gates": torch.tensor([1.0, -0.5, 1.0])}, r"gates of shape \(3,\) holds -0\.5.*sigmoid"),
    "NaN gates": ({"gates": torch.tensor([1.0, torch.nan, 1.0])}, r"gates of shape \(3,\) holds nan.*sigmoid"),
    "infinite gates": ({"gates": torch.tensor([1.0, torch.inf, 1.0])}, r"gates of shape \(3,\) holds inf"),
    "zero scale": ({"scale": torch.zeros(3, 2)}, r"scale of shape \(3, 2\) holds 0\.0.*softplus"),
    "negative scale": ({"scale": -torch.ones(3, 2)}, r"scale of shape \(3, 2\) holds -1\.0.*softplus"),
    "NaN scale": ({"scale": torch.full((3, 2), torch.nan)}, r"scale of shape \(3, 2\) holds nan"),
    "NaN loc": ({"loc": torch.full((3, 2), torch.nan)}, r"loc of shape \(3, 2\) holds nan.*network"),
}


@pytest.mark.parametrize("validate_args", [True, False])
@pytest.mark.parametrize(("bad", "message"), BAD_SHAPES.values(), ids=BAD_SHAPES.keys())
def test_bad_shapes_are_always_named_with_their_remedy(distribution_class, bad, message, validate_args):
    good = {"loc": torch.zeros(3, 2), "scale": torch.ones(3, 2), "gates": torch.ones(3)}
    with pytest.raises(ValueError, match=message):
        distribution_class(**good | bad, validate_args=validate_args)


@pytest.mark.parametrize(("bad", "message"), BAD_VALUES.values(), ids=BAD_VALUES.keys())
def test_bad_values_are_named_with_their_remedy(distribution_class, bad, message):
    good = {"loc": torch.zeros(3, 2), "scale": torch.ones(3, 2), "gates": torch.ones(3)}
    with pytest.raises(ValueError, match=message):
        distribution_class(**good | bad, validate_args=True)


def test_a_mixture_refuses_gates_that_are_all_zero_and_a_product_does_not():
    gates = torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    primitives = torch.zeros(2, 2, 3), torch.ones(2, 2, 3)
    with pytest.raises(ValueError, match=r"gates of shape \(2, 2\) hold a row of zeros.*softmax"):
        AdditiveGaussian(*primitives, gates, validate_args=True)
    MultiplicativeGaussian(*primitives, gates, validate_args=True)


@pytest.mark.parametrize("validate_args", [True, False])
@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        (1.0, -1.0, r"low=1\.0 is not below high=-1\.0"),
        (0.0, 0.0, r"low=0\.0 is not below high=0\.0"),
        (
            torch.zeros(5, 2),
            torch.ones(5, 2),
            r"\(5, 2\).* do not fit 2 actions: pass finite numbers or tensors of shape \(A,\)",
        ),
        (torch.zeros(3), 1.0, r"\(3,\).* do not fit 2 actions"),
    ],
)
def test_bad_bounds_are_named_with_their_remedy(low, high, message, validate_args, random_primitives):
    with pytest.raises(ValueError, match=message):
        TanhMultiplicativeGaussian(*random_primitives(), low, high, validate_args=validate_args)


def test_the_values_of_bounds_are_checked_when_validation_is_on(random_primitives):
    low, high = torch.tensor([-1.0, 2.0]), torch.tensor([1.0, 1.0])
    with pytest.raises(ValueError, match="is not below high"):
        TanhMultiplicativeGaussian(*random_primitives(), low, high, validate_args=True)


@pytest.mark.parametrize("action", [-1.5, 1.5])
def test_an_action_outside_the_bounds_is_refused_when_validation_is_on(action, random_primitives):
    policy = TanhMultiplicativeGaussian(*random_primitives(), validate_args=True)
    with pytest.raises(ValueError, match="value"):
        policy.log_prob(torch.tensor([0.0, action]))


def test_a_bad_action_is_refused_when_validation_is_on(distribution_class, random_primitives):
    with pytest.raises(ValueError, match="value"):
        distribution_class(*random_primitives(), validate_args=True).log_prob(torch.full((2,), torch.nan))


def test_a_mixture_refuses_an_action_of_another_length_when_validation_is_on(random_primitives):
    with pytest.raises(ValueError, match="event"):
        AdditiveGaussian(*random_primitives(), validate_args=True).log_prob(torch.zeros(1))


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


def test_validation_costs_nothing_when_it_is_off(distribution_class, random_primitives):
    primitives = random_primitives(5)
    checks = {"all", "isfinite", "ge", "gt", "_is_all_true", "_local_scalar_dense", "is_nonzero"}
    with Operations() as off:
        distribution_class(*primitives, validate_args=False)
    with Operations() as on:
        distribution_class(*primitives, validate_args=True)
    assert not checks & off.names
    assert checks & on.names
