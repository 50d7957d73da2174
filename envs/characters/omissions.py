"""What the conversion of a body into a character leaves out."""

from collections.abc import Sequence

import mujoco
import numpy as np

KINDS = {
    "light": (mujoco.mjtObj.mjOBJ_LIGHT, "nlight"),
    "camera": (mujoco.mjtObj.mjOBJ_CAMERA, "ncam"),
    "site": (mujoco.mjtObj.mjOBJ_SITE, "nsite"),
    "tendon": (mujoco.mjtObj.mjOBJ_TENDON, "ntendon"),
    "equality constraint": (mujoco.mjtObj.mjOBJ_EQUALITY, "neq"),
    "sensor": (mujoco.mjtObj.mjOBJ_SENSOR, "nsensor"),
    "contact pair": (mujoco.mjtObj.mjOBJ_PAIR, "npair"),
    "contact exclusion": (mujoco.mjtObj.mjOBJ_EXCLUDE, "nexclude"),
    "flex": (mujoco.mjtObj.mjOBJ_FLEX, "nflex"),
    "skin": (mujoco.mjtObj.mjOBJ_SKIN, "nskin"),
    "keyframe": (mujoco.mjtObj.mjOBJ_KEY, "nkey"),
}
"""Kinds of parts that no character keeps, with their type and the model's count of them."""


def omissions(character: mujoco.MjModel, source: mujoco.MjModel, bodies: Sequence[int]) -> dict[str, list[str]]:
    """Return the names of the parts of a file that a character lacks, by kind.

    Args:
        character: The character.
        source: The body in its scene, from which the character was made.
        bodies: Bodies of ``source`` that the character keeps.
    """
    other_bodies = [body for body in range(1, source.nbody) if body not in bodies]
    joint_actuators = np.isin(source.actuator_trntype, [mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT])
    # A servo takes the place of the actuators of a joint.
    driven = {character.joint(joint).name for joint in character.actuator_trnid[:, 0]}
    actuators = [
        index
        for index in range(source.nu)
        if not joint_actuators[index] or _body_of(source, source.actuator_trnid[index, 0]) not in driven
    ]
    kept = np.isin(source.geom_bodyid, bodies) & ~np.isin(source.geom_type, _undrawn())
    parts = {
        "body": _names(source, mujoco.mjtObj.mjOBJ_BODY, other_bodies),
        "shape": _names(source, mujoco.mjtObj.mjOBJ_GEOM, np.flatnonzero(~kept).tolist()),
        "actuator": _names(source, mujoco.mjtObj.mjOBJ_ACTUATOR, actuators),
        **{name: _names(source, kind, range(getattr(source, count))) for name, (kind, count) in KINDS.items()},
    }
    return {kind: names for kind, names in parts.items() if names}


def _body_of(model: mujoco.MjModel, joint: int) -> str:
    body = int(model.jnt_bodyid[joint])
    return model.body(body).name or f"body_{body}"


def _undrawn() -> list[int]:
    """Shapes that a character cannot have."""
    geom = mujoco.mjtGeom
    return [int(kind) for kind in (geom.mjGEOM_PLANE, geom.mjGEOM_HFIELD, geom.mjGEOM_MESH, geom.mjGEOM_SDF)]


def _names(model: mujoco.MjModel, kind: mujoco.mjtObj, indices: Sequence[int]) -> list[str]:
    return [mujoco.mj_id2name(model, kind, index) or f"number {index}" for index in indices]
