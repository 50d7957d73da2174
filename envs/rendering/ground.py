"""Ground, sky and light of scenes."""

import mujoco


def add_ground(spec: mujoco.MjSpec) -> None:
    """Add flat ground, sky and light to a character's scene."""
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        width=64,
        height=6 * 64,
        rgb1=[0.45, 0.62, 0.82],
        rgb2=[0.87, 0.90, 0.94],
    )
    spec.add_texture(
        name="ground",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        width=256,
        height=256,
        rgb1=[0.62, 0.66, 0.70],
        rgb2=[0.70, 0.74, 0.78],
    )
    material = spec.add_material(name="ground", texrepeat=[0.5, 0.5], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "ground"
    spec.worldbody.add_geom(
        name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], material="ground", contype=1, conaffinity=1
    )
    # The light follows the character, because MuJoCo draws shadows only near the lit point.
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    follow = mujoco.mjtCamLight.mjCAMLIGHT_TRACK
    spec.bodies[1].add_light(name="sun", type=sun, mode=follow, pos=[3, -4, 10], dir=[-0.3, 0.4, -1])
    spec.visual.map.shadowclip = 20.0  # beyond the shadow map the ground is speckled
