"""Pictures of the characters in their rest pose, from the front, the right, and in between.

MUJOCO_GL=egl python benchmarks/character_pictures.py    # seconds, writes docs/characters/*.png
"""

import argparse
from pathlib import Path

import matplotlib.image
import tensordict  # noqa: F401 - before mujoco, see envs/__init__.py

# isort: split
import mujoco
import numpy as np

from torchrl_mcp.envs.characters import CHARACTERS

PICTURES = Path(__file__).resolve().parents[1] / "docs" / "characters"


def stage(character: str, width: int, height: int) -> mujoco.MjModel:
    """Compile a character on a checkered floor under a bright sky."""
    spec = CHARACTERS[character].spec()
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.quality.offsamples, spec.visual.quality.shadowsize = 8, 4096
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.35] * 3, [0.45] * 3, [0.1] * 3
    gradient, checker = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    skybox, flat = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtTexture.mjTEXTURE_2D
    colours = {"rgb1": [0.93, 0.95, 0.98], "rgb2": [0.75, 0.82, 0.90]}
    spec.add_texture(name="sky", type=skybox, builtin=gradient, width=64, height=64, **colours)
    colours = {"rgb1": [0.80, 0.82, 0.85], "rgb2": [0.90, 0.91, 0.93]}
    spec.add_texture(name="floor", type=flat, builtin=checker, width=256, height=256, **colours)
    material = spec.add_material(name="floor", texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    plane, sun = mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_geom(name="floor", type=plane, size=[10, 10, 0.1], material="floor")
    spec.worldbody.add_light(name="sun", type=sun, pos=[2, -1.5, 4], dir=[-2, 1.5, -4], diffuse=[0.5] * 3)
    spec.stat.extent = 5  # of the region with shadows
    return spec.compile()


def corners(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """Lowest and highest coordinates of the character, shape ``(2, 3)``."""
    parts = model.geom_bodyid > 0
    axes = data.geom_xmat[parts].reshape(-1, 3, 3)
    centres = data.geom_xpos[parts] + (axes @ model.geom_aabb[parts, :3, None])[..., 0]
    reach = (np.abs(axes) @ model.geom_aabb[parts, 3:, None])[..., 0]
    return np.stack([(centres - reach).min(0), (centres + reach).max(0)])


def picture(character: str, size: int = 480) -> np.ndarray:
    """Draw the rest pose from the front, the right and in between, shape ``(size, 3 * size, 3)``."""
    model = stage(character, size, size)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    low, high = corners(model, data)
    camera, views = mujoco.MjvCamera(), []
    camera.lookat[:], camera.elevation = (low + high) / 2, -10
    camera.distance = 1.3 * np.max(high - low) + 0.3
    with mujoco.Renderer(model, size, size) as renderer:
        for azimuth in (180, 90, 140):
            camera.azimuth = azimuth
            renderer.update_scene(data, camera)
            views.append(renderer.render().copy())
    return np.concatenate(views, 1)


def main() -> None:
    """Draw the characters on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("characters", nargs="*", default=list(CHARACTERS))
    parser.add_argument("--output", type=Path, default=PICTURES, help="folder")
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    for character in args.characters:
        matplotlib.image.imsave(args.output / f"{character}.png", picture(character))


if __name__ == "__main__":
    main()
