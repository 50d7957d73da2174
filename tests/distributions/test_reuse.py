"""Each distribution in stock TorchRL agents, with no other part of this library."""

import gymnasium
import numpy as np
import pytest
import torch
from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.envs import ExplorationType, GymEnv, GymWrapper, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, ValueOperator
from torchrl.objectives import A2CLoss, ClipPPOLoss, CrossQLoss, KLPENPPOLoss, REDQLoss, SACLoss, SoftUpdate
from torchrl.objectives.value import GAE

from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian, TanhMultiplicativeGaussian

both = pytest.mark.parametrize("distribution_class", [MultiplicativeGaussian, AdditiveGaussian])
all_three = pytest.mark.parametrize(
    "distribution_class", [MultiplicativeGaussian, AdditiveGaussian, TanhMultiplicativeGaussian]
)
TORQUE = {"low": -2.0, "high": 2.0}
"""Bounds of the pendulum's action."""


class Primitives(nn.Module):
    def __init__(self, observation_dim, action_dim, num_primitives=4):
        super().__init__()
        self.shape = (num_primitives, action_dim)
        size = num_primitives * action_dim
        self.loc = nn.Sequential(nn.Linear(observation_dim, 32), nn.Tanh(), nn.Linear(32, size))
        self.scale = nn.Sequential(nn.Linear(observation_dim, size), nn.Softplus())

    def forward(self, observation):
        return self.loc(observation).unflatten(-1, self.shape), self.scale(observation).unflatten(-1, self.shape) + 0.1


def make_actor(distribution, observation_dim=3, action_dim=1, **kwargs):
    gate = nn.Sequential(nn.Linear(observation_dim, 32), nn.Tanh(), nn.Linear(32, 4), nn.Sigmoid())
    return ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(gate, in_keys=["observation"], out_keys=["gates"]),
            TensorDictModule(Primitives(observation_dim, action_dim), ["observation"], ["loc", "scale"]),
        ),
        in_keys=["loc", "scale", "gates"],
        distribution_class=distribution,
        distribution_kwargs=kwargs,
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )


def make_critic(observation_dim=3):
    return ValueOperator(nn.Sequential(nn.Linear(observation_dim, 32), nn.Tanh(), nn.Linear(32, 1)))


def collect(env, actor, critic, steps=64):
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        batch = env.rollout(steps, actor, break_when_any_done=False)
    return GAE(gamma=0.95, lmbda=0.9, value_network=critic, average_gae=True)(batch)


def total(losses):
    return sum(losses[key] for key in losses.keys() if key.startswith("loss_"))  # noqa: SIM118


def assert_the_loss_trains_gates_and_primitives(losses, actor):
    """Every parameter of the gate, the means and the scales gets a finite gradient, and none of them is idle."""
    total(losses).backward()
    gradients = {name: p.grad for name, p in actor.named_parameters()}
    assert all(gradient is not None and gradient.isfinite().all() for gradient in gradients.values())
    assert all(gradient.abs().max() > 0 for gradient in gradients.values())


@pytest.fixture
def env():
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1", device="cpu")
    env.set_seed(0)
    yield env
    env.close()


@all_three
@pytest.mark.parametrize("loss_class", [ClipPPOLoss, KLPENPPOLoss, A2CLoss])
def test_it_trains_in_a_stock_on_policy_agent(env, distribution_class, loss_class):
    actor, critic = make_actor(distribution_class), make_critic()
    loss_module = loss_class(actor, critic, entropy_coeff=0.01)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=1e-3)
    before = [p.detach().clone() for p in actor.parameters()]
    for _ in range(3):
        batch = collect(env, actor, critic)
        for _ in range(2):
            optimizer.zero_grad()
            assert_the_loss_trains_gates_and_primitives(loss_module(batch), actor)
            optimizer.step()
    assert all(not torch.equal(old, new) for old, new in zip(before, actor.parameters(), strict=True))


@both
def test_the_policy_ratio_is_one_until_the_first_update(env, distribution_class):
    actor, critic = make_actor(distribution_class), make_critic()
    loss_module = ClipPPOLoss(actor, critic)
    batch = collect(env, actor, critic)
    losses = loss_module(batch)
    # A batch of one and a batch of 64 round their matrix products differently ...
    torch.testing.assert_close(losses["kl_approx"], torch.tensor(0.0), atol=1e-5, rtol=0)
    assert losses["clip_fraction"] == 0
    # ... and nothing else differs.
    with torch.no_grad():
        actor(batch)
    losses = loss_module(batch)
    assert losses["kl_approx"] == 0
    assert losses["max_ratio"] == losses["mean_ratio"] == 1


def test_the_policy_ratio_of_a_squashed_product_is_one_up_to_the_rounding_of_actions(env):
    actor, critic = make_actor(TanhMultiplicativeGaussian, **TORQUE), make_critic()
    losses = ClipPPOLoss(actor, critic)(collect(env, actor, critic))
    torch.testing.assert_close(losses["max_ratio"], torch.tensor(1.0), atol=1e-3, rtol=0)


@all_three
def test_the_entropy_bonus_is_our_own_and_not_torchrl_s_sampled_one(env, distribution_class, monkeypatch):
    actor, critic = make_actor(distribution_class), make_critic()
    batch = collect(env, actor, critic)
    monkeypatch.setattr(distribution_class, "entropy", lambda self: torch.full(self.batch_shape, 7.0))
    assert ClipPPOLoss(actor, critic)(batch)["entropy"] == 7


@all_three
def test_exploration_off_plays_the_deterministic_sample(env, distribution_class):
    actor = make_actor(distribution_class)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        step = actor(env.reset())
    expected = distribution_class(step["loc"], step["scale"], step["gates"]).deterministic_sample
    assert torch.equal(step["action"], expected)


def make_action_value():
    return ValueOperator(MLP(in_features=4, out_features=1, num_cells=[32]), in_keys=["observation", "action"])


@pytest.mark.parametrize("bounds", [TORQUE, {name: torch.tensor([bound]) for name, bound in TORQUE.items()}])
@pytest.mark.parametrize("loss_class", [SACLoss, REDQLoss])
def test_the_squashed_product_trains_in_a_stock_off_policy_agent(env, loss_class, bounds):
    actor = make_actor(TanhMultiplicativeGaussian, **bounds)
    loss_module = loss_class(actor, make_action_value(), action_spec=env.action_spec)
    loss_module.make_value_estimator(gamma=0.95)
    target_updater = SoftUpdate(loss_module, eps=0.99)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=1e-3)
    with torch.no_grad():
        batch = env.rollout(64, actor)
    assert env.action_spec.is_in(batch["action"])
    for _ in range(3):
        optimizer.zero_grad()
        assert_the_loss_trains_gates_and_primitives(loss_module(batch), actor)
        optimizer.step()
        target_updater.step()


@pytest.mark.parametrize("loss_class", [SACLoss, REDQLoss, CrossQLoss])
def test_a_loss_that_differentiates_samples_refuses_the_mixture_with_the_remedy(env, loss_class):
    loss_module = loss_class(make_actor(AdditiveGaussian), make_action_value(), action_spec=env.action_spec)
    loss_module.make_value_estimator(gamma=0.95)
    with pytest.raises(NotImplementedError, match="TanhMultiplicativeGaussian"):
        loss_module(env.rollout(8, env.rand_action))


class Follow(gymnasium.Env):
    """One step: answer the observed point with it, for a reward of minus the squared distance."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-5, 5, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.point = self.np_random.uniform(-1, 1, 2).astype(np.float32)
        return self.point, {}

    def step(self, action):
        return self.point, -float(((action - self.point) ** 2).sum()), True, False, {}


@pytest.mark.slow
@both
def test_stock_ppo_learns_with_it(distribution_class):
    torch.manual_seed(0)
    env = GymWrapper(Follow())
    env.set_seed(0)
    actor, critic = make_actor(distribution_class, 2, 2), make_critic(2)
    loss_module = ClipPPOLoss(actor, critic, entropy_coeff=0.0)
    optimizer = torch.optim.Adam(loss_module.parameters(), lr=3e-3)
    returns = []
    for _ in range(30):
        batch = collect(env, actor, critic, 256)
        returns.append(batch["next", "reward"].mean())
        for _ in range(10):
            optimizer.zero_grad()
            total(loss_module(batch)).backward()
            optimizer.step()
    assert torch.stack(returns[-5:]).mean() > 0.3 * returns[0]
