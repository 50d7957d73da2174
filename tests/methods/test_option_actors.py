"""The actors that choose among options: when a choice ends, what is blind to the goal, what the loss sees."""

from functools import partial

import pytest
import torch
from hydra.utils import instantiate
from refusals import refused
from tensordict import TensorDict
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.evaluation.diagnostics import diagnostics
from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.hierarchical import gated_actor, gated_parts, primitive_actor, primitive_parts
from torchrl_mcp.methods.option_critic import option_critic_actor, option_critic_parts, option_values
from torchrl_mcp.methods.options import SeparateOptions, Terminations
from torchrl_mcp.modules import GaussianPolicy, JointGating, Primitives
from torchrl_mcp.runs.configuration import compose_run

S, G, A, K, N = 6, 2, 3, 4, 12
POLICY = partial(GaussianPolicy, num_cells=(16, 8), std=0.3, output_gain=1.0)
FROZEN = ["primitives", "observation_normaliser"]


def hierarchical(steps_per_choice=3, **settings):
    """Return parts and actor of the hierarchical model at transfer."""
    torch.manual_seed(0)
    gating = partial(JointGating, num_cells=(16, 8))
    parts = gated_parts(
        Sizes(S, G, A), gating=gating, primitives=partial(SeparateOptions, policy=POLICY), num_options=K
    )
    return parts, gated_actor(parts, num_options=K, steps_per_choice=steps_per_choice, frozen=FROZEN, **settings)


def option_critic(initial=0.5, epsilon=0.1, frozen=()):
    """Return parts and actor of the option-critic."""
    torch.manual_seed(0)
    parts = option_critic_parts(
        Sizes(S, G, A),
        options=partial(Primitives, trunk_cells=(16, 8), branch_cells=0, initial_std=0.3),
        terminations=partial(Terminations, num_cells=(16, 8), initial=initial),
        values_cells=(16, 8),
        num_options=K,
    )
    return parts, option_critic_actor(parts, num_options=K, epsilon=epsilon, frozen=frozen)


def pretraining():
    """Return parts and actor of the hierarchical model while its primitives are trained."""
    torch.manual_seed(0)
    parts = primitive_parts(Sizes(S, G, A), primitives=partial(SeparateOptions, policy=POLICY), num_options=K)
    return parts, primitive_actor(parts, num_options=K)


METHODS = {"hierarchical": hierarchical, "pretraining": pretraining, "option_critic": option_critic}


def situations(seed=0, held_steps=0):
    generator = torch.Generator().manual_seed(seed)
    return TensorDict(
        {
            "observation": torch.randn(N, S, generator=generator),
            "goal": torch.randn(N, G, generator=generator),
            "option": torch.randint(0, K, (N,), generator=generator),
            "held_option": torch.randint(0, K, (N,), generator=generator),
            "held_steps": torch.full((N,), held_steps),
            "next": {"observation": torch.randn(N, S, generator=generator)},
        },
        batch_size=N,
    )


def test_a_choice_lasts_as_many_steps_as_configured():
    _, actor = hierarchical(steps_per_choice=3)
    for held, begins in enumerate([True, False, False, True, False]):
        out = actor.policy(situations(held_steps=held))
        assert out["begins"].all() if begins else not out["begins"].any()
        if not begins:
            assert torch.equal(out["option"], out["held_option"])


def test_an_option_ends_with_its_own_probability_in_the_state_where_it_led():
    torch.manual_seed(0)
    parts, actor = option_critic()
    parts["terminations"].output.weight.data.normal_()
    held = situations(held_steps=3)
    many = held.expand(4000, N).reshape(-1)
    rate = actor.policy(many)["begins"].view(4000, N).float().mean(0)
    logits = parts["terminations"].output(parts["terminations"].body(held["observation"]))
    expected = logits.sigmoid()[torch.arange(N), held["held_option"]]
    torch.testing.assert_close(rate, expected, atol=0.03, rtol=0.0)
    assert expected.std() > 0.05


def test_at_the_beginning_of_an_episode_no_option_is_held():
    _, actor = option_critic(initial=1e-6)
    assert actor.policy(situations(held_steps=0))["begins"].all()
    out = actor.policy(situations(held_steps=1))
    assert not out["begins"].any()
    assert torch.equal(out["option"], out["held_option"])


@pytest.mark.parametrize("method", METHODS)
def test_options_see_no_goal_and_what_chooses_among_them_does(method):
    _, actor = METHODS[method]()
    sample = situations()
    sample["goal"] = sample["goal"].requires_grad_()
    acted = actor.policy(sample.clone(recurse=False))
    for key in {"loc", "scale", "terminations"} & set(acted.keys()):
        if acted[key].requires_grad:
            (slope,) = torch.autograd.grad(acted[key].sum(), sample["goal"], retain_graph=True, allow_unused=True)
            assert slope is None or not slope.any(), key
    for key in {"gate_logits", "option_values"} & set(acted.keys()):
        (slope,) = torch.autograd.grad(acted[key].square().sum(), sample["goal"], retain_graph=True)
        assert slope.any(), key
    assert ("gate_logits" in acted.keys()) == (method == "hierarchical")  # noqa: SIM118


@pytest.mark.parametrize("method", METHODS)
def test_the_loss_sees_the_probability_with_which_the_policy_drew(method):
    _, actor = METHODS[method]()
    with torch.no_grad():
        sample = actor.policy(situations())
    kept = sample.select("observation", "goal", "next", *actor.stored)
    log_prob = actor.trained.get_dist(kept).log_prob(sample[actor.sampled])
    torch.testing.assert_close(log_prob, sample[actor.log_prob])


def test_the_entropy_of_the_gate_s_choices_has_its_weight_in_the_loss():
    parts, actor = hierarchical()
    cfg = compose_run("method=hierarchical", "task=heading", "stage=transfer", "entropy_coeff=0.3", "run_dir=never")
    loss = instantiate(cfg.objective.loss)(actor.trained)
    loss.set_keys(action=actor.sampled, sample_log_prob=actor.log_prob)
    with torch.no_grad():
        samples = actor.policy(situations())
    samples["advantage"] = torch.randn(N, 1)
    shares = parts["gating"](samples["observation"], samples["goal"]).softmax(-1)
    entropy = -(shares * shares.log()).sum(-1).mean()
    torch.testing.assert_close(loss(samples)["loss_entropy"], -0.3 * entropy)


def test_deterministic_choices_and_actions_repeat_themselves():
    for make in (hierarchical, partial(option_critic, initial=1e-6)):
        _, actor = make()
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            one, other = actor.policy(situations()), actor.policy(situations())
        assert torch.equal(one["option"], other["option"])
        assert torch.equal(one["action"], other["action"])
        assert torch.equal(one["action"], one["loc"])


@pytest.mark.parametrize("make", [hierarchical, option_critic])
def test_options_have_no_mean_but_a_likeliest_one(make):
    _, actor = make()
    with set_exploration_type(ExplorationType.MEAN), pytest.raises(ValueError, match="DETERMINISTIC"):
        actor.policy(situations())
    with torch.no_grad(), set_exploration_type(ExplorationType.MODE):
        mode = actor.policy(situations())
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        torch.testing.assert_close(actor.policy(situations())["option"], mode["option"])


def test_terminations_are_judged_where_the_option_led_and_not_where_it_acted():
    _, actor = option_critic()
    sample = situations()
    for key in ("observation", ("next", "observation")):
        sample[key] = sample[key].requires_grad_()
    termination = actor.trained.get_dist_params(sample)["termination"]
    here, there = torch.autograd.grad(
        termination.sum(), [sample["observation"], sample["next", "observation"]], allow_unused=True
    )
    assert here is None
    assert there.any()


def test_frozen_terminations_are_not_evaluated_in_the_update():
    _, actor = option_critic(frozen=["options", "terminations", "observation_normaliser"])
    assert ("next", "observation") not in actor.trained.in_keys


@pytest.mark.parametrize("noise", [True, False])
def test_without_action_noise_the_chosen_primitive_plays_its_mean_and_the_choice_stays_random(noise):
    parts, actor = hierarchical(action_noise=noise)
    with torch.no_grad():
        out = actor.policy(situations().expand(50, N).reshape(-1))
        states = out["normalised", "observation"]
        chosen = zip(out["option"].tolist(), states, strict=True)
        means = torch.stack([parts["primitives"].policies[k](state, state[:0])[0] for k, state in chosen])
    assert len(out["option"].view(50, N)[:, 0].unique()) > 1
    assert torch.allclose(out["action"], means, atol=1e-6) != noise


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: SeparateOptions(S, A, 0, policy=POLICY), "num_options"),
        (lambda: Terminations(S, K, num_cells=(8,), initial=1.0), "initial=1.0"),
        (lambda: hierarchical(steps_per_choice=0), "steps_per_choice"),
        (lambda: gated_actor(hierarchical()[0], num_options=K, steps_per_choice=3), "transfer.freeze"),
    ],
)
def test_arguments_out_of_range_are_named(make, name):
    refused(make, name)


def test_every_actor_that_chooses_options_has_its_diagnostics():
    for make in (hierarchical, option_critic):
        _, actor = make()
        found = diagnostics(actor, actor.policy(situations()).select(*actor.stored))
        assert {f"options/usage_{k}" for k in range(K)} | {"options/duration"} <= found.keys()
    _, actor = pretraining()
    assert diagnostics(actor, situations()) == {}


def test_terminations_stay_random_in_deterministic_play():
    torch.manual_seed(0)
    _, actor = option_critic(initial=0.3)
    many = situations(held_steps=1).expand(400, N).reshape(-1)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        rate = actor.policy(many)["begins"].float().mean().item()
    assert rate == pytest.approx(0.3, abs=0.04)  # 4,800 draws: six standard errors


def test_primitives_and_parts_of_another_method_are_refused_with_the_choice_that_fits():
    trunk = partial(Primitives, trunk_cells=(16, 8), branch_cells=0, initial_std=0.3)
    refused(lambda: primitive_parts(Sizes(S, G, A), primitives=trunk, num_options=K), "primitives=separate")
    refused(lambda: option_values(hierarchical()[0], Sizes(S, G, A)), "critic", "terminations", "critic=mlp")
