import numpy as np
import pytest
import torch
from scipy.interpolate import CubicSpline

from torchrl_mcp.envs.motions.gait.course import between_frames
from torchrl_mcp.envs.motions.gait.curves import ADVANCE, CLEARANCE, FOOT_PITCH, ROUNDING, Spline


@pytest.mark.parametrize("keys", [FOOT_PITCH, ADVANCE, CLEARANCE, ROUNDING, ((0.0, 1.0), (2.0, -1.0))])
def test_the_spline_is_that_of_scipy_with_level_ends_and_held_beyond(keys):
    places, values = np.array(keys).T
    at = torch.linspace(places[0] - 0.2, places[-1] + 0.2, 101, dtype=torch.float64)
    expected = CubicSpline(places, values, bc_type="clamped")(at.clamp(places[0], places[-1]).numpy())
    torch.testing.assert_close(Spline(keys)(at), torch.from_numpy(expected))


def test_feet_go_forward_all_the_way_and_never_below_the_ground():
    phase = torch.linspace(0.25, 1.25, 2001, dtype=torch.float64)
    assert (Spline(ADVANCE)(phase).diff() > -1e-12).all()
    assert (Spline(CLEARANCE)(phase) > -1e-4).all()
    assert (Spline(ROUNDING)(phase) >= 0).all()


def test_between_frames_quadratic_motions_are_exact():
    time = torch.arange(20, dtype=torch.float64)
    values = torch.stack([3 - 2 * time + 0.5 * time**2, time], dim=-1)
    at = torch.tensor([[1.0, 4.3], [7.75, 17.5]], dtype=torch.float64)
    expected = torch.stack([3 - 2 * at + 0.5 * at**2, at], dim=-1)
    torch.testing.assert_close(between_frames(values, at), expected)
