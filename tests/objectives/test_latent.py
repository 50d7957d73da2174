from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.critic import value_critic
from torchrl_mcp.methods.latent_space import NOISE, latent_actor, latent_parts
from torchrl_mcp.modules import GaussianPolicy, StateGoalEncoder
from torchrl_mcp.objectives import BoundedClipPPOLoss, LatentPPOLoss

S, G, A, L = 6, 2, 3, 4


def make(loss_class, **kwargs):
    torch.manual_seed(0)
    parts = latent_parts(
        Sizes(S, G, A),
        encoder=partial(StateGoalEncoder, num_cells=(16, 8)),
        decoder=partial(GaussianPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0),
        latent_dim=L,
    )
    actor, critic = latent_actor(parts), value_critic(parts, Sizes(S, G, A), num_cells=(8,))
    loss = loss_class(actor.trained, critic, bound_coeff=1.0, entropy_bonus=False, loss_critic_type="l2", **kwargs)
    with torch.no_grad():
        samples = actor.policy(TensorDict(observation=torch.randn(32, S), goal=torch.randn(32, G), batch_size=[32]))
    samples["advantage"], samples["value_target"] = torch.randn(32, 1), torch.randn(32, 1)
    keys = ["observation", "goal", "action", "action_log_prob", NOISE, "advantage", "value_target"]
    return loss, parts, samples.select(*keys)


def divergences(parts, samples):
    loc, scale = parts["encoder"](*(parts[f"{key}_normaliser"](samples[key]) for key in ("observation", "goal")))
    return ((loc.square() + scale.square() - 1) / 2 - scale.log()).sum(-1)


@pytest.mark.parametrize("functional", [True, False])
def test_the_loss_is_ppo_s_plus_the_weighted_mean_divergence(functional):
    loss, parts, samples = make(LatentPPOLoss, kl_coeff=0.3, functional=functional)
    reference, _, _ = make(BoundedClipPPOLoss, functional=functional)
    report, expected = loss(samples), reference(samples)
    for key in expected.keys():  # noqa: SIM118
        torch.testing.assert_close(report[key], expected[key])
    divergence = divergences(parts, samples).mean()
    torch.testing.assert_close(report["latent_kl"], divergence)
    torch.testing.assert_close(report["loss_latent"], 0.3 * divergence)
    assert {"loss_bound", "loss_latent", "latent_kl"} <= set(loss.out_keys)


def test_with_a_delayed_actor_the_divergence_is_that_of_the_encoder_that_learns():
    loss, parts, samples = make(LatentPPOLoss, kl_coeff=0.3, delay_actor=True)
    SoftUpdate(loss, eps=0.99)
    with torch.no_grad():
        for parameter in parts["encoder"].parameters():
            parameter.mul_(1.5)
    report = loss(samples)
    torch.testing.assert_close(report["loss_latent"], 0.3 * divergences(parts, samples).mean())
    assert report["loss_latent"].requires_grad


def test_the_divergence_is_reduced_like_torchrl_s_terms_and_leaves_padding_out():
    loss, parts, samples = make(LatentPPOLoss, kl_coeff=0.3, reduction="none")
    torch.testing.assert_close(loss(samples)["loss_latent"], 0.3 * divergences(parts, samples))
    loss, parts, samples = make(LatentPPOLoss, kl_coeff=0.3)
    samples["collector", "mask"] = torch.arange(32) < 20
    torch.testing.assert_close(loss(samples)["loss_latent"], 0.3 * divergences(parts, samples)[:20].mean())


@pytest.mark.parametrize("functional", [True, False])
def test_minimising_the_penalty_brings_the_codes_to_the_prior_and_leaves_the_decoder_alone(functional):
    loss, parts, samples = make(LatentPPOLoss, kl_coeff=1.0, functional=functional)
    optimizer = torch.optim.Adam(parts["encoder"].parameters(), lr=1e-2)
    before = loss(samples)["latent_kl"]
    for _ in range(50):
        optimizer.zero_grad()
        report = loss(samples)
        report["loss_latent"].backward()
        optimizer.step()
    assert report["latent_kl"] < 0.05 * before
    assert all(parameter.grad is None for parameter in parts["decoder"].parameters())


def test_the_encoder_learns_from_the_policy_gradient_alone():
    loss, parts, samples = make(LatentPPOLoss, kl_coeff=0.0, functional=False)
    report = loss(samples)
    assert report["loss_latent"] == 0
    report["loss_objective"].backward()
    assert all(parameter.grad.abs().max() > 0 for parameter in parts["encoder"].parameters())


@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "bfloat16"])
def test_before_an_update_the_ratio_is_one(autocast):
    loss, parts, _ = make(LatentPPOLoss, kl_coeff=1e-4, functional=False)
    actor = latent_actor(parts)
    states = TensorDict(observation=torch.randn(64, S), goal=torch.randn(64, G), batch_size=[64])
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast), torch.no_grad():
        samples = actor.policy(states)
    samples["advantage"], samples["value_target"] = torch.randn(64, 1), torch.randn(64, 1)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        report = loss(samples)
    assert report["kl_approx"] == 0
    assert report["clip_fraction"] == 0
    assert report["max_ratio"] == 1
    # TorchRL's is a share of the batch.
    assert report["ESS"].item() == pytest.approx(1.0)
