import math

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchrl_mcp.envs.rotations import (
    about_x,
    about_y,
    about_z,
    continuous,
    from_rotation_vector,
    heading,
    inverse,
    multiply,
    rotate,
    shortest,
    slerp,
    to_rotation_vector,
)


def random_quaternions(*shape, seed=0):
    q = torch.randn(*shape, 4, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return q / q.norm(dim=-1, keepdim=True)


def test_products_and_rotated_vectors_are_those_of_mujoco():
    a, b = random_quaternions(20), random_quaternions(20, seed=1)
    v = torch.randn(20, 3, dtype=torch.float64)
    products, rotated = multiply(a, b), rotate(a, v)
    for i in range(20):
        expected, moved = np.empty(4), np.empty(3)
        mujoco.mju_mulQuat(expected, a[i].numpy(), b[i].numpy())
        mujoco.mju_rotVecQuat(moved, v[i].numpy(), a[i].numpy())
        np.testing.assert_allclose(products[i], expected, atol=1e-14)
        np.testing.assert_allclose(rotated[i], moved, atol=1e-14)


def test_a_rotation_and_its_inverse_cancel():
    q = random_quaternions(2, 5)
    identity = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).expand(2, 5, 4)
    torch.testing.assert_close(multiply(q, inverse(q)), identity)


def test_arguments_are_broadcast_against_each_other():
    q, v = random_quaternions(3, 1), torch.eye(3, dtype=torch.float64)
    assert rotate(q, v).shape == (3, 3, 3)
    torch.testing.assert_close(rotate(q, v)[2, 1], rotate(q[2, 0], v[1]))
    torch.testing.assert_close(multiply(q, random_quaternions(4))[1, 3], multiply(q[1, 0], random_quaternions(4)[3]))


def test_the_exponential_map_is_that_of_mujoco():
    axis = torch.tensor([1.0, 2.0, -2.0], dtype=torch.float64) / 3
    expected = np.empty(4)
    mujoco.mju_axisAngle2Quat(expected, axis.numpy(), 1.2)
    np.testing.assert_allclose(from_rotation_vector(1.2 * axis), expected, atol=1e-15)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-4, 1.0, 3.0, math.pi - 1e-5])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_logarithm_and_exponential_map_are_inverse(angle, dtype):
    v = angle * torch.tensor([0.6, 0.0, -0.8], dtype=dtype)
    torch.testing.assert_close(to_rotation_vector(from_rotation_vector(v)), v, atol=2e-6, rtol=1e-6)


def test_opposite_quaternions_have_the_same_logarithm_of_at_most_half_a_turn():
    q = random_quaternions(100)
    vectors = to_rotation_vector(q)
    torch.testing.assert_close(to_rotation_vector(-q), vectors)
    assert vectors.norm(dim=-1).max() <= math.pi


@pytest.mark.parametrize(("about", "axis"), [(about_x, 0), (about_y, 1), (about_z, 2)])
def test_a_rotation_about_an_axis_keeps_it_and_turns_the_next_into_the_one_after(about, axis):
    quarter = about(torch.tensor(math.pi / 2, dtype=torch.float64))
    basis = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(rotate(quarter, basis[axis]), basis[axis])
    torch.testing.assert_close(rotate(quarter, basis[axis - 2]), basis[axis - 1])


@given(yaw=st.floats(-3.1, 3.1), pitch=st.floats(-1.4, 1.4), roll=st.floats(-3.1, 3.1))
def test_heading_is_the_yaw_whatever_pitch_and_roll(yaw, pitch, roll):
    angles = torch.tensor([yaw, pitch, roll], dtype=torch.float64)
    q = multiply(about_z(angles[0]), multiply(about_y(angles[1]), about_x(angles[2])))
    assert float(heading(q)) == pytest.approx(yaw, abs=1e-9)


@pytest.mark.parametrize("total", [1e-9, 0.3, 3.0])
def test_slerp_turns_about_one_axis_at_constant_speed(total):
    a, axis = random_quaternions(1)[0], torch.tensor([0.0, 0.6, 0.8], dtype=torch.float64)
    fraction = torch.linspace(0, 1, 7, dtype=torch.float64)
    b = multiply(a, from_rotation_vector(total * axis))
    between = slerp(a.expand(7, 4), b.expand(7, 4), fraction)
    expected = multiply(a.expand(7, 4), from_rotation_vector(total * fraction.unsqueeze(-1) * axis))
    torch.testing.assert_close(between, expected)


@pytest.mark.parametrize("b", [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, 0.6, -0.8), (-0.96, 0, 0.28)])
def test_the_shortest_rotation_from_one_direction_to_another_turns_by_the_angle_between_them(b):
    a, b = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64), torch.tensor(b, dtype=torch.float64)
    turn = shortest(a, b)
    torch.testing.assert_close(rotate(turn, a), b)
    assert float(to_rotation_vector(turn).norm()) == pytest.approx(math.acos(float(a @ b)))


def test_slerp_takes_the_shorter_way():
    a, b = random_quaternions(50), random_quaternions(50, seed=1)
    half = torch.full((50,), 0.5, dtype=torch.float64)
    there = to_rotation_vector(multiply(inverse(a), slerp(a, b, half))).norm(dim=-1)
    assert (there <= math.pi / 2 + 1e-12).all()
    torch.testing.assert_close(slerp(a, b, half), slerp(a, -b, half))


def test_continuous_signs_begin_positive_and_never_flip():
    turning = from_rotation_vector(torch.linspace(1, 9, 40, dtype=torch.float64).unsqueeze(-1) * torch.eye(3)[1])
    flipped = turning * torch.where(torch.arange(40) % 3 == 0, -1.0, 1.0).unsqueeze(-1)
    torch.testing.assert_close(continuous(torch.stack([flipped, -flipped])), torch.stack([turning, turning]))
