import pytest
import torch

from torchrl_mcp.envs.motions.gait.course import between_frames
from torchrl_mcp.envs.motions.gait.curves import ADVANCE, ASIDE, CLEARANCE, FOOT_PITCH, ROUNDING, spline


@pytest.mark.parametrize("keys", [FOOT_PITCH, ADVANCE, CLEARANCE, ASIDE, ROUNDING, ((0.0, 1.0), (2.0, -1.0))])
def test_a_spline_meets_its_keys_bends_without_a_jump_and_is_level_at_its_ends_and_held_beyond(keys):
    places, values = torch.tensor(keys, dtype=torch.float64).T
    torch.testing.assert_close(spline(keys, places), values)
    torch.testing.assert_close(spline(keys, places[[0, -1]] + torch.tensor([-0.3, 0.3])), values[[0, -1]])
    step, curvature = 1e-4, float(values.diff().abs().max() / places.diff().min() ** 2)  # of that order
    ends = places[[0, -1]] + torch.tensor([step, -step])
    torch.testing.assert_close(spline(keys, ends), values[[0, -1]], rtol=0, atol=10 * curvature * step**2)
    before, after = (
        (spline(keys, at) - 2 * spline(keys, at + step) + spline(keys, at + 2 * step)) / step**2
        for at in (places[1:-1] - 2 * step, places[1:-1])
    )
    torch.testing.assert_close(before, after, rtol=0, atol=0.05 * curvature)


def test_feet_go_forward_all_the_way_and_never_below_the_ground():
    phase = torch.linspace(0.25, 1.25, 2001, dtype=torch.float64)
    assert (spline(ADVANCE, phase).diff() > -1e-12).all()
    assert (spline(CLEARANCE, phase) > -1e-4).all()
    assert (spline(ROUNDING, phase) >= 0).all()


def test_between_frames_quadratic_motions_are_exact():
    time = torch.arange(20, dtype=torch.float64)
    values = torch.stack([3 - 2 * time + 0.5 * time**2, time], dim=-1)
    at = torch.tensor([[1.0, 4.3], [7.75, 17.5]], dtype=torch.float64)
    expected = torch.stack([3 - 2 * at + 0.5 * at**2, at], dim=-1)
    torch.testing.assert_close(between_frames(values, at), expected)
