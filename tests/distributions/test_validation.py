"""Bad shapes are always refused, bad values where validation is on, and checks cost nothing where it is off."""

import math

import numpy as np
import pytest
import torch
from refusals import refused
from torch.distributions import Distribution
from torch.utils._python_dispatch import TorchDispatchMode

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian, TanhMultiplicativeGaussian


@pytest.fixture(params=[MultiplicativeGaussian, AdditiveGaussian, TanhMultiplicativeGaussian])
def distribution_class(request):
    return request.param


GOOD = {"loc": torch.zeros(3, 2), "scale": torch.ones(3, 2), "gates": torch.ones(3)}
BAD_SHAPES = [
    ({"scale": torch.ones(3, 5)}, ("scale (3, 5)",)),
    ({"gates": torch.ones(4)}, ("gates (4,)",)),
    ({"gates": None}, ("gates", "None")),  # a key that TorchRL did not find
    ({"loc": torch.zeros(2)}, ("loc (2,)",)),
    ({"gates": torch.tensor(1.0)}, ("gates ()",)),
    ({"gates": torch.ones(1)}, ("gates (1,)",)),
    ({"loc": torch.zeros(5, 3, 2), "gates": torch.ones(5, 1, 3)}, ("gates (5, 1, 3)",)),
]

BAD_VALUES = [
    ({"gates": torch.tensor([1.0, -0.5, 1.0])}, ("gates", "(3,)", "-0.5")),
    ({"gates": torch.tensor([1.0, torch.nan, 1.0])}, ("gates", "(3,)", "nan")),
    ({"gates": torch.tensor([1.0, torch.inf, 1.0])}, ("gates", "(3,)", "inf")),
    ({"scale": torch.zeros(3, 2)}, ("scale", "(3, 2)", "0.0")),
    ({"scale": -torch.ones(3, 2)}, ("scale", "(3, 2)", "-1.0")),
    ({"scale": torch.full((3, 2), torch.nan)}, ("scale", "(3, 2)", "nan")),
    ({"loc": torch.full((3, 2), torch.nan)}, ("loc", "(3, 2)", "nan")),
]


@pytest.mark.parametrize(
    ("bad", "names", "validate_args"),
    [(*row, validate) for row in BAD_SHAPES for validate in (True, False)] + [(*row, True) for row in BAD_VALUES],
)
def test_bad_shapes_are_always_refused_and_bad_values_with_validation(distribution_class, bad, names, validate_args):
    refused(lambda: distribution_class(**GOOD | bad, validate_args=validate_args), *names)


def test_a_mixture_refuses_gates_that_are_all_zero_and_a_product_does_not():
    arguments = torch.zeros(2, 2, 3), torch.ones(2, 2, 3), torch.tensor([[1.0, 0.0], [0.0, 0.0]])
    refused(lambda: AdditiveGaussian(*arguments, validate_args=True), "gates of shape (2, 2)")
    MultiplicativeGaussian(*arguments, validate_args=True)


@pytest.mark.parametrize(
    ("low", "high", "name", "always"),
    [
        (1.0, -1.0, "low=1.0", True),
        (0.0, 0.0, "low=0.0", True),
        (-math.inf, math.inf, "low=-inf", True),
        (0.0, math.inf, "high=inf", True),
        (np.float32(1), np.float32(-1), "high=-1.0", True),
        (torch.zeros(5, 2), torch.ones(5, 2), "(5, 2)", True),
        (torch.zeros(3), 1.0, "(3,)", True),
        (torch.tensor([-1.0, 2.0]), torch.ones(2), "low=tensor", False),
    ],
)
def test_bad_bounds_are_refused(low, high, name, always, random_primitives):
    for validate_args in (True, False) if always else (True,):
        refused(lambda: TanhMultiplicativeGaussian(*random_primitives(), low, high, validate_args=validate_args), name)  # noqa: B023


@pytest.mark.parametrize(
    ("policy", "action"),
    [
        (TanhMultiplicativeGaussian, [0.0, -1.5]),
        (TanhMultiplicativeGaussian, [0.0, 1.5]),
        (TanhMultiplicativeGaussian, [torch.nan] * 2),
        (MultiplicativeGaussian, [torch.nan] * 2),
        (AdditiveGaussian, [torch.nan] * 2),
        (AdditiveGaussian, [0.0]),
    ],
)
def test_an_impossible_action_is_refused_when_validation_is_on(policy, action, random_primitives):
    with pytest.raises(ValueError, match=r"value|event"):
        policy(*random_primitives(), validate_args=True).log_prob(torch.tensor(action))


@pytest.mark.parametrize("default", [True, False])
def test_validation_follows_torch_s_default_unless_told(distribution_class, default, monkeypatch):
    monkeypatch.setattr(Distribution, "_validate_args", default)
    bad = GOOD | {"gates": -torch.ones(3)}
    distribution_class(**bad, validate_args=False)
    refused(lambda: distribution_class(**bad, validate_args=True), "gates")
    if default:
        refused(lambda: distribution_class(**bad), "gates")
    else:
        distribution_class(**GOOD | {"loc": torch.full((3, 2), torch.nan)})


def test_raw_outputs_are_refused_with_the_remedy_where_validation_is_off_by_default(distribution_class, monkeypatch):
    monkeypatch.setattr(Distribution, "_validate_args", False)
    logits = torch.tensor([[0.3, -0.7, 1.0], [0.2, 0.1, 0.5]])
    refused(lambda: distribution_class(**GOOD | {"gates": logits}), "gates of shape (2, 3)", "sigmoid")
    scale = torch.tensor([[0.3, 0.2], [0.1, -0.5], [0.5, 0.6]])
    refused(lambda: distribution_class(**GOOD | {"scale": scale}), "scale of shape (3, 2) contains -0.5", "softplus")


def test_a_product_of_negative_precision_is_nan_where_signs_are_not_checked():
    loc, scale = torch.tensor([[0.0], [3.0]]), torch.ones(2, 1)
    composite = MultiplicativeGaussian(loc, scale, torch.tensor([-2.0, 1.0]), validate_args=False)
    assert composite.mean.isnan().all()
    assert composite.log_prob(torch.zeros(1)).isnan().all()


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
