"""Noise that lasts: its statistics are those of a stationary autoregression, and it survives an interruption."""

import pytest
import torch
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type

from torchrl_mcp.distributions import MultiplicativeGaussian
from torchrl_mcp.envs import Holdout
from torchrl_mcp.methods.mcp import weights_actor
from torchrl_mcp.methods.transforms import CorrelatedNoise, TransformedCharacterEnv
from torchrl_mcp.runs.export import DeterministicPolicy, export

CORRELATION = 0.8


def standing(tensordict):
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 8))


def noisy(num_envs=2, seed=0, **settings):
    env = Holdout(num_envs=num_envs, directions=[0.0, 1.0], seed=seed, **settings)
    return TransformedCharacterEnv(env, CorrelatedNoise(3, CORRELATION))


def test_noise_is_standard_normal_and_forgets_geometrically():
    torch.manual_seed(0)
    transform, steps = CorrelatedNoise(size=4, correlation=CORRELATION), 60
    noise = TransformedEnv(Holdout(num_envs=64, directions=[0.0, 1.0], seed=0), transform).rollout(steps, standing)[
        "noise"
    ]
    assert noise.shape == (64, steps, 4)
    # Means over 64 * 60 * 4 values, of which about a ninth are independent: standard errors of 0.03 and less.
    assert noise.mean().item() == pytest.approx(0, abs=0.1)
    assert noise.std().item() == pytest.approx(1, abs=0.1)
    for lag in (1, 3, 6):
        product = (noise[:, lag:] * noise[:, :-lag]).mean().item()
        assert product == pytest.approx(CORRELATION**lag, abs=0.1), lag
    first, second = noise[..., 0].flatten(), noise[..., 1].flatten()
    assert (first * second).mean().item() == pytest.approx(0, abs=0.1)
    assert (noise[1:] * noise[:-1]).mean().item() == pytest.approx(0, abs=0.1)


def test_an_episode_begins_with_noise_of_its_own_and_the_others_go_on():
    env = noisy(num_envs=64, max_episode_steps=3)
    rollout = env.rollout(30, standing, break_when_any_done=False)
    ended = rollout["next", "done"].squeeze(-1)[:, :-1]
    before, after = rollout["next", "noise"][:, :-1], rollout["noise"][:, 1:]
    assert torch.equal(before[~ended], after[~ended])
    assert (before[ended] * after[ended]).mean().item() == pytest.approx(0, abs=0.15)  # 1,700 products
    assert after[ended].std().item() == pytest.approx(1, abs=0.1)


def test_noise_goes_on_after_an_interruption():
    env = noisy()
    now = env.rollout(5, standing)[:, -1]["next"].exclude("reward")
    saved, random = env.state_dict(), torch.get_rng_state()
    whole = env.rollout(5, standing, auto_reset=False, tensordict=now)

    resumed = noisy(seed=1)
    resumed.load_state_dict(saved)
    torch.manual_seed(7)
    began = resumed.reset()
    torch.set_rng_state(random)
    continued = resumed.rollout(5, standing, auto_reset=False, tensordict=began)
    assert torch.equal(continued["next", "noise"], whole["next", "noise"])
    assert torch.equal(continued["next", "observation"], whole["next", "observation"])


@pytest.mark.parametrize("correlation", [-0.1, 1.0, float("nan")])
def test_an_impossible_correlation_is_refused(correlation):
    with pytest.raises(ValueError, match="correlation"):
        CorrelatedNoise(size=2, correlation=correlation)


def test_logits_are_drawn_with_the_noise_and_scored_as_normal(composite, states):
    heads = {"gate_activation": torch.nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
    parts = composite(**heads)
    actor = weights_actor(parts, **heads, logits_std=0.5, noise="noise", frozen=["primitives"])
    inputs = states(50)
    noise = torch.randn(50, parts["gating"].output.out_features)
    with torch.no_grad():
        played = actor.policy(inputs.clone().set("noise", noise))
        loc = parts["gating"](
            parts["observation_normaliser"](inputs["observation"]), parts["goal_normaliser"](inputs["goal"])
        )
        torch.testing.assert_close(played["gate_logits"], loc + 0.5 * noise)
        score = torch.distributions.Normal(loc, 0.5).log_prob(played["gate_logits"]).sum(-1)
        torch.testing.assert_close(played["gate_logits_log_prob"], score)
        torch.testing.assert_close(actor.trained.get_dist(played).log_prob(played["gate_logits"]), score)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            still = actor.policy(inputs.clone())
    torch.testing.assert_close(still["gate_logits"], loc)


def test_an_exported_policy_needs_no_noise(composite, states):
    heads = {"gate_activation": torch.nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
    actor = weights_actor(composite(**heads), **heads, logits_std=0.5, noise="noise", frozen=["primitives"])
    inputs = states(20)
    noise = torch.randn(20, 4)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        expected = actor.policy(inputs.clone().set("noise", noise))["action"]
    observation_and_goal = inputs["observation"], inputs["goal"]
    program = export(DeterministicPolicy(actor.policy), observation_and_goal).module()
    torch.testing.assert_close(program(*observation_and_goal), expected)
