import math

import pytest
import torch

from torchrl_mcp.envs.motions.placement import Placement, placing
from torchrl_mcp.envs.rotations import about_x, about_z, heading, multiply


def placement(turn, x, y):
    return Placement(torch.tensor(turn, dtype=torch.float64), torch.tensor([x, y], dtype=torch.float64))


def test_a_quarter_turn_and_a_shift_do_what_they_say():
    moved = placement(math.pi / 2, 10.0, 20.0).points(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
    torch.testing.assert_close(moved, torch.tensor([8.0, 21.0, 3.0], dtype=torch.float64))


@pytest.mark.parametrize("turn", [0.0, 1e-12, 0.4, -2.5, math.pi])
@pytest.mark.parametrize("times", [0, 1, 2, 7, -1, -3])
def test_a_power_is_the_placement_done_over_and_over(turn, times):
    once, point = placement(turn, 0.3, -0.2), torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    many = once.power(torch.tensor(float(times), dtype=torch.float64))
    start, end = (point, many.points(point)) if times >= 0 else (many.points(point), point)
    for _ in range(abs(times)):
        start = once.points(start)
    torch.testing.assert_close(start, end)


def test_one_after_another_is_one_placement():
    first, second = placement(0.7, 1.0, 2.0), placement(-2.0, 3.0, -1.0)
    point = torch.tensor([[0.5, 0.25, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(second.after(first).points(point), second.points(first.points(point)))


def test_an_inverse_undoes_the_placement():
    there, point = placement(-2.2, 3.0, -1.0), torch.tensor([0.5, 0.25, 1.0], dtype=torch.float64)
    torch.testing.assert_close(there.inverse().points(there.points(point)), point)
    torch.testing.assert_close(there.points(there.inverse().points(point)), point)


def test_placing_carries_position_and_heading_but_not_height_or_tilt():
    tilt = about_x(torch.tensor(0.3, dtype=torch.float64))
    yaws = torch.tensor([3.0, -3.0], dtype=torch.float64)
    start = torch.cat([torch.tensor([1.0, 2.0, 0.9], dtype=torch.float64), multiply(about_z(yaws[0]), tilt)])
    end = torch.cat([torch.tensor([5.0, 1.0, 0.5], dtype=torch.float64), about_z(yaws[1])])
    carried = placing(start, end).qpos(start)
    torch.testing.assert_close(carried[:3], torch.tensor([5.0, 1.0, 0.9], dtype=torch.float64))
    assert float(heading(carried[3:7])) == pytest.approx(-3.0)
    torch.testing.assert_close(carried[3:7].abs(), multiply(about_z(yaws[1]), tilt).abs())
    assert abs(float(placing(start, end).turn)) < math.pi  # the shorter way, across the jump of the angle
