import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss, SoftUpdate

from torchrl_mcp.objectives import BoundedClipPPOLoss


class Table(nn.Module):
    """Means that are parameters, one row per sample."""

    def __init__(self, loc):
        super().__init__()
        self.loc = nn.Parameter(torch.tensor(loc))

    def forward(self, observation):
        return self.loc, torch.full_like(self.loc, 0.5)


def policy(network):
    head = ProbabilisticTensorDictModule(
        in_keys=["loc", "scale"], out_keys=["action"], distribution_class=IndependentNormal, return_log_prob=True
    )
    return ProbabilisticTensorDictSequential(TensorDictModule(network, ["observation"], ["loc", "scale"]), head)


def make(loss_class, loc, *, functional, **kwargs):
    torch.manual_seed(0)
    actor, critic = policy(Table(loc)), ValueOperator(nn.Linear(3, 1))
    loss = loss_class(actor, critic, clip_epsilon=0.2, loss_critic_type="l2", functional=functional, **kwargs)
    return loss, actor[0].module.loc


def samples(loc):
    shape = (len(loc), len(loc[0]))
    return TensorDict(
        observation=torch.randn(shape[0], 3),
        action=torch.tensor(loc) + 0.5 * torch.randn(shape),
        action_log_prob=-2 + torch.randn(shape[0]),
        advantage=torch.randn(shape[0], 1),
        value_target=torch.randn(shape[0], 1),
        batch_size=shape[0],
    )


INSIDE = [[0.9, -1.0, 0.3], [0.0, 0.0, -0.5]]
OUTSIDE = [[1.5, -2.0, 0.3], [0.0, 0.0, -1.1]]


@pytest.mark.parametrize("functional", [True, False])
@pytest.mark.parametrize("entropy_bonus", [True, False])
@pytest.mark.parametrize("loc", [INSIDE, OUTSIDE])
def test_every_term_but_the_penalty_is_torchrl_s(loc, entropy_bonus, functional):
    kwargs = {"functional": functional, "entropy_bonus": entropy_bonus}
    data = samples(loc)
    theirs, _ = make(ClipPPOLoss, loc, **kwargs)
    ours, _ = make(BoundedClipPPOLoss, loc, bound_coeff=10.0, **kwargs)
    expected, report = theirs(data.clone()), ours(data.clone())
    assert set(report.keys()) == {*expected.keys(), "loss_bound"}
    for key, value in expected.items():
        assert torch.equal(report[key], value), key


def test_an_entropy_of_weight_0_is_not_computed():
    loss, _ = make(BoundedClipPPOLoss, INSIDE, functional=False, bound_coeff=10.0, entropy_coeff=0.0)
    assert set(loss(samples(INSIDE)).keys()).isdisjoint({"entropy", "loss_entropy"})


@pytest.mark.parametrize(
    ("loc", "bound", "expected"),
    [
        # Row 1: (1.5-1)^2 + (2-1)^2 = 1.25; row 2: (1.1-1)^2 = 0.01; their mean 0.63 times 10
        (OUTSIDE, 1.0, 6.3),
        # Only (2-1.5)^2 = 0.25 is left; the mean 0.125 times 10
        (OUTSIDE, 1.5, 1.25),
        (INSIDE, 1.0, 0.0),
    ],
)
def test_the_penalty_is_the_squared_excess_of_the_mean(loc, bound, expected):
    loss, _ = make(BoundedClipPPOLoss, loc, functional=False, bound_coeff=10.0, bound=bound)
    assert loss(samples(loc))["loss_bound"].item() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("functional", [True, False])
def test_the_penalty_pulls_a_mean_back_and_leaves_those_inside_alone(functional):
    loss, loc = make(BoundedClipPPOLoss, OUTSIDE, functional=functional, bound_coeff=10.0)
    parameters = list(loss.actor_network_params.parameters()) if functional else [loc]
    loss(samples(OUTSIDE))["loss_bound"].backward()
    # 10 * 2 * excess / 2 rows, with the sign of the mean: a step against it moves the mean inwards
    expected = torch.tensor([[5.0, -10.0, 0.0], [0.0, 0.0, -1.0]])
    torch.testing.assert_close(parameters[0].grad, expected)


def test_the_penalty_is_about_the_policy_of_this_very_call():
    loss, loc = make(BoundedClipPPOLoss, INSIDE, functional=False, bound_coeff=10.0)
    assert loss(samples(INSIDE))["loss_bound"] == 0
    with torch.no_grad():
        loc += 10
    assert loss(samples(INSIDE))["loss_bound"] > 100


def test_with_a_delayed_actor_the_penalty_is_that_of_the_policy_that_learns():
    plain, _ = make(BoundedClipPPOLoss, OUTSIDE, functional=True, bound_coeff=10.0)
    delayed, _ = make(BoundedClipPPOLoss, OUTSIDE, functional=True, bound_coeff=10.0, delay_actor=True)
    SoftUpdate(delayed, eps=0.99)
    for parameter in plain.actor_network_params.values(True, True), delayed.actor_network_params.values(True, True):
        next(iter(parameter)).data.add_(0.5)
    penalties = [loss(samples(OUTSIDE))["loss_bound"] for loss in (plain, delayed)]
    assert penalties[0] == penalties[1]
    assert penalties[1].requires_grad


def test_the_penalty_is_reduced_like_torchrl_s_terms_and_leaves_padding_out():
    data = samples(OUTSIDE)
    each, _ = make(BoundedClipPPOLoss, OUTSIDE, functional=False, bound_coeff=10.0, reduction="none")
    torch.testing.assert_close(each(data)["loss_bound"], torch.tensor([12.5, 0.1]))
    total, _ = make(BoundedClipPPOLoss, OUTSIDE, functional=False, bound_coeff=10.0, reduction="sum")
    assert total(data)["loss_bound"].item() == pytest.approx(12.6)
    padded, _ = make(BoundedClipPPOLoss, OUTSIDE, functional=False, bound_coeff=10.0)
    data["collector", "mask"] = torch.tensor([False, True])
    assert padded(data)["loss_bound"].item() == pytest.approx(0.1)


def test_it_takes_keywords_like_torchrl_s_and_its_terms_can_be_selected():
    data = samples(INSIDE).exclude("advantage", "value_target")
    for key, value in (("observation", torch.randn(2, 3)), ("reward", torch.randn(2, 1))):
        data["next", key] = value
    data["next", "done"] = torch.ones(2, 1, dtype=torch.bool)
    data["next", "terminated"] = data["next", "done"]
    theirs, _ = make(ClipPPOLoss, OUTSIDE, functional=True)
    ours, _ = make(BoundedClipPPOLoss, OUTSIDE, functional=True, bound_coeff=10.0)
    arguments = data.flatten_keys("_").to_dict()
    expected, found = theirs(**arguments), ours(**arguments)
    assert torch.equal(torch.stack(found[:-1]), torch.stack(expected))
    assert found[-1].item() == pytest.approx(6.3)
    ours.select_out_keys("loss_objective", "loss_bound")
    assert set(ours(data).keys()) == {"loss_objective", "loss_bound"}
