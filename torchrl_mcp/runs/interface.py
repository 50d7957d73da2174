"""Describes a policy to programs without this library: names, units, time steps and the scene."""

import json
from collections.abc import Mapping
from typing import Any

import torch

from torchrl_mcp.adapters.adapter import Adapter
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.envs.pd_character import PDCharacterEnv


def interface(env: CharacterEnv | Adapter) -> dict[str, str]:
    """Return the interface of a policy to its environment, as JSON texts by key.

    ``observation`` and ``goal`` list their entries in order, with name, number of values and unit. ``action`` lists the
    actuators, whose control is ``centre + scale * action``, clipped to MuJoCo's ``ctrlrange``. ``scene`` is the MJCF of
    the environment as a JSON string.

    Environments of other libraries have neither a scene nor names of entries: each input is one entry, and the actions
    are the actions of the environment.

    Args:
        env: The environment in which the policy was trained.
    """
    if isinstance(env, Adapter):
        return _adapted(env)
    described: dict[str, Any] = {
        "control_timestep": env.control_timestep,
        "physics_timestep": env.simulation.model.opt.timestep,
        "observation": _entries(env, "observation", env.observation_layout),
        "goal": _entries(env, "goal", env.goal_layout),
        "action": _action(env),
        "scene": env.scene,
    }
    if isinstance(env, PDCharacterEnv):
        described |= {"character": env.character.name, "feet": list(env.character.feet)}
    return {key: json.dumps(value) for key, value in described.items()}


def _adapted(env: Adapter) -> dict[str, str]:
    """Return the interface of a policy to an environment of another library."""
    sizes = {key: env.observation_spec[key].shape[-1] for key in ("observation", "goal")}
    described: dict[str, Any] = {
        "control_timestep": env.control_timestep,
        **{key: [{"name": key, "size": size, "unit": ""}] for key, size in sizes.items()},
        "action": [
            {"name": f"action_{index}", "unit": "", "centre": centre, "scale": scale}
            for index, (centre, scale) in enumerate(zip(*(part.tolist() for part in env.action_scaling()), strict=True))
        ],
        "environment": env.name,
    }
    return {key: json.dumps(value) for key, value in described.items()}


def _entries(env: CharacterEnv, key: str, layout: Mapping[str, slice]) -> list[dict[str, Any]]:
    """Return name, size and unit of each entry of an input; without a layout, a non-empty input is one entry."""
    size = env.observation_spec[key].shape[-1]
    layout = layout if layout or not size else {key: slice(0, size)}
    return [
        {
            "name": name,
            "size": place.stop - place.start,
            "unit": env.units.get(name, env.units.get(name.rpartition(".")[2], "")),
        }
        for name, place in layout.items()
    ]


def _action(env: CharacterEnv) -> list[dict[str, Any]]:
    """Return name, unit, centre and scale of each actuator."""
    model = env.simulation.model
    zero = torch.zeros(env.num_envs, model.nu, dtype=torch.float64, device=env.device)
    centre = env._controls(zero)
    scale = env._controls(zero + 1) - centre
    unit = "rad" if isinstance(env, PDCharacterEnv) else "control"
    return [
        {"name": model.actuator(index).name, "unit": unit, "centre": middle, "scale": half}
        for index, (middle, half) in enumerate(zip(centre.expand_as(zero)[0].tolist(), scale[0].tolist(), strict=True))
    ]
