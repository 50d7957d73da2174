import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from refusals import refused
from torch import nn

from torchrl_mcp.modules import RunningNormaliser


@given(
    sizes=st.lists(st.integers(1, 40), min_size=1, max_size=6),
    seed=st.integers(0, 2**31),
    offset=st.floats(-100, 100),
    spread=st.floats(0.01, 100),
)
def test_merged_statistics_are_those_of_all_samples_together(sizes, seed, offset, spread):
    generator = torch.Generator().manual_seed(seed)
    # Later batches wander off: merging has to account for the distance between the means.
    batches = [
        (1 + i) * offset + spread * torch.randn(size, 3, generator=generator, dtype=torch.float64)
        for i, size in enumerate(sizes)
    ]
    normaliser = RunningNormaliser(3).double()
    for batch in batches:
        normaliser.update(batch)
    variance, mean = torch.var_mean(torch.cat(batches), dim=0, correction=0)
    torch.testing.assert_close(normaliser.mean, mean)
    torch.testing.assert_close(normaliser.variance, variance, atol=1e-8, rtol=1e-6)
    assert normaliser.count == sum(sizes)


def test_statistics_stay_true_in_float32_over_many_updates():
    samples = 5.0 + 0.1 * torch.randn(500, 16, 3, generator=torch.Generator().manual_seed(0))
    normaliser = RunningNormaliser(3)
    for batch in samples:
        normaliser.update(batch)
    variance, mean = torch.var_mean(samples.double(), dim=(0, 1), correction=0)
    torch.testing.assert_close(normaliser.mean, mean.float(), rtol=1e-5, atol=0)
    torch.testing.assert_close(normaliser.variance, variance.float(), rtol=1e-3, atol=0)


def test_samples_come_out_standardised():
    samples = torch.randn(4, 250, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([0.1, 1, 50]) + 7
    normaliser = RunningNormaliser(3)
    normaliser.update(samples)
    variance, mean = torch.var_mean(normaliser(samples), dim=(0, 1), correction=0)
    torch.testing.assert_close(mean, torch.zeros(3), atol=1e-4, rtol=0)
    torch.testing.assert_close(variance, torch.ones(3), atol=1e-3, rtol=0)


def test_before_the_first_update_it_only_clips():
    x = torch.tensor([[0.3, -4.0], [12.0, -1e6]])
    torch.testing.assert_close(RunningNormaliser(2, clip=5.0)(x), torch.tensor([[0.3, -4.0], [5.0, -5.0]]))


def test_a_feature_that_never_changes_stays_finite():
    normaliser = RunningNormaliser(1, clip=10.0)
    normaliser.update(torch.full((20, 1), 3.0))
    assert normaliser(torch.tensor([[3.0], [4.0]])).tolist() == [[0.0], [10.0]]


def test_updates_are_in_place():
    normaliser = RunningNormaliser(3)
    storages = {name: buffer.data_ptr() for name, buffer in normaliser.named_buffers()}
    assert set(storages) == {"mean", "variance", "count"}
    normaliser.update(torch.randn(10, 3))
    assert {name: buffer.data_ptr() for name, buffer in normaliser.named_buffers()} == storages


def test_it_has_no_parameters_and_its_statistics_take_no_gradient():
    normaliser = RunningNormaliser(2)
    x = torch.randn(5, 2, requires_grad=True)
    normaliser.update(x)
    assert not list(normaliser.parameters())
    assert not normaliser.mean.requires_grad
    normaliser(x).sum().backward()
    assert x.grad.ne(0).all()


@pytest.mark.parametrize(
    ("name", "value"), [("size", -1), ("clip", 0.0), ("clip", -1.0), ("clip", math.nan), ("epsilon", -1.0)]
)
def test_impossible_arguments_are_refused_by_name(name, value):
    refused(lambda: RunningNormaliser(**{"size": 3, name: value}), name)


@pytest.mark.parametrize("outlier", [1e9, -1e9, float("nan"), float("inf")])
def test_a_sample_out_of_all_bounds_leaves_the_statistics_alone_and_is_told(outlier):
    torch.manual_seed(0)
    x = torch.randn(100, 3)
    expected, normaliser = RunningNormaliser(3), RunningNormaliser(3)
    expected.update(x)
    spoilt = torch.cat([x, x[:1]])
    spoilt[-1, 1] = outlier
    with pytest.warns(UserWarning, match=r"1 of 101 .*\[1\]"):
        normaliser.update(spoilt)
    for name, buffer in normaliser.named_buffers():
        assert torch.equal(buffer, getattr(expected, name)), name
    with pytest.warns(UserWarning, match="1 of 1 "):
        normaliser.update(spoilt[-1:])
    assert normaliser.count == 100


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float64])
def test_statistics_have_the_precision_of_the_buffers_whatever_the_samples_have(dtype):
    x = (5 + torch.randn(1000, 2, generator=torch.Generator().manual_seed(0))).to(dtype)
    normaliser = RunningNormaliser(2)
    normaliser.update(x)
    variance, mean = torch.var_mean(x.double(), dim=0, correction=0)
    torch.testing.assert_close((normaliser.mean, normaliser.variance), (mean.float(), variance.float()))


def test_inputs_in_float64_are_normalised_for_networks_in_float32():
    x = 5 + torch.randn(100, 2, generator=torch.Generator().manual_seed(0))
    normaliser = RunningNormaliser(2)
    normaliser.update(x)
    assert nn.Linear(2, 1)(normaliser(x.double())).dtype == torch.float32
    assert torch.equal(normaliser(x.double()), normaliser(x))
    assert normaliser.double()(x.double()).dtype == torch.float64


@pytest.mark.parametrize("width", [1, 5])
def test_another_number_of_features_is_refused_instead_of_broadcast(width):
    normaliser = RunningNormaliser(4)
    for use in (normaliser, normaliser.update):
        refused(lambda use=use: use(torch.ones(2, width)), f"(2, {width})", "4")
    assert not normaliser.mean.any()
