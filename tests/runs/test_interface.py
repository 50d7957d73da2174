"""What exported policies say about their inputs and outputs."""

import json
import math

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Imitation, Location
from torchrl_mcp.envs.motions.single import single_motion
from torchrl_mcp.runs.interface import interface

ENVIRONMENTS = {
    "heading": lambda **more: Heading("biped", **more),
    "speeds": lambda **more: Heading("biped", speed=(0.0, 1.0), waypoint=True, **more),
    "location": lambda **more: Location("biped", **more),
    "facing": lambda **more: Location("biped", final_directions=(-1.0, 1.0), **more),
    "carry": lambda **more: Carry("biped", goal_positions="logarithmic", waypoint=True, **more),
    "dribble": lambda **more: Dribble("trex", **more),
    "holdout": lambda **more: Holdout(directions=(0.0, 1.0), contact_forces=True, **more),
    "imitation": lambda **more: Imitation(
        "biped", single_motion("biped"), terms={"pose": {"weight": 1.0, "scale": 1.0}}, **more
    ),
}


def made(name):
    return ENVIRONMENTS[name](num_envs=2, seed=0, num_threads=1)


def values(env, key, name):
    layout = {"observation": env.observation_layout, "goal": env.goal_layout}[key]
    return env.reset()[key][:, layout[name]]


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_entries_name_every_value_once_with_its_unit(name):
    env = made(name)
    described, state = {key: json.loads(text) for key, text in interface(env).items()}, env.reset()
    for key in ("observation", "goal"):
        entries = described[key]
        assert sum(entry["size"] for entry in entries) == state[key].shape[-1]
        assert len({entry["name"] for entry in entries}) == len(entries)
        assert all(entry["unit"] for entry in entries)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_the_scene_is_that_of_the_environment(name):
    env = made(name)
    described = {key: json.loads(text) for key, text in interface(env).items()}
    own, other = env.simulation.model, mujoco.MjModel.from_xml_string(described["scene"])
    for field in ("body_mass", "body_pos", "geom_size", "jnt_range", "actuator_ctrlrange", "qpos0"):
        np.testing.assert_allclose(getattr(other, field), getattr(own, field), rtol=1e-5)  # six digits
    assert described["physics_timestep"] == pytest.approx(other.opt.timestep)
    assert [entry["name"] for entry in described["action"]] == [other.actuator(index).name for index in range(other.nu)]


def test_the_ants_observation_has_each_joint_under_its_name():
    env = made("holdout")
    state, model = env.reset()["observation"], env.simulation.model
    for joint in (model.joint(index) for index in range(1, model.njnt)):
        angle = env.simulation.state["qpos"][:, joint.qposadr].float()
        speed = env.simulation.state["qvel"][:, joint.dofadr].float()
        torch.testing.assert_close(state[:, env.observation_layout[f"{joint.name}.joint_angle"]], angle)
        torch.testing.assert_close(state[:, env.observation_layout[f"{joint.name}.joint_velocity"]], speed)


def test_the_goals_have_each_value_under_its_name():
    speeds = made("speeds")
    torch.testing.assert_close(
        values(speeds, "goal", "speed")[:, 0].double(), speeds.episode["speed"], atol=1e-6, rtol=0
    )
    facing = made("facing")
    direction = values(facing, "goal", "final_direction")
    expected = facing.episode["final_direction"] - facing.heading()
    torch.testing.assert_close(torch.atan2(direction[:, 1], direction[:, 0]).double(), expected, atol=1e-5, rtol=0)


def test_the_reference_of_imitation_is_named_by_step_and_body():
    env = made("imitation")
    height = values(env, "goal", "step_1.root.position")[:, 2]
    assert height.tolist() == pytest.approx([float(env.simulation.model.qpos0[2])] * 2, abs=0.3)
    quaternion = values(env, "goal", "step_2.root.orientation")
    assert torch.linalg.vector_norm(quaternion, dim=-1).tolist() == pytest.approx([1.0, 1.0])
    assert math.isclose(env.goal_layout["step_2.root.position"].start, env.reset()["goal"].shape[-1] / 2)
