"""Converting bodies that were made for other purposes into characters."""

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from torchrl_mcp.envs.characters.contract import BALL, FREE, HINGE, colliding, joints_of, kinds_of, lowest_bodies

TIMESTEP = 1 / 120
"""Seconds of a physics step."""

LIMIT_ANGLE = 0.4
"""Distance in radians from its target at which a joint's torque reaches its limit, as at the biped's hip."""

BEYOND = 1.2
"""Factor on the limits of a joint that defines the range of its targets."""

DEFAULT_RANGE = (-1.57, 1.57)
"""Range in radians of a joint without limits."""

KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_BOX: mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER: mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: mujoco.mjtGeom.mjGEOM_BOX,
}
"""The shape that replaces each shape."""


class Gains(NamedTuple):
    """Parameters of a joint's drive.

    Args:
        torque: Limit of the torque, in N m.
        stiffness: Stiffness in N m/rad.
        damping: Damping in N m s/rad: three quarters in the actuator, a quarter in the joint.
        armature: Armature in kg m^2, so that a light limb does not chatter between the limits of the torque.
    """

    torque: float
    stiffness: float
    damping: float
    armature: float


def adapted(model: mujoco.MjModel) -> mujoco.MjSpec:
    """Return a body that meets the contract of a :class:`~torchrl_mcp.envs.characters.Character`, as far as possible.

    Floor, lights, cameras, tendons and sensors are left out; cylinders become capsules and ellipsoids boxes. Several
    hinges of a body become a ball joint, whose targets have the ranges of the hinges about each axis. Motors become
    position servos with the same torque limits; the limit of a joint without a motor comes from the masses that it
    moves. The body is put on the ground. Masses and inertias stay the same.

    Args:
        model: The body in its scene, compiled.

    Raises:
        ValueError: If the body has not one root with a free joint, or has a slide joint or a colliding mesh.
    """
    _require_convertible(model)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    spec.option.timestep, spec.option.integrator = TIMESTEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    bodies = {0: spec.worldbody}
    for body in range(1, model.nbody):
        name = model.body(body).name or f"body_{body}"
        bodies[body] = bodies[model.body_parentid[body]].add_body(
            name=name,
            pos=model.body_pos[body],
            quat=model.body_quat[body],
            explicitinertial=True,
            mass=model.body_mass[body],
            ipos=model.body_ipos[body],
            iquat=model.body_iquat[body],
            inertia=model.body_inertia[body],
        )
        _add_joint(spec, bodies[body], name, model, body)
        _add_shapes(bodies[body], model, body)
    lowest, _ = lowest_bodies(spec.compile())
    spec.bodies[1].pos = spec.bodies[1].pos - [0.0, 0.0, lowest]
    return spec


def key_bodies(model: mujoco.MjModel) -> list[str]:
    """Return the bodies at the ends of the limbs, whose positions best describe a pose."""
    parents = set(model.body_parentid.tolist())
    return [model.body(body).name for body in range(2, model.nbody) if body not in parents]


def _require_convertible(model: mujoco.MjModel) -> None:
    roots = np.flatnonzero(model.body_parentid[1:] == 0) + 1
    if len(roots) != 1 or kinds_of(model, int(roots[0])) != [FREE]:
        raise ValueError("a character has one root with a free joint and nothing else: give the root a freejoint")
    for body in range(2, model.nbody):
        kinds = kinds_of(model, body)
        if any(kind not in (BALL, HINGE) for kind in kinds) or (BALL in kinds and len(kinds) > 1):
            raise ValueError(f"{model.body(body).name} has a joint that is neither hinge nor ball: replace or weld it")
    for geom in colliding(model):
        kind = mujoco.mjtGeom(model.geom_type[geom])
        if kind not in KINDS:
            raise ValueError(f"{model.geom(geom).name or geom} is a {kind.name} that collides: draw capsules or boxes")


def _add_joint(spec: mujoco.MjSpec, target: mujoco.MjsBody, name: str, model: mujoco.MjModel, body: int) -> None:
    """Add a body's joint and its actuators."""
    joints, kinds = joints_of(model, body), kinds_of(model, body)
    if kinds == [FREE]:
        target.add_freejoint(name=name)
        return
    if not kinds:
        return
    gains, place = _gains(model, body), model.jnt_pos[joints].mean(0)
    shared = {"name": name, "pos": place, "armature": gains.armature, "damping": [gains.damping / 4, 0, 0]}
    if kinds == [HINGE]:
        low, high = _range(model, joints[0])
        middle, half = (low + high) / 2, BEYOND * (high - low) / 2
        target.add_joint(**shared, axis=model.jnt_axis[joints[0]], range=[low, high], limited=True)
        _add_servo(spec, name, name, gains, (middle - half, middle + half))
        return
    ranges = _ball_ranges(model, joints) if HINGE in kinds else np.tile([-1, 1], (3, 1)) * _range(model, joints[0])[1]
    largest = min(float(np.linalg.norm(abs(ranges).max(1))), 3.1)
    target.add_joint(**shared, type=mujoco.mjtJoint.mjJNT_BALL, range=[0.0, largest], limited=True)
    for axis, (low, high) in enumerate(ranges):
        middle, half = (low + high) / 2, BEYOND * (high - low) / 2
        gear = np.eye(6)[axis]
        _add_servo(spec, f"{name}_{'xyz'[axis]}", name, gains, (middle - half, middle + half), gear=gear)


def _add_servo(
    spec: mujoco.MjSpec, name: str, joint: str, gains: Gains, targets: tuple[float, float], **kwargs: Sequence[float]
) -> None:
    actuator = spec.add_actuator(
        name=name,
        target=joint,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        ctrllimited=True,
        ctrlrange=targets,
        forcelimited=True,
        forcerange=[-gains.torque, gains.torque],
        **kwargs,
    )
    actuator.set_to_position(kp=gains.stiffness, kv=0.75 * gains.damping)


def _add_shapes(target: mujoco.MjsBody, model: mujoco.MjModel, body: int) -> None:
    """Add a body's shapes; decorative shapes of other kinds are left out."""
    for geom in np.flatnonzero(model.geom_bodyid == body):
        kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom].copy()
        if kind not in KINDS:
            continue
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            size[1] = max(size[1] - size[0], 0.001)
        collides = bool(model.geom_contype[geom] | model.geom_conaffinity[geom])
        target.add_geom(
            name=model.geom(geom).name,
            type=KINDS[kind],
            size=size,
            pos=model.geom_pos[geom],
            quat=model.geom_quat[geom],
            rgba=model.geom_rgba[geom],
            friction=model.geom_friction[geom],
            contype=0,
            conaffinity=int(collides),
        )


def _range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Limits of a joint in radians, widened to contain the rest pose."""
    low, high = model.jnt_range[joint] if model.jnt_limited[joint] else DEFAULT_RANGE
    return min(float(low), 0.0), max(float(high), 0.0)


def _ball_ranges(model: mujoco.MjModel, hinges: Sequence[int]) -> np.ndarray:
    """Ranges of rotation about x, y and z for several hinges, to first order, ``(3, 2)`` in radians."""
    ranges = np.zeros((3, 2))
    for hinge in hinges:
        ends = np.outer(model.jnt_axis[hinge], _range(model, hinge))
        ranges += np.sort(ends, axis=1)
    narrow = ranges[:, 1] - ranges[:, 0] < 0.2  # a small range about axes without a hinge
    ranges[narrow] = [-0.1, 0.1]
    return ranges


def _gains(model: mujoco.MjModel, body: int) -> Gains:
    """Parameters of the drive of a body's joint."""
    torque = max((_motor_torque(model, joint) for joint in joints_of(model, body)), default=0.0)
    torque = torque or _torque_of_masses(model, body)
    stiffness = torque / LIMIT_ANGLE
    damping = stiffness / 10
    return Gains(torque, stiffness, damping, armature=TIMESTEP * damping / 8)


def _motor_torque(model: mujoco.MjModel, joint: int) -> float:
    """Largest torque of the actuators of a joint, in N m, 0 if unknown."""
    torque = 0.0
    for index in np.flatnonzero((model.actuator_trnid[:, 0] == joint) & (model.actuator_trntype == 0)):
        force = abs(model.actuator_forcerange[index]).max() if model.actuator_forcelimited[index] else 0.0
        if not force and model.actuator_ctrllimited[index] and model.actuator_biastype[index] == 0:
            force = abs(model.actuator_ctrlrange[index]).max() * model.actuator_gainprm[index, 0]
        torque = max(torque, float(force * abs(model.actuator_gear[index]).max()))
    return torque


def _torque_of_masses(model: mujoco.MjModel, body: int) -> float:
    """Three times the torque that holds the lighter side of a joint level, in N m."""
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    mass, total = model.body_subtreemass[body], model.body_subtreemass[1]
    beyond = data.subtree_com[body]
    behind = (total * data.subtree_com[1] - mass * beyond) / max(total - mass, 1e-9)
    lighter, weight = (beyond, mass) if mass < total - mass else (behind, total - mass)
    lever = float(np.linalg.norm(lighter - data.xanchor[joints_of(model, body)[0]]))
    return max(3 * 9.81 * float(weight) * lever, 1.0)
