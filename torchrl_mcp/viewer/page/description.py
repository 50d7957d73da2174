"""Describes policies and their environments to JavaScript, and checks that JavaScript can play them."""

import json
from typing import Any

import mujoco

from torchrl_mcp.envs import Carry, CharacterEnv, Dribble, Heading, Imitation, Location
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.tasks.transport import Transport
from torchrl_mcp.runs.interface import interface

TASKS = (Heading, Location, Carry, Dribble, Imitation)
"""Tasks that ``tasks.js`` implements."""

SHAPES = tuple(f"mjGEOM_{shape}" for shape in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX"))
"""Shapes that ``drawing.js`` can draw."""


def require_playable(env: CharacterEnv) -> PDCharacterEnv:
    """Return the environment, after checking that the page can play its task and draw its character.

    Raises:
        ValueError: If the page cannot play the task, or cannot draw a shape of the character.
    """
    playable = ", ".join(task.__name__.lower() for task in TASKS)
    name = type(env).__name__
    if type(env) not in TASKS or not isinstance(env, PDCharacterEnv):
        raise ValueError(f"the page cannot play the task {name}: export a gate for {playable}")
    model = env.simulation.model
    shapes = {mujoco.mjtGeom(shape).name for shape in model.geom_type}
    if unknown := sorted(shapes - set(SHAPES)):
        raise ValueError(
            f"the page cannot draw the shapes {', '.join(unknown)} of {env.character.name}: remove these geoms"
        )
    return env


def character(env: PDCharacterEnv) -> dict[str, Any]:
    """Return the numbers that all gates of a character share."""
    return {
        "num_bodies": len(env.observation_layout) // 4,  # four quantities per body, after the height of the root
        "num_qpos": len(env.initial_states.rest),
        "num_qvel": env.initial_states.num_velocities,
        "physics_timestep": env.simulation.model.opt.timestep,
        "substeps": env.substeps,
        "action": json.loads(interface(env)["action"]),
    }


def gate(env: PDCharacterEnv) -> dict[str, Any]:
    """Return the description of a gate's task: the contents of its goal, and the range of its speeds in m/s."""
    if isinstance(env, Imitation):
        return {"task": "Imitation"}
    described: dict[str, Any] = {"task": type(env).__name__, "goal": list(env.goal_layout), "waypoint": False}
    if isinstance(env, Location):
        return {**described, "speeds": [0.0, env.speed]}
    if isinstance(env, Heading):
        return {**described, "waypoint": env.waypoint, "speeds": list(env.speeds)}
    assert isinstance(env, Transport)
    return {
        **described,
        "waypoint": env.waypoint,
        "logarithmic": env.goal_positions == "logarithmic",
        "objects": list(env.objects.items()),
        "carrier": env.character.carrier,
    }
