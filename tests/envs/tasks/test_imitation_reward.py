import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.kinematics import BodyStates
from torchrl_mcp.envs.tasks.imitation_reward import Term, imitation_rewards, mismatch, squared_angles, squared_distances


def test_the_terms_of_the_reward_are_weighted_exponentials():
    errors = {"pose": torch.tensor([0.0, 0.5]), "com": torch.tensor([0.0, 0.1]), "unused": torch.tensor([9.0, 9.0])}
    rewards = imitation_rewards(errors, {"pose": Term(0.7, 2.0), "com": Term(0.3, 10.0)})
    torch.testing.assert_close(rewards, torch.tensor([[0.7, 0.3], [0.7 * math.exp(-1), 0.3 * math.exp(-1)]]))


@pytest.mark.parametrize("seed", range(5))
def test_the_angle_between_rotations_is_scipys_whatever_their_signs(seed):
    one, other = Rotation.random(4, random_state=seed), Rotation.random(4, random_state=seed + 100)
    expected = (one.inv() * other).magnitude() ** 2
    for sign in (1, -1):
        quaternions = (torch.tensor(one.as_quat()), sign * torch.tensor(other.as_quat()))
        np.testing.assert_allclose(squared_angles(*quaternions), expected, rtol=1e-9)


def test_small_angles_keep_their_gradient():
    turn = torch.tensor(1e-6, dtype=torch.float64, requires_grad=True)
    tilted = torch.stack([(turn / 2).cos(), (turn / 2).sin(), 0 * turn, 0 * turn])
    squared_angles(tilted, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)).backward()
    assert turn.grad.item() == pytest.approx(2e-6, rel=1e-3)


def test_squared_distances_are_over_the_last_dimension():
    assert squared_distances(torch.tensor([[1.0, 2.0], [0.0, 3.0]]), torch.zeros(2)).tolist() == [5.0, 9.0]


def test_moments_differ_by_where_bodies_are_and_soon_will_be():
    still = BodyStates(torch.zeros(3, 2, 3), torch.zeros(3, 2, 4), torch.zeros(3, 2, 3), torch.zeros(3, 2, 3))
    places = torch.tensor([[[0.3, 0.4, 0.0], [0.0, 0.0, 0.0]]]).expand(3, 2, 3)
    velocities = torch.tensor([[[0.0, 0.0, 4.0], [0.0, 0.0, 0.0]]]) * torch.tensor([0.0, 1.0, 2.0]).view(3, 1, 1)
    other = still._replace(positions=places, linear_velocities=velocities)
    torch.testing.assert_close(mismatch(still, other), torch.tensor([0.125, 0.625, 2.125]))
