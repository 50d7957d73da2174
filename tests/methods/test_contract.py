"""What every actor keeps: probabilities to the bit, deterministic play, any batch, and no more stored than it says."""

from dataclasses import replace

import pytest
import torch
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.methods.critic import value_critic
from torchrl_mcp.objectives import BoundedClipPPOLoss

COMPOSITES = ["composite", "composite-frozen", "composite-additive", "composite-additive-frozen", "weights"]
ACTORS = [*COMPOSITES, "gaussian", "injected", "latent"]


@pytest.mark.parametrize("autocast", [False, True], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("name", ACTORS)
def test_before_an_update_the_loss_sees_the_log_probability_of_collection_to_the_bit(
    name, autocast, make_actor, sample
):
    actor, _ = make_actor(name)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        stored = sample(actor, 64)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        log_prob = actor.trained.get_dist(stored).log_prob(stored[actor.sampled])
    assert {x.dtype for x in (log_prob, stored[actor.sampled], stored[actor.log_prob])} == {torch.float32}
    assert log_prob.requires_grad
    assert (log_prob - stored[actor.log_prob]).abs().max() == 0


@pytest.mark.parametrize("name", ACTORS)
def test_without_exploration_the_action_is_deterministic_and_with_it_random(name, make_actor, states):
    actor, _ = make_actor(name)
    actions = {}
    for exploration in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        with set_exploration_type(exploration), torch.no_grad():
            actions[exploration] = [actor.policy(states(10))["action"] for _ in range(2)]
    first, second = actions[ExplorationType.DETERMINISTIC]
    assert torch.equal(first, second)
    first, second = actions[ExplorationType.RANDOM]
    assert (first != second).any(-1).all()


@pytest.mark.parametrize("name", ACTORS)
@pytest.mark.parametrize("key", ["observation", "goal"])
def test_networks_see_inputs_relative_to_their_running_mean(name, key, make_actor, states):
    actor, parts = make_actor(name)
    actions, seen = [], states(10)
    for _ in range(2):
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            actions.append(actor.policy(seen.clone())["action"])
        seen[key] += 1
        parts[f"{key}_normaliser"].mean += 1
    torch.testing.assert_close(*actions, atol=1e-4, rtol=1e-4)


def test_without_exploration_the_most_likely_action_of_each_mixer_is_played(states, make_actor):
    td = states(10)
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        product = make_actor("composite")[0].policy(td.clone())
        precision = product["gates"].unsqueeze(-1) / product["primitives", "scale"].square()
        mean = (precision * product["primitives", "loc"]).sum(-2) / precision.sum(-2)
        torch.testing.assert_close(product["action"], mean)

        mixture = make_actor("composite-additive")[0].policy(td.clone())
        best = mixture["gates"].argmax(-1)
        torch.testing.assert_close(mixture["action"], mixture["primitives", "loc"][torch.arange(10), best])

        gaussian = make_actor("gaussian")[0].policy(td.clone())
        torch.testing.assert_close(gaussian["action"], gaussian["loc"])


@pytest.mark.parametrize("batch", [(), (3, 5)])
@pytest.mark.parametrize("name", ACTORS)
def test_any_batch_of_states_is_acted_on(name, batch, make_actor, sample, sizes):
    actor, _ = make_actor(name)
    stored = sample(actor, *batch)
    assert stored["action"].shape == (*batch, sizes.action)
    assert stored[actor.log_prob].shape == batch


@pytest.mark.parametrize("name", ACTORS)
def test_the_loss_needs_only_what_the_actor_says_it_stores(name, make_actor, sizes, states):
    actor, parts = make_actor(name)
    critic = value_critic(parts, sizes, num_cells=(8,))
    loss = BoundedClipPPOLoss(actor.trained, critic, bound_coeff=1.0, entropy_bonus=False, functional=False)
    loss.set_keys(action=actor.sampled, sample_log_prob=actor.log_prob)
    with torch.no_grad():
        played = actor.policy(states(32))
    played["advantage"], played["value_target"] = torch.randn(32, 1), torch.randn(32, 1)
    needed = ["observation", "goal", actor.sampled, actor.log_prob, *actor.stored, "advantage", "value_target"]
    report, expected = loss(played.select(*needed)), loss(played)
    for key in ("loss_objective", "loss_critic", "loss_bound"):
        torch.testing.assert_close(report[key], expected[key])
    sum(value for key, value in report.items() if key.startswith("loss_")).backward()
    for part in ("gating", "policy", "goal_input", "encoder", "decoder", "critic"):
        if part in parts:
            assert all(parameter.grad is not None for parameter in parts[part].parameters())


def test_an_actor_names_the_log_probability_after_what_it_samples(make_actor):
    actor, _ = make_actor("gaussian")
    assert actor.log_prob == "action_log_prob"
    assert replace(actor, sampled="gate_logits").log_prob == "gate_logits_log_prob"
