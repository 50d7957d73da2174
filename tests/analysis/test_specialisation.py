import numpy as np
import pytest

from torchrl_mcp.analysis.specialisation import (
    between_primitives,
    bin_means,
    circular_correlation,
    explained_by_phase,
    principal_components,
    silhouettes,
    stance_correlation,
)

RANDOM = np.random.default_rng(0)
PHASES = RANDOM.random(20_000)


def columns(*values):
    return np.stack(values, -1)


def test_means_are_taken_over_equal_bins_of_the_cycle():
    values = columns([1.0, 3.0, 5.0], [0.0, 4.0, 8.0])
    means = bin_means(values, np.array([0.0, 0.24, 0.75]), num_bins=4)
    np.testing.assert_allclose(means, [[2.0, 2.0], [np.nan, np.nan], [np.nan, np.nan], [5.0, 8.0]])


def test_phase_explains_all_of_a_function_of_it_and_nothing_of_what_ignores_it():
    steps, wave, noise = np.floor(4 * PHASES), np.sin(6 * np.pi * PHASES), RANDOM.normal(size=len(PHASES))
    each, _ = explained_by_phase(columns(steps, wave, noise, wave + np.sqrt(0.5) * noise), PHASES)
    # A wave of variance 1/2 has another half from noise; three periods in 20 bins are not quite constant within them.
    np.testing.assert_allclose(each, [1.0, 0.93, 0.0, 0.465], atol=0.01)


def test_all_weights_together_count_by_their_variance():
    wave, noise = np.floor(2 * PHASES), RANDOM.normal(size=len(PHASES))  # variances 1/4 and 1
    assert explained_by_phase(columns(wave, noise), PHASES)[1] == pytest.approx(0.2, abs=0.01)
    assert explained_by_phase(columns(wave, 0.001 * noise), PHASES)[1] == pytest.approx(1.0, abs=0.01)


def test_circular_correlation_hears_one_wave_per_stride_whatever_its_phase_and_no_other():
    angle, noise = 2 * np.pi * PHASES, RANDOM.normal(size=len(PHASES))
    values = columns(3 + np.cos(angle + 1.0), np.cos(2 * angle), noise, np.cos(angle) + np.sqrt(0.5) * noise)
    np.testing.assert_allclose(circular_correlation(values, PHASES), [1.0, 0.0, 0.0, 0.5], atol=0.015)


def test_circular_correlation_is_that_of_mardia():
    phases, values = RANDOM.random(50), RANDOM.normal(size=50)
    cosine, sine = np.cos(2 * np.pi * phases), np.sin(2 * np.pi * phases)
    xc, xs, cs = (np.corrcoef(*pair)[0, 1] for pair in ((values, cosine), (values, sine), (cosine, sine)))
    expected = (xc**2 + xs**2 - 2 * xc * xs * cs) / (1 - cs**2)
    np.testing.assert_allclose(circular_correlation(columns(values), phases), [expected])


def test_stance_correlation_has_the_sign_of_the_foot():
    right, left = PHASES < 0.6, (PHASES + 0.5) % 1 < 0.6
    both = RANDOM.normal(size=len(PHASES))
    values = columns(left.astype(float) - right, 0.2 * right - 0.2 * left + 0.5, both, np.full(len(PHASES), 0.7))
    expected = [1.0, -1.0, np.corrcoef(both, left.astype(float) - right)[0, 1], 0.0]
    np.testing.assert_allclose(stance_correlation(values, columns(right, left)), expected, atol=1e-12)


def test_principal_components_are_the_axes_of_a_gaussian():
    variances, turn = np.array([9.0, 4.0, 1.0]), np.linalg.qr(RANDOM.normal(size=(3, 3)))[0]
    along = RANDOM.normal(size=(40_000, 3)) * np.sqrt(variances)
    scores, shares = principal_components(along @ turn.T + [5.0, -2.0, 1.0])
    np.testing.assert_allclose(shares, variances[:2] / 14, atol=0.01)
    np.testing.assert_allclose(np.cov(scores.T), np.diag(variances[:2]), atol=0.15)
    for component in range(2):
        assert abs(np.corrcoef(scores[:, component], along[:, component])[0, 1]) > 0.999


def test_variance_between_primitives_is_that_of_their_means():
    noise = RANDOM.normal(size=(5000, 4, 3))
    apart = np.array([-3.0, -1.0, 1.0, 3.0])[:, None] * np.array([1.0, 0.0, 0.0])  # variance 5, beside 3 of the noise
    assert between_primitives(np.broadcast_to(apart, (10, 4, 3))) == pytest.approx(1.0)
    assert between_primitives(noise) == pytest.approx(0.0, abs=0.002)
    assert between_primitives(noise + apart) == pytest.approx(5 / 8, abs=0.01)


def test_silhouettes_are_those_of_points_on_a_line():
    actions = np.array([[[0.0], [10.0], [20.0]], [[1.0], [12.0], [24.0]]])
    # Of 0: 1 from its own, 11 from the second; of 1: 1 and 10. Of 10: 2 and 9.5; of 12: 2 and 11, or 10 from the third.
    # Of 20: 4 and 9; of 24: 4 and 13.
    expected = [(10 / 11 + 9 / 10) / 2, (7.5 / 9.5 + 8 / 10) / 2, (5 / 9 + 9 / 13) / 2]
    np.testing.assert_allclose(silhouettes(actions), expected)


def test_silhouettes_of_primitives_that_act_alike_are_about_zero():
    assert np.abs(silhouettes(RANDOM.normal(size=(200, 4, 2)))).max() < 0.1


def test_what_has_no_spread_has_numbers():
    assert silhouettes(np.random.default_rng(0).normal(size=(10, 1, 3))).tolist() == [0.0]
    assert between_primitives(np.ones((5, 3, 2))) == 0.0
    scores, shares = principal_components(np.arange(4.0)[:, None])
    assert np.abs(scores[:, 0]).tolist() == [1.5, 0.5, 0.5, 1.5]
    assert not scores[:, 1].any()
    assert shares.tolist() == [1.0, 0.0]
