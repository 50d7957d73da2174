"""Where box and tables are at the start of carrying, and what touches them."""

import math

import torch

from torchrl_mcp.envs import Carry

FRONT = 0.065  # half-thickness of the biped's torso, a box
HALF_SIZE = 0.15  # of the box


def make(num_envs=2, character="biped", **kwargs):
    return Carry(character, num_envs, **{"seed": 0, "num_threads": 1, **kwargs})


def play(env, carrier, num_steps):
    for _ in range(num_steps):
        carrier = env.step(carrier.set("action", torch.zeros(env.action_spec.shape)))["next"]
    return carrier


def joined(env):
    return env.simulation.state["eq_active"].flatten().tolist()


def test_the_box_waits_on_the_source_as_it_is_turned():
    env = make(8, object_distances=(3.0, 5.0))
    carrier = env.reset()
    state = env.get_state()
    assert torch.equal(state["qpos"][:, -4:], state["mocap_quat"][:, 1])
    assert state["mocap_quat"][:, :, 3].std() > 0.2
    play(env, carrier, 30)
    after = env.get_state()
    assert (after["qpos"][:, -7:] - state["qpos"][:, -7:]).abs().max() < 1e-3
    assert joined(env) == [0.0] * 8


def test_no_box_begins_in_the_character_and_no_table_in_the_other():
    env = make(2000, object_distances=(0.0, 1.0), target_distances=(0.0, 1.5))
    env.reset()
    target, source = env.simulation.state["mocap_pos"][:, :, :2].unbind(1)
    corner = math.hypot(HALF_SIZE, HALF_SIZE)
    arms_length = math.hypot(FRONT, 0.145)  # a corner of the torso
    assert source.norm(dim=-1).min() >= arms_length + corner - 1e-9
    distances = (target - source).norm(dim=-1)
    assert distances.min() >= 2 * corner
    assert distances.max() <= 1.5


def test_tables_hold_the_box_and_touch_no_character():
    model = make(1, "humanoid", self_collision=True).simulation.model
    tops = [g for g in range(model.ngeom) if model.body(model.geom_bodyid[g]).name in ("source", "target")]
    box = model.geom("box").id
    for top in tops:
        meets = [
            geom
            for geom in range(model.ngeom)
            if model.geom_contype[geom] & model.geom_conaffinity[top]
            or model.geom_contype[top] & model.geom_conaffinity[geom]
        ]
        assert meets in ([box], [])  # a top, a leg
    assert sum(bool(model.geom_contype[top]) for top in tops) == 2
