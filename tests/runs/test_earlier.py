"""Runs of earlier versions: their policies can be evaluated, and what cannot be trained further says so."""

import pytest
from omegaconf import OmegaConf
from refusals import refused

from torchrl_mcp.runs import configuration, experiment, policies
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.earlier import require_resumable, translated
from torchrl_mcp.training import checkpoint


def test_what_this_version_lacks_is_left_out_at_any_depth():
    held = {"task": {"pretrain": {"failure_weighting": 0.5, "max_error": 0.3}}, "list": [{"shaping": {}}], "seed": 1}
    made = translated(held)
    del made["physics"]
    assert made == {"task": {"pretrain": {"max_error": 0.3}}, "list": [{}], "seed": 1}


def test_a_published_network_that_was_trained_with_what_is_removed_can_be_restored():
    file = builtin("mcp", "biped")
    assert checkpoint.saved_config(file)["task"]["pretrain"]["failure_weighting"] == 0.5
    cfg, agent, env = policies.restore(file, num_envs=2, seed=0)
    assert "failure_weighting" not in cfg.task.pretrain
    assert agent.actor.policy(env.reset())["action"].shape == (2, env.action_spec.shape[-1])


@pytest.mark.parametrize("held", [{}, {"physics": "mujoco"}, {"physics": "warp"}])
def test_an_engine_that_was_a_name_is_a_group_of_settings_in_this_version(held):
    engine = held.get("physics", "mujoco")
    cfg = configuration.compose_run("task=heading", "run_dir=never", f"physics={engine}")
    assert translated(held) == {"physics": OmegaConf.to_container(cfg.physics)}
    assert translated(translated(held)) == translated(held)


def test_settings_of_training_episodes_are_one_setting_in_this_version():
    rest, states = {"rest": 1.0, "motions": 0.0}, {"rest": 0.2, "motions": 0.8}
    plain = {
        "initial_states": rest,
        "mixture": [],
        "emphasis": None,
        "staggered": False,
        "discount": 0.99,
        "speed": 1.0,
    }
    emphasis = {"weights": [1.0, 0.2, 1.0, 2.0], "target_distance_power": 2}
    trained = {"initial_states": states, "staggered": True, "emphasis": emphasis, "_target_": "torchrl_mcp.envs.Carry"}
    made = translated({"task": {"transfer": trained, "evaluation": plain}, "evaluation": {"environment": plain}})
    assert made["task"]["evaluation"] == made["evaluation"]["environment"] == {"speed": 1.0, "curriculum": None}
    assert made["task"]["transfer"]["curriculum"] == {
        "initial_states": states,
        "mixture": (),
        "reward_weights": [1.0, 0.2, 1.0, 2.0],
        "target_distance_power": 2,
        "random_first_length": True,
        "discount": 0.99,
    }
    assert translated(made) == made


@pytest.mark.parametrize("character", ["biped", "humanoid", "trex"])
def test_a_published_gate_can_be_restored_as_it_was_trained(character):
    cfg, _, env = policies.restore(builtin("mcp", character, "heading"), num_envs=2, seed=0)
    assert cfg.evaluation.environment.curriculum is None
    assert env.curriculum.initial_states["motions"] > 0
    assert env.curriculum.random_first_length
    assert env.curriculum.reward_weights is None


@pytest.mark.parametrize(
    ("name", "value", "unused"),
    [
        ("failure_weighting", 0.5, 0.0),
        ("shaping", {"object": {"slope": 1.0}}, {}),
        ("state_dependent_std", False, True),
    ],
)
def test_a_run_that_was_trained_with_what_is_removed_cannot_be_resumed(name, value, unused, tmp_path, monkeypatch):
    def config(value):
        return {"stage": {"name": "pretrain"}, "task": {"pretrain": {name: value}}, "training": {"total_frames": 128}}

    require_resumable(config(unused))
    monkeypatch.setattr(experiment, "is_complete", lambda folder: False)
    OmegaConf.save(config(value), tmp_path / "config.yaml")
    refused(lambda: experiment.resume(tmp_path), f"{name}={value}", untouched=tmp_path)
