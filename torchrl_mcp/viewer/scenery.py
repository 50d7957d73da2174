"""Shapes that explain a task, such as arrows to targets and a ghost of the reference motion, and soft light."""

import copy

import mujoco
import numpy as np
from torch import Tensor

from torchrl_mcp.envs.base import CharacterEnv
from torchrl_mcp.envs.motions.placement import Placement
from torchrl_mcp.envs.rendering.camera import Colour, Shape, arrow, ghost
from torchrl_mcp.envs.tasks.imitation import Imitation

HAZE: Colour = (0.87, 0.90, 0.94, 1.0)
"""Colour of the haze at the horizon."""

ZENITH: Colour = (0.45, 0.62, 0.82, 1.0)
"""Colour of the sky at the zenith."""

GROUND = (150, 205)
"""Darkest and lightest pixel of the ground, from 0 to 255."""


def scenery(env: CharacterEnv, index: int = 0, *, aside: float = 0.0) -> list[Shape]:
    """Return the shapes that are drawn in addition to a simulation.

    Args:
        env: The environments.
        index: Number of the simulation.
        aside: Metres by which a ghost is moved along y, so that it does not cover the character; 0 shows the ghost at
            its true place.
    """
    shapes = [arrow(*ends) for ends in env.arrows(index)]
    if isinstance(env, Imitation):
        qpos = reference(env, index)
        qpos[1] += aside
        shapes += ghost(env.simulation.model, qpos.numpy())
    return shapes


def reference(env: Imitation, index: int = 0) -> Tensor:
    """Return the current state ``qpos`` of the reference motion of simulation ``index``, ``(nq,)``."""
    episode = env.episode
    one = slice(index, index + 1)
    placement = Placement(episode["turn"][one], episode["shift"][one])
    return env.library.at(episode["clip"][one], episode["time"][one], placement).qpos[0]


def softly_lit(model: mujoco.MjModel, *, horizon: Colour = HAZE, zenith: Colour = ZENITH) -> mujoco.MjModel:
    """Return a copy of a scene in soft light, with a pale, matt ground that fades into :data:`HAZE`.

    MuJoCo draws the haze only if the flag ``mjRND_FOG`` is set.

    Args:
        model: The scene.
        horizon: Colour of the sky at the horizon and below, if the scene has a sky.
        zenith: Colour of the sky at the zenith.
    """
    model = copy.copy(model)
    light = model.vis.headlight
    light.ambient = [0.38] * 3
    light.diffuse = [0.35] * 3
    light.specular = [0.05] * 3
    model.light_diffuse[:] = 0.55
    model.light_specular[:] = 0.1
    model.vis.rgba.fog = HAZE
    model.vis.map.fogstart, model.vis.map.fogend = np.array([5.0, 15.0]) / model.stat.extent
    model.vis.map.shadowclip = 35.0 / model.stat.extent  # the ground looks speckled beyond the shadow map
    model.mat_reflectance[:] = 0
    for plane in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).tolist():
        _extend(model, plane)
        _fade(model, plane)
    for sky in np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX).tolist():
        pixels = _pixels(model, sky)
        pixels[:] = sky_picture(model.tex_width[sky], horizon, zenith)[..., : model.tex_nchannel[sky]].reshape(-1)
    return model


def sky_picture(width: int, horizon: Colour, zenith: Colour) -> np.ndarray:
    """Return the six faces of a sky cube, stacked in MuJoCo's order, ``(6 * width, width, 3)``, uint8.

    The order is right, left, up, down, front and back; the first row of a side face is at the top.
    """
    side = (2 * np.arange(width) + 1) / width - 1
    away = np.sqrt(1 + side[:, None] ** 2 + side**2)
    heights = {"side": -side[:, None] / away, "up": 1 / away, "down": -1 / away}  # sines of the elevation
    faces = [heights[face] for face in ("side", "side", "up", "down", "side", "side")]
    share = np.concatenate(faces).clip(0, 1)[..., None]
    return np.round(255 * ((1 - share) * horizon[:3] + share * zenith[:3])).astype(np.uint8)


def extent(model: mujoco.MjModel) -> float:
    """Return the largest distance of the first body's tree from its centre of mass in the rest pose, in metres."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    is_body = model.body_rootid[model.geom_bodyid] == 1
    distances = np.linalg.norm(data.geom_xpos[is_body] - data.subtree_com[1], axis=-1)
    return float((distances + model.geom_rbound[is_body]).max())


def _extend(model: mujoco.MjModel, plane: int) -> None:
    """Make a plane infinite and keep its pattern, because MuJoCo draws too much haze on large finite planes."""
    size = model.geom_size[plane, :2]
    material = model.geom_matid[plane]
    if material >= 0 and (size > 0).all() and not model.mat_texuniform[material]:
        model.mat_texrepeat[material] /= size
        model.mat_texuniform[material] = True
    size[:] = 0


def _fade(model: mujoco.MjModel, plane: int) -> None:
    """Clip the pixels of a plane's pattern to :data:`GROUND`."""
    material = model.geom_matid[plane]
    texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB] if material >= 0 else -1
    if texture >= 0:
        pixels = _pixels(model, texture)
        pixels[:] = pixels.clip(*GROUND)


def _pixels(model: mujoco.MjModel, texture: int) -> np.ndarray:
    """Return the pixels of a texture as a one-dimensional view, through which they can be changed."""
    size = model.tex_height[texture] * model.tex_width[texture] * model.tex_nchannel[texture]
    return model.tex_data[model.tex_adr[texture] :][:size]
