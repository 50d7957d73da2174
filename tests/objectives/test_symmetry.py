"""Mirror images in learning: they agree with samples, a symmetric policy pays nothing, what has none is refused."""

import math

import pytest
import torch
from refusals import refused

from torchrl_mcp.objectives import MirroredSamples, SymmetryLoss
from torchrl_mcp.runs import build
from torchrl_mcp.runs.configuration import compose_run

MIRRORED = {
    "scratch": ["method=scratch", "task=heading"],
    "mcp": ["method=mcp", "task=imitation"],
    "mcp at transfer": ["method=mcp", "task=heading", "stage=transfer", "exploration=action"],
    "moe": ["method=moe", "task=dribble", "stage=transfer"],
    "latent_space": ["method=latent_space", "task=imitation"],
    "finetune": ["method=finetune", "task=imitation"],
}


def trainer_of(folder, *overrides):
    settings = ["preset=smoke", "logger=none", "num_threads=1", "autocast=false", "width=0.05", f"run_dir={folder}"]
    cfg = compose_run(*settings, *overrides)
    torch.manual_seed(0)
    source = build.make_source(cfg)
    agent = build.make_agent(cfg, source.env)
    return agent, build.make_trainer(cfg, agent, source, folder)


def collect(agent, trainer):
    with torch.no_grad():
        batch = trainer.source.env.rollout(8, agent.actor.policy, break_when_any_done=False, auto_reset=True)
    for key in ("observation", "goal"):
        if (name := f"{key}_normaliser") not in agent.frozen:
            agent.parts[name].update(batch[key])  # which begins to tell left from right
    with torch.no_grad():
        batch[agent.actor.log_prob] = agent.actor.trained.get_dist(batch).log_prob(batch["action"])
    return batch


@pytest.mark.parametrize("overrides", MIRRORED.values(), ids=MIRRORED)
def test_half_of_the_samples_are_mirror_images_to_learn_from_like_the_others(overrides, tmp_path):
    agent, trainer = trainer_of(tmp_path, "symmetry=augment", *overrides)
    assert isinstance(trainer.update.objective.advantages, MirroredSamples)
    trainer.update.objective.advantages.tolerance = math.inf
    before = collect(agent, trainer)
    after = trainer.update.objective.advantages(before.clone())
    plain = trainer.update.objective.advantages.advantages(before.clone())
    mirrors = trainer.source.env.mirrors()
    mirrored = (after["action"] != before["action"]).any(-1)  # bodies at rest are their own images
    assert 4 <= mirrored.sum() <= 28  # of 32
    for key in ("observation", "goal", "action"):
        assert torch.equal(after[key][~mirrored], before[key][~mirrored])
        assert torch.equal(after[key][mirrored], mirrors[key](before[key][mirrored]))
    for key in ("advantage", "value_target"):
        assert torch.equal(after[key], plain[key])
    for key in agent.actor.drawn:
        assert torch.equal(after[key], before[key])
    distribution = agent.actor.trained.get_dist(after)
    torch.testing.assert_close(
        distribution.log_prob(after["action"]), after[agent.actor.log_prob], atol=2e-3, rtol=1e-4
    )
    # What is stored of frozen networks is theirs in the mirrored states.
    acted = agent.actor.policy(after.select("observation", "goal"))
    for key in set(agent.actor.stored) - set(agent.actor.drawn):
        torch.testing.assert_close(after[key], acted[key], atol=1e-5, rtol=1e-4)


def test_a_batch_may_have_no_image(tmp_path):
    agent, trainer = trainer_of(tmp_path, "symmetry=augment", "method=scratch", "task=heading")
    single = collect(agent, trainer)[:1, :1]
    replaced = 0
    for _ in range(20):
        after = trainer.update.objective.advantages(single.clone())
        replaced += not torch.equal(after["action"], single["action"])
    assert 0 < replaced < 20


def test_a_sample_whose_image_the_policy_finds_all_but_impossible_is_not_replaced(tmp_path):
    agent, trainer = trainer_of(tmp_path, "symmetry=augment", "method=scratch", "task=heading")
    before = collect(agent, trainer)
    actor, mirrors = agent.actor, trainer.source.env.mirrors()
    image = before.clone()
    for key in ("observation", "goal", "action"):
        image[key] = mirrors[key](image[key])
    loss = before[actor.log_prob] - actor.trained.get_dist(image).log_prob(image["action"])
    trainer.update.objective.advantages.tolerance = limit = loss.median().item()
    after = trainer.update.objective.advantages(before.clone())
    mirrored = (after["action"] != before["action"]).any(-1)
    assert mirrored.any()
    assert (loss[mirrored] <= limit).all()
    assert (loss > limit).any()
    torch.testing.assert_close(after[actor.log_prob][~mirrored], before[actor.log_prob][~mirrored])


@pytest.mark.parametrize("overrides", MIRRORED.values(), ids=MIRRORED)
def test_the_penalty_is_the_squared_distance_of_mean_actions_from_their_mirror_images(overrides, tmp_path):
    agent, trainer = trainer_of(tmp_path, "symmetry=loss", *overrides)
    samples = trainer.update.objective.advantages(collect(agent, trainer)).flatten()
    mirrors, actor = trainer.source.env.mirrors(), agent.actor
    image = samples.clone()
    for key in ("observation", "goal"):
        image[key] = mirrors[key](image[key])
    if "primitives" in trainer.agent.frozen:
        image.update(actor.policy(image.select("observation", "goal")).select(*actor.stored))
    means = [actor.trained.get_dist(side).mean for side in (samples, image)]
    expected = 4.0 * (means[0] - mirrors["action"](means[1])).square().sum(-1).mean()
    report = trainer.update.objective.losses["actor"](samples)
    torch.testing.assert_close(report["loss_symmetry"], expected, atol=1e-6, rtol=1e-3)
    assert report["loss_symmetry"] > 0
    parameters = [p for p in actor.trained.parameters() if p.requires_grad]
    gradient = torch.autograd.grad(report["loss_symmetry"], parameters, allow_unused=True)
    with torch.no_grad():
        for parameter, slope in zip(parameters, gradient, strict=True):
            if slope is not None:
                parameter -= 1e-4 * slope
    assert trainer.update.objective.losses["actor"](samples)["loss_symmetry"] < report["loss_symmetry"]


def test_a_symmetric_policy_pays_nothing(tmp_path):
    agent, trainer = trainer_of(tmp_path, "symmetry=loss", "method=scratch", "task=heading")
    samples = trainer.update.objective.advantages(collect(agent, trainer)).flatten()
    mirrors, policy = trainer.source.env.mirrors(), agent.parts["policy"]
    for key in ("observation", "goal"):  # statistics of a symmetric policy are symmetric
        normaliser = agent.parts[f"{key}_normaliser"]
        normaliser.mean.copy_((normaliser.mean + mirrors[key](normaliser.mean)) / 2)
        normaliser.variance.copy_((normaliser.variance + mirrors[key](normaliser.variance).abs()) / 2)
    plain = type(policy).forward

    def forward(observation, goal):
        loc, scale = plain(policy, observation, goal)
        image, _ = plain(policy, mirrors["observation"](observation), mirrors["goal"](goal))
        return (loc + mirrors["action"](image)) / 2, scale

    policy.forward = forward
    assert trainer.update.objective.losses["actor"](samples)["loss_symmetry"] < 1e-9


def test_reflections_move_with_the_loss_and_are_no_part_of_its_state(tmp_path):
    agent, trainer = trainer_of(tmp_path, "symmetry=none", "method=scratch", "task=heading")
    mirrors = trainer.source.env.mirrors()
    loss = SymmetryLoss(trainer.update.objective.losses["actor"], agent.actor, mirrors, coeff=1.0)
    assert not [key for key in loss.state_dict() if "mirror" in key]
    loss.to("meta")
    assert {buffer.device.type for mirror in mirrors.values() for buffer in mirror.buffers()} == {"meta"}


@pytest.mark.parametrize("symmetry", ["augment", "loss"])
@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        (["method=option_critic", "task=imitation"], "options"),
        (["method=hierarchical", "task=imitation"], "options"),
        (["method=mcp", "task=heading", "stage=transfer", "exploration=weights"], "options"),
        (["method=mcp", "task=holdout"], "Holdout"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_has_no_mirror_image_is_refused(symmetry, overrides, name, tmp_path):
    refused(lambda: trainer_of(tmp_path, f"symmetry={symmetry}", *overrides), name, "symmetry=none")
