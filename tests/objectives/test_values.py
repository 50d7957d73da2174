import pytest
import torch
from refusals import refused
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import nn
from torchrl.modules import IndependentNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss

from torchrl_mcp.objectives import OptionValueLoss, ValueLoss


class Policy(nn.Linear):
    """Any policy: its terms are not looked at."""

    def forward(self, observation):
        loc = super().forward(observation)
        return loc, torch.ones_like(loc)


def samples(**more):
    torch.manual_seed(0)
    data = {"observation": torch.randn(64, 3), "value_target": torch.randn(64, 1), **more}
    return TensorDict(data, batch_size=64)


def test_it_is_the_critic_s_term_of_torchrl_s_loss_to_value_and_gradient():
    data = samples(action=torch.randn(64, 2), action_log_prob=torch.randn(64), advantage=torch.randn(64, 1))
    head = ProbabilisticTensorDictModule(["loc", "scale"], ["action"], distribution_class=IndependentNormal)
    actor = ProbabilisticTensorDictSequential(TensorDictModule(Policy(3, 2), ["observation"], ["loc", "scale"]), head)
    critic = ValueOperator(nn.Linear(3, 1))
    theirs = ClipPPOLoss(actor, critic, critic_coeff=0.3, loss_critic_type="l2", functional=False)(data.clone())
    ours = ValueLoss(critic, coeff=0.3)(data)
    torch.testing.assert_close(ours["loss_critic"], theirs["loss_critic"])
    torch.testing.assert_close(ours["explained_variance"], theirs["explained_variance"].squeeze())
    expected, actual = (
        torch.autograd.grad(report["loss_critic"], list(critic.parameters())) for report in (theirs, ours)
    )
    torch.testing.assert_close(actual, expected)


def test_of_options_only_the_value_of_the_one_that_acted_is_judged():
    values = nn.Embedding(2, 3, _weight=torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
    critic = TensorDictSequential(TensorDictModule(values, ["observation"], ["option_values"]))
    data = TensorDict(
        observation=torch.tensor([0, 1]),
        option=torch.tensor([2, 0]),
        value_target=torch.tensor([[2.0], [7.0]]),
        batch_size=2,
    )
    loss = OptionValueLoss(critic, coeff=0.5)(data)["loss_critic"]
    assert loss.item() == pytest.approx((1 + 9) / 2 / 2)
    loss.backward()
    # The errors 3 - 2 and 4 - 7, halved by the mean, where the options acted.
    torch.testing.assert_close(values.weight.grad, torch.tensor([[0.0, 0.0, 0.5], [-1.5, 0.0, 0.0]]))


@pytest.mark.parametrize("loss", [ValueLoss, OptionValueLoss])
def test_targets_of_another_shape_than_values_are_refused_instead_of_broadcast(loss):
    keys = (["observation"], ["state_value" if loss is ValueLoss else "option_values"])
    critic = TensorDictSequential(TensorDictModule(nn.Linear(3, 1), *keys))
    data = samples(option=torch.zeros(64, dtype=torch.int64))
    loss(critic, coeff=1.0)(data)
    data["value_target"] = data["value_target"].squeeze(-1)
    refused(lambda: loss(critic, coeff=1.0)(data), "value_target", "(64,)")
