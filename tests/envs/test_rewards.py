import pytest
import torch

from torchrl_mcp.envs.rewards import holdout_reward

PAPER = {"forward_weight": 1.0, "healthy_weight": 1.0, "control_weight": 0.5, "contact_weight": 0.0005}


def test_holdout_reward_of_a_hand_computed_step():
    reward = holdout_reward(
        velocity=torch.tensor([3.0, 4.0]),
        direction=torch.tensor([0.6, 0.8]),
        action=torch.tensor([0.5, -0.5]),
        healthy=torch.tensor(True),
        contact_forces=torch.tensor([1.0, -1.0, 0.0]),
        **PAPER,
    )
    torch.testing.assert_close(reward, torch.tensor(5.0 + 1.0 - 0.25 - 0.001))


def test_an_unhealthy_character_loses_exactly_the_healthy_reward():
    step = {"velocity": torch.ones(2, 2), "direction": torch.tensor([0.0, 1.0]), "action": torch.zeros(2, 8)}
    healthy, unhealthy = holdout_reward(healthy=torch.tensor([True, False]), **step, **PAPER | {"healthy_weight": 3.0})
    assert healthy - unhealthy == 3.0


def test_walking_across_the_direction_earns_no_forward_reward():
    reward = holdout_reward(
        torch.tensor([0.0, 7.0]), torch.tensor([1.0, 0.0]), torch.zeros(8), torch.tensor(False), **PAPER
    )
    assert reward == 0.0


@pytest.mark.parametrize("batch", [(), (5,), (2, 5)])
def test_holdout_reward_treats_every_batch_element_alone(batch):
    velocity, direction, forces = torch.randn(*batch, 2), torch.randn(*batch, 2), torch.randn(*batch, 84)
    action, healthy = torch.randn(*batch, 8), torch.rand(batch) < 0.5
    together = holdout_reward(velocity, direction, action, healthy, forces, **PAPER)
    rows = [x.reshape(-1, *x.shape[len(batch) :]) for x in (velocity, direction, action, healthy, forces)]
    alone = torch.stack([holdout_reward(*row, **PAPER) for row in zip(*rows, strict=True)])
    torch.testing.assert_close(together, alone.view(batch))
