import math
import tracemalloc

import numpy as np
import pytest
from refusals import refused
from scipy.stats import mannwhitneyu

from torchrl_mcp.evaluation import statistics
from torchrl_mcp.evaluation.statistics import (
    Estimate,
    deviation,
    difference,
    interquartile_mean,
    mean,
    probability_of_improvement,
)


def test_the_mean_is_the_mean_and_the_deviation_that_of_a_sample():
    assert mean([0.1, 0.2, 0.6]).value == pytest.approx(0.3)
    assert deviation([0.1, 0.2, 0.6]) == pytest.approx(math.sqrt((0.04 + 0.01 + 0.09) / 2))


def test_the_interval_of_three_values_is_their_range():
    estimate = mean([0.4, 0.1, 0.2])
    assert (estimate.low, estimate.high) == pytest.approx((0.1, 0.4))


def test_the_interval_of_many_values_is_that_of_the_normal_distribution():
    values = np.random.default_rng(1).normal(size=400)
    half_width = 1.96 * values.std() / math.sqrt(400)
    estimate = mean(list(values))
    assert estimate.low == pytest.approx(values.mean() - half_width, abs=0.005)
    assert estimate.high == pytest.approx(values.mean() + half_width, abs=0.005)


def test_the_interval_of_a_difference_adds_the_variances_of_both_samples():
    generator = np.random.default_rng(1)
    first, second = generator.normal(2.0, 1.0, size=400), generator.normal(size=100)
    estimate = difference(list(first), list(second))
    assert estimate.value == pytest.approx(first.mean() - second.mean())
    half_width = 1.96 * math.sqrt(first.var() / 400 + second.var() / 100)
    assert estimate.high - estimate.value == pytest.approx(half_width, rel=0.05)
    assert estimate.value - estimate.low == pytest.approx(half_width, rel=0.05)


def test_a_single_value_has_neither_deviation_nor_interval():
    estimate = mean([0.5])
    assert estimate.value == 0.5
    assert all(map(math.isnan, (estimate.low, estimate.high, deviation([0.5]))))


@pytest.mark.filterwarnings("error")
def test_equal_values_have_an_interval_of_no_width():
    assert mean([0.5, 0.5, 0.5]) == Estimate(0.5, 0.5, 0.5)


def test_estimates_are_the_same_again():
    values = list(np.linspace(0, 1, 7) ** 2)
    assert mean(values) == mean(values)


def test_tasks_with_more_seeds_weigh_no_more_in_the_interquartile_mean():
    assert interquartile_mean([[1, 1, 1, 1], [3]]).value == pytest.approx(2)


def test_the_interquartile_mean_leaves_out_the_outer_quarters_of_all_tasks_together():
    assert interquartile_mean([[0, 7, 2, 5], [1, 6, 3, 400]]).value == pytest.approx((2 + 3 + 5 + 6) / 4)


def test_tasks_that_differ_widen_no_interval_because_seeds_are_resampled_within_them():
    estimate = interquartile_mean([[0.1, 0.1], [0.9, 0.9], [0.2, 0.2], [0.6, 0.6]])
    assert (estimate.low, estimate.high) == (estimate.value, estimate.value) == pytest.approx((0.4, 0.4))


def test_differing_numbers_of_seeds_take_little_memory(monkeypatch):
    monkeypatch.setattr(statistics, "BATCH", 100_000)
    strata = [np.random.default_rng(size).normal(size=size) for size in (4, 5, 7, 9)]
    tracemalloc.start()
    interquartile_mean(strata)  # each value of a resample stands for up to 315 equal ones
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10 * 8 * statistics.BATCH


def test_a_task_of_a_single_seed_leaves_nothing_to_resample():
    assert math.isnan(interquartile_mean([[0.1, 0.2], [0.5]]).low)


@pytest.mark.parametrize("strata", [[], [[]], [[0.1], []]], ids=str)
def test_missing_values_are_an_error(strata):
    refused(lambda: interquartile_mean(strata), f"values={strata}")


def test_the_probability_of_improvement_is_the_mean_over_tasks_of_mann_whitney_s():
    draw = np.random.default_rng(0).normal
    pairs = [(draw(0.3, size=4), draw(size=6)), (draw(size=3), draw(1.0, size=3)), ([1.0, 2.0], [1.0, 3.0])]
    expected = [mannwhitneyu(x, y).statistic / (len(x) * len(y)) for x, y in pairs]
    assert probability_of_improvement(pairs).value == pytest.approx(np.mean(expected))


def test_the_probability_of_improvement_has_an_interval_within_each_task():
    sure = probability_of_improvement([([0.9, 0.8, 0.7], [0.1, 0.2, 0.3]), ([5.0, 6.0], [-1.0, 1.0])])
    assert (sure.low, sure.value, sure.high) == (1.0, 1.0, 1.0)
    open_ = probability_of_improvement([([0.1, 0.5, 0.9], [0.2, 0.4, 0.8])])
    assert open_.value == pytest.approx(5 / 9)
    assert 0 <= open_.low < 5 / 9 < open_.high <= 1
    assert math.isnan(probability_of_improvement([([0.1], [0.2, 0.3])]).low)
