"""Arguments of tasks that have no meaning: each is refused by name and value."""

import math
from dataclasses import replace

import pytest
from refusals import refused

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Imitation, Location
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.motions.single import single_motion

NEGATIVE = {"mixture": [{"object_distances": (-1.0, 2.0)}]}
POSE = {"weight": 1.0, "scale": 2.0}
KEYS = {"key_positions": POSE}
OF_BOTH = [
    ({"object_distances": (-1.0, 2.0)}, "object_distances=(-1.0, 2.0)"),
    ({"object_distances": (3.0, 2.0)}, "object_distances=(3.0, 2.0)"),
    ({"object_distances": (0.0, 0.3)}, "object_distances=(0.0, 0.3)"),  # where bodies overlap
    ({"target_distances": (-0.1, 2.0)}, "target_distances=(-0.1, 2.0)"),
    ({"target_distances": (1.0, math.inf)}, "target_distances=(1.0, inf)"),
    ({"curriculum": NEGATIVE}, "object_distances=(-1.0, 2.0)"),
    ({"speed": -1.0}, "speed=-1.0"),
    ({"target_distance_power": 3}, "target_distance_power=3"),
    ({"goal_positions": "feet"}, "goal_positions='feet'"),
    ({"character": "horse"}, "character='horse'"),
]
REFUSED = [
    *((task, arguments, name) for task in (Carry, Dribble) for arguments, name in OF_BOTH),
    (Heading, {"character": "ant"}, "character='ant'"),
    (Heading, {"physics_timestep": 0.007}, "physics_timestep=0.007"),
    (Heading, {"physics_timestep": 0.1}, "physics_timestep=0.1"),
    (Heading, {"friction_cone": "round"}, "friction_cone='round'"),
    (Heading, {"num_envs": 0}, "num_envs=0"),
    (Heading, {"max_turn": -0.1}, "max_turn=-0.1"),
    (Heading, {"speed": math.nan}, "speed=nan"),
    (Heading, {"speed": 0.0}, "speed=0.0"),
    (Heading, {"speed": (0.0, 0.0)}, "speed=(0.0, 0.0)"),
    (Heading, {"speed": (-0.5, 1.0)}, "speed=(-0.5, 1.0)"),
    (Heading, {"speed": (1.0, 0.5)}, "speed=(1.0, 0.5)"),
    (Heading, {"speed_interval": 0.0}, "speed_interval=0.0"),
    (Heading, {"initial_directions": (1.0, 0.0)}, "initial_directions=(1.0, 0.0)"),
    (Location, {"speed": 0.0}, "speed=0.0"),
    (Location, {"target_distances": (-1.0, 2.0)}, "target_distances=(-1.0, 2.0)"),
    (Location, {"target_intervals": (-1.0, 2.0)}, "target_intervals=-1.0"),
    (Location, {"target_intervals": (3.0, 2.0)}, "target_intervals=(3.0, 2.0)"),
    (Location, {"final_directions": (1.0, 0.0)}, "final_directions=(1.0, 0.0)"),
    (Holdout, {"directions": (1.0, 0.0)}, "directions=(1.0, 0.0)"),
    (Holdout, {"directions": (0.0, 1.0, 2.0)}, "directions=(0.0, 1.0, 2.0)"),
    (Holdout, {"directions": 1.0}, "directions=1.0"),
    (Holdout, {"directions": (0.0, math.inf)}, "directions=(0.0, inf)"),
    (Holdout, {"directions": (0.0, math.nan)}, "directions=(0.0, nan)"),
    (Holdout, {"healthy_z_range": (1.0, 0.2)}, "healthy_z_range=(1.0, 0.2)"),
    (Holdout, {"forward_weight": -1.0}, "forward_weight=-1.0"),
    (Holdout, {"healthy_weight": math.nan}, "healthy_weight=nan"),
    (Holdout, {"control_weight": math.inf}, "control_weight=inf"),
    (Holdout, {"contact_weight": -0.1}, "contact_weight=-0.1"),
    (Holdout, {"reset_noise_scale": -0.1}, "reset_noise_scale=-0.1"),
    (Imitation, {"clips": single_motion("humanoid")}, "character='biped'"),
    (Imitation, {"clips": "folder"}, "clips='folder'"),
    (Imitation, {"max_error": 0.0}, "max_error=0.0"),
    (Imitation, {"switch_interval": 0}, "switch_interval=0"),
    (Imitation, {"switch_candidates": 0}, "switch_candidates=0"),
    (Imitation, {"switch_to": "other"}, "switch_to='other'"),
    (Imitation, {"clip_end": "loop"}, "clip_end='loop'"),
    (Imitation, {"curriculum": {"random_first_length": True}}, "curriculum"),
    (Imitation, {"terms": {}}, "terms"),
    (Imitation, {"terms": {"posture": POSE}}, "'posture'"),
    (Imitation, {"terms": {"pose": {"weight": 1.0, "scales": 2.0}}}, "scales"),
    (Imitation, {"terms": {"pose": {"weight": -1.0, "scale": 2.0}}}, "terms.pose.weight=-1.0"),
    (Imitation, {"terms": {"pose": {"weight": 1.0, "scale": -50.0}}}, "terms.pose.scale=-50.0"),
]


def make(task, **arguments):
    defaults = {"num_envs": 1, "num_threads": 1, "directions": (0.0, 1.0)}
    if task is not Holdout:
        defaults["character"] = "biped"
        del defaults["directions"]
    if task is Imitation:
        defaults |= {"clips": single_motion("biped"), "terms": {"pose": POSE}}
    return task(**defaults | arguments)


@pytest.mark.parametrize(("task", "arguments", "name"), REFUSED)
def test_an_argument_without_meaning_is_refused(task, arguments, name):
    refused(lambda: make(task, **arguments), name)


def test_tasks_of_bodies_that_a_character_does_not_name_are_refused(monkeypatch):
    monkeypatch.setitem(CHARACTERS, "biped", replace(CHARACTERS["biped"], carrier=None, key_bodies=()))
    refused(lambda: make(Carry), "character='biped'")
    refused(lambda: make(Imitation, terms=KEYS), "key_positions", "character='biped'")
    make(Imitation)
