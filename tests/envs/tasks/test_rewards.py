from functools import partial

import pytest
import torch

from torchrl_mcp.envs import Carry, Dribble
from torchrl_mcp.envs.tasks.rewards import holdout_reward, transport_reward

carry_reward = partial(transport_reward, weights=Carry.weights, proximity_scale=Carry.proximity_scale)
dribble_reward = partial(transport_reward, weights=Dribble.weights, proximity_scale=Dribble.proximity_scale)

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


# A character at the origin walks at 0.5 m/s to an object 2 m ahead, which moves at 0.4 m/s to a target 1 m to its left:
# r_cv = exp(-1.5 (0.5 - 1)^2) = 0.687289, r_bv = exp(-(0.4 - 1)^2) = 0.697676, r_bp = exp(-0.5) = 0.606531, and
# r_cp = exp(-0.25 * 4) = 0.367879 in the carry task, exp(-0.5 * 4) = 0.135335 in the dribble task.
ON_THE_WAY = tuple(torch.tensor(v) for v in ([0.0, 0.0], [0.5, 9.0], [2.0, 0.0], [-9.0, 0.4], [2.0, 1.0]))
PRINTED = {"speed": 1.0, "target_distance_power": 2}


@pytest.mark.parametrize(
    ("reward", "expected"),
    [
        (carry_reward, 0.1 * 0.687289 + 0.2 * 0.367879 + 0.3 * 0.697676 + 0.4 * 0.606531),
        (dribble_reward, 0.1 * 0.687289 + 0.1 * 0.135335 + 0.3 * 0.697676 + 0.5 * 0.606531),
    ],
)
def test_transport_rewards_of_a_hand_computed_step(reward, expected):
    assert reward(*ON_THE_WAY, **PRINTED).item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(("reward", "weight"), [(carry_reward, 0.4), (dribble_reward, 0.5)])
def test_the_power_of_the_distance_to_the_target_is_a_choice(reward, weight):
    *others, target = ON_THE_WAY
    far = (*others, target * torch.tensor([1.0, 3.0]))  # 3 m to the left
    difference = reward(*far, speed=1.0, target_distance_power=1) - reward(*far, **PRINTED)
    assert difference.item() == pytest.approx(weight * (0.223130 - 0.011109), abs=1e-6)  # exp(-1.5) - exp(-4.5)


@pytest.mark.parametrize("reward", [carry_reward, dribble_reward])
def test_nobody_is_punished_for_being_faster_than_asked(reward):
    com, _, position, _, target = ON_THE_WAY
    paces = [torch.tensor([v, 0.0]) for v in (1.0, 4.0)], [torch.tensor([0.0, v]) for v in (1.0, 4.0)]
    asked, faster = (reward(com, v, position, u, target, **PRINTED) for v, u in zip(*paces, strict=True))
    assert asked == faster


@pytest.mark.parametrize(("reward", "expected"), [(carry_reward, 0.732677), (dribble_reward, 0.732677)])
def test_what_lies_at_the_target_beside_the_character_earns_less_than_one(reward, expected):
    # Directions of no length: r_cv = exp(-1.5) = 0.223130, r_bv = exp(-1) = 0.367879, r_cp = r_bp = 1.
    assert reward(*[torch.zeros(2)] * 5, **PRINTED).item() == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("batch", [(), (5,), (2, 5)])
@pytest.mark.parametrize("reward", [carry_reward, dribble_reward])
def test_transport_rewards_treat_every_batch_element_alone(reward, batch):
    step = torch.randn(5, *batch, 2)
    together = reward(*step, **PRINTED)
    alone = torch.stack([reward(*row, **PRINTED) for row in step.reshape(5, -1, 2).unbind(1)])
    assert together.shape == batch
    torch.testing.assert_close(together, alone.view(batch))
