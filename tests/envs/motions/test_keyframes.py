import numpy as np
import pytest
import torch
from scipy.interpolate import BPoly

from torchrl_mcp.envs.motions.keyframes import halting, minimum_jerk, smooth

KEYFRAMES = ((0.1, 0.3), (0.25, -0.2), (0.6, 1.0), (0.85, 0.4))
PHASE = torch.linspace(-1.3, 2.7, 401, dtype=torch.float64)


def test_smooth_keyframes_keep_their_acceleration_across_every_knot_and_from_cycle_to_cycle():
    knots, step = torch.tensor(KEYFRAMES, dtype=torch.float64)[:, 0], 1e-4
    before, after = (
        (smooth(KEYFRAMES, at) - 2 * smooth(KEYFRAMES, at + step) + smooth(KEYFRAMES, at + 2 * step)) / step**2
        for at in (knots - 2 * step, knots)
    )
    torch.testing.assert_close(before, after, atol=0.5, rtol=0)
    assert (before.abs() > 10).all()  # so that half a unit is little
    torch.testing.assert_close(smooth(KEYFRAMES, PHASE + 3), smooth(KEYFRAMES, PHASE))


def test_halting_keyframes_are_quintics_at_rest_at_every_knot():
    knots, values = np.array([*KEYFRAMES, (1.1, 0.3)]).T
    expected = BPoly.from_derivatives(knots, [[value, 0, 0] for value in values], extrapolate="periodic")
    np.testing.assert_allclose(halting(KEYFRAMES, PHASE), expected(PHASE.numpy()), atol=1e-12)


@pytest.mark.parametrize("curve", [smooth, halting])
def test_curves_pass_through_their_keyframes_in_every_cycle(curve):
    knots, values = torch.tensor(KEYFRAMES, dtype=torch.float64).T
    for cycle in (-2, 0, 3):
        torch.testing.assert_close(curve(KEYFRAMES, knots + cycle), values)


def test_equal_keyframes_hold_still_between_them():
    held = halting(((0.0, 0.0), (0.6, 0.0), (0.8, 1.0)), torch.linspace(0, 0.6, 50, dtype=torch.float64))
    assert (held == 0).all()


def test_minimum_jerk_is_held_before_and_after():
    assert minimum_jerk(torch.tensor([-1.0, 0.0, 0.5, 1.0, 2.0])).tolist() == [0.0, 0.0, 0.5, 1.0, 1.0]
