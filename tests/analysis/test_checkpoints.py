"""What figures read from checkpoints."""

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from refusals import refused
from tensordict import TensorDict

from torchrl_mcp.analysis.checkpoints import ground, untrained
from torchrl_mcp.analysis.walks import Walk
from torchrl_mcp.runs import build
from torchrl_mcp.runs.configuration import compose_run

STRIDES, PERIOD = 4, 30


def test_untrained_networks_see_states_through_the_normalisers_of_the_trained():
    """So the units of the states make no difference."""
    cfg = compose_run("preset=smoke", "task=imitation", "character=biped")
    env = build.make_env(cfg, num_envs=1, seed=0)
    phases = np.arange(STRIDES * PERIOD) % PERIOD / PERIOD
    standing = np.stack([phases < 0.6, (phases + 0.5) % 1 < 0.6], -1)
    states = {key: torch.randn(len(phases), env.observation_spec[key].shape[-1]) for key in ("observation", "goal")}

    def numbers(scale, offset):
        inputs = TensorDict({key: scale * value + offset for key, value in states.items()}, [len(phases)])
        trained = build.make_agent(cfg, env)
        for key in states:
            trained.parts[f"{key}_normaliser"].update(inputs[key])
        walk = Walk(phases, standing, np.empty(0), np.empty(0), inputs, strides=STRIDES, seconds=1.0)
        return untrained(cfg, trained, env, walk)

    assert numbers(5.0, 100.0) == pytest.approx(numbers(1.0, 0.0), rel=1e-3)


def test_environments_without_a_character_are_refused_where_its_path_would_be_drawn():
    cfg = compose_run("preset=smoke", "task=gymnasium", "character=none", "task.pretrain.id=Pendulum-v1")
    OmegaConf.set_struct(cfg, False)  # as read from a run folder
    refused(lambda: ground(cfg, 2, seconds=1.0, seed=0), "GymnasiumEnvs", "character")
