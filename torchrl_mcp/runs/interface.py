"""What a program without this library needs to run an exported policy: names, units, time steps and the scene."""

import json
from typing import Any

import torch

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.envs.pd_character import PDCharacterEnv

UNITS = {
    "root_height": "m",
    "position": "m",
    "orientation": "quaternion w x y z",
    "linear_velocity": "m/s",
    "angular_velocity": "rad/s",
}
"""Units of the quantities of a character's state."""


def interface(env: CharacterEnv) -> dict[str, str]:
    """Return the interface of a policy to its environment, as JSON texts by key.

    ``observation`` and ``goal`` list their entries in order, with name, number of values and unit; ``action`` lists the
    actuators, whose control is ``centre + scale * action``, clipped to MuJoCo's ``ctrlrange``. ``scene`` is the MJCF of
    the environment, also as JSON.

    Args:
        env: The environment in which the policy was trained.
    """
    described: dict[str, Any] = {
        "control_timestep": env.control_timestep,
        "physics_timestep": env.simulation.model.opt.timestep,
        "action": _action(env),
        "goal": _goal(env),
    }
    if isinstance(env, PDCharacterEnv):
        described |= {
            "character": env.character.name,
            "feet": list(env.character.feet),
            "scene": env.scene,
            "observation": [
                {"name": name, "size": place.stop - place.start, "unit": UNITS[name.rpartition(".")[2]]}
                for name, place in env.observation_layout.items()
            ],
        }
    return {key: json.dumps(value) for key, value in described.items()}


def _action(env: CharacterEnv) -> list[dict[str, Any]]:
    """Name, centre and scale of each actuator."""
    model = env.simulation.model
    zero = torch.zeros(env.num_envs, model.nu, dtype=torch.float64, device=env.device)
    centre = env._controls(zero)
    scale = env._controls(zero + 1) - centre
    unit = "rad" if isinstance(env, PDCharacterEnv) else "ctrl"
    return [
        {"name": model.actuator(index).name, "unit": unit, "centre": middle, "scale": half}
        for index, (middle, half) in enumerate(zip(centre.expand_as(zero)[0].tolist(), scale[0].tolist(), strict=True))
    ]


def _goal(env: CharacterEnv) -> list[dict[str, Any]]:
    """Name, size and unit of each entry of the goal; tasks without a layout have one entry."""
    size = env.observation_spec["goal"].shape[-1]
    layout: dict[str, slice] = getattr(env, "goal_layout", {})
    named = min((place.start for place in layout.values()), default=size)
    first: dict[str, int] = getattr(env, "goal_sizes", {"goal": named})
    sizes = {**first, **{name: place.stop - place.start for name, place in layout.items()}}
    units = getattr(env, "goal_units", {})
    return [{"name": name, "size": sizes[name], "unit": units.get(name, "")} for name in sizes if sizes[name]]
