"""Whether a body holds its rest pose under its own servos."""

import mujoco
import numpy as np

from torchrl_mcp.envs.characters.falls import falling_geoms, lowest_points

SECONDS = 2.0
"""How long a character has to hold its rest pose."""

SUNK = 0.75
"""Part of its height in the rest pose below which a root no longer stands."""

DIVERGED = 1e3
"""Velocity in m/s or rad/s that no body reaches unless its simulation diverges."""

TILTED = 0.5
"""Angle in radians from the rest pose beyond which a root no longer stands."""


def rest_controls(model: mujoco.MjModel) -> np.ndarray:
    """Targets of the servos in the rest pose, shape ``(nu,)``, in radians."""
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    return data.actuator_length.copy()


def collapse(spec: mujoco.MjSpec, feet: tuple[str, ...], *, seconds: float = SECONDS) -> str:
    """Let a body hold its rest pose on flat ground, and say how it fails.

    Args:
        spec: The body alone, which meets the rest of the contract.
        feet: Bodies that may touch the ground.
        seconds: Duration.

    Returns:
        How and when it fails, or nothing if it stands throughout.
    """
    scene = spec.copy()
    scene.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1, conaffinity=1)
    model = scene.compile()
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    data.ctrl[:] = rest_controls(model)
    height = data.xpos[1, 2]
    upright = data.xmat[1].reshape(3, 3)[2].copy()
    falling, half_sizes, radii = (part.numpy() for part in falling_geoms(model, feet, model.nbody - 1))
    steps = round(seconds / model.opt.timestep)
    for step in range(1, steps + 1):
        mujoco.mj_step(model, data)
        when = f"after {step * model.opt.timestep:.2g} s {_furthest(model, data)}"
        if data.warning.number.any() or not abs(data.qvel).max() < DIVERGED:
            return f"its simulation diverges {when}"
        lows = lowest_points(data.geom_xpos[falling, 2], data.geom_xmat[falling, 6:], half_sizes, radii)
        if (lows < 0).any():
            body = model.geom_bodyid[falling[lows.argmin()]]
            return f"its {model.body(body).name} touches the ground {when}"
        if data.xpos[1, 2] < SUNK * height or data.xmat[1].reshape(3, 3)[2] @ upright < np.cos(TILTED):
            return f"it topples {when}"
    return ""


def _furthest(model: mujoco.MjModel, data: mujoco.MjData) -> str:
    """The joint that is furthest from the rest pose."""
    away = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, away, 1.0, model.qpos0, data.qpos)
    if model.nv == 6:
        return "(it has no joints)"
    dof = 6 + int(abs(away[6:]).argmax())
    return f"({model.joint(model.dof_jntid[dof]).name} is {abs(away[dof]):.2f} rad from it)"
