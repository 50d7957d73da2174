"""Converting bodies that were made for other purposes into characters."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from torchrl_mcp.envs.characters.contract import (
    BALL,
    FREE,
    HINGE,
    colliding,
    guessed_feet,
    joints_of,
    kinds_of,
    line_of,
    lowest_bodies,
)
from torchrl_mcp.envs.characters.drives import (
    PASSIVE,
    TIMESTEP,
    Drive,
    drive,
    driven_joints,
    load,
    matched,
    passive_drive,
)
from torchrl_mcp.envs.characters.mirror import Sides, guessed_sides
from torchrl_mcp.envs.characters.omissions import omissions
from torchrl_mcp.envs.characters.pose import FREE_RANGE, Pose

BEYOND = 1.2
"""Factor on the limits of a joint that defines the range of its targets."""

PLANE = mujoco.mjtGeom.mjGEOM_PLANE

LEAST_INERTIA = 1e-10
"""Moment of inertia in kg m^2 below which MuJoCo writes 0."""

KINDS = {
    mujoco.mjtGeom.mjGEOM_SPHERE: mujoco.mjtGeom.mjGEOM_SPHERE,
    mujoco.mjtGeom.mjGEOM_CAPSULE: mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_BOX: mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER: mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: mujoco.mjtGeom.mjGEOM_BOX,
}
"""The shape that replaces each shape."""


class Adapted(NamedTuple):
    """A body that was made a character.

    Args:
        spec: The body.
        root: Name of its root.
        feet: Bodies that may touch the ground.
        sides: Beginnings or ends of bodies' names, right and left.
        drives: Drive of the joint of each body, by name.
        ranges: Range of each of these joints in radians; of a ball joint its greatest angle.
        left_out: Names of the parts of the file that are left out, by kind.
    """

    spec: mujoco.MjSpec
    root: str
    feet: tuple[str, ...]
    sides: Sides
    drives: Mapping[str, Drive]
    ranges: Mapping[str, tuple[float, float]]
    left_out: Mapping[str, Sequence[str]]


def adapted(
    model: mujoco.MjModel,
    *,
    root: str | None = None,
    pose: Sequence[str] = (),
    feet: Sequence[str] | None = None,
    sides: Sides | None = None,
    torques: Mapping[str, float] | None = None,
    gains: Mapping[str, float] | None = None,
) -> Adapted:
    """Make a body a :class:`~torchrl_mcp.envs.characters.Character`, as far as possible.

    Floor, lights, cameras, tendons, equality constraints and sensors are left out, and shapes that do not collide if
    they are meshes; cylinders become capsules and ellipsoids boxes. Several hinges of a body become a ball joint, whose
    targets have the ranges of the hinges about each axis. Each joint gets a position servo, see
    :func:`~torchrl_mcp.envs.characters.drives.drive`; if the file has actuators, a joint on which none of them acts
    stays passive, unless ``torques`` names it. The body is put on the ground. Masses, inertias, gravity
    compensation, ranges of hinges, and damping, stiffness and friction loss of joints stay the same.

    Args:
        model: The body in its scene, compiled.
        root: Body that carries all others, or None for the one with the most bodies. It gets a free joint if it has
            no joint.
        pose: Rest pose, see :meth:`~torchrl_mcp.envs.characters.pose.Pose.read`; empty for that of the file.
        feet: Bodies that may touch the ground, or None for those of
            :func:`~torchrl_mcp.envs.characters.contract.guessed_feet`.
        sides: Beginnings or ends of bodies' names, right and left, or None for the usual ones that occur.
        torques: Limits of torques in N m, by regular expressions that are found in names of joints or bodies.
        gains: Gains in N m/rad, likewise.

    Raises:
        ValueError: If an argument names what is not there, the body has a slide joint or a colliding mesh, or the rest
            pose is beyond the limits of a joint or not on feet.
    """
    trunk = _root(model, root)
    names = {
        body: model.body(body).name or f"body_{body}" for body in range(1, model.nbody) if trunk in line_of(model, body)
    }
    _require_convertible(model, names)
    rest = Pose.read(model, pose, list(names))
    spec = _standing(model, names, rest)
    sides = guessed_sides(names.values()) if sides is None else sides
    soles = _feet(feet, spec.compile(), sides, names)
    jointed = {body: name for body, name in names.items() if body != trunk and joints_of(model, body)}
    drives = _drives(spec.compile(), model, jointed, soles, rest, torques or {}, gains or {})
    for body, name in jointed.items():
        joint = spec.joint(name)
        drive = drives[name]
        joint.damping[0] = drive.passive
        joint.stiffness[0] = drive.spring
        joint.armature = drive.armature
        joint.frictionloss = drive.friction
        if drive.torque_from != PASSIVE:
            _add_servos(spec, name, drive, _ranges(model, body, rest))
    return Adapted(
        spec,
        names[trunk],
        soles,
        sides,
        drives,
        {name: (spec.joint(name).range[0], spec.joint(name).range[1]) for name in drives},
        omissions(spec.compile(), model, list(names)),
    )


def _standing(model: mujoco.MjModel, names: Mapping[int, str], rest: Pose) -> mujoco.MjSpec:
    """Build the body in its rest pose on the ground, without servos."""
    spec = mujoco.MjSpec()
    trunk = next(iter(names))
    spec.compiler.degree = False
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    bodies = {model.body_parentid[trunk]: spec.worldbody}
    for body, name in names.items():
        place, turn = rest.relative(body, trunk)
        bodies[body] = bodies[model.body_parentid[body]].add_body(
            name=name,
            pos=place,
            quat=turn,
            explicitinertial=True,
            mass=model.body_mass[body],
            ipos=model.body_ipos[body],
            iquat=model.body_iquat[body],
            inertia=_possible(model.body_inertia[body]),
            gravcomp=model.body_gravcomp[body],
        )
        _add_joint(bodies[body], name, model, body, rest)
        _add_shapes(bodies[body], model, body)
    bodies[trunk].pos = bodies[trunk].pos - [0.0, 0.0, lowest_bodies(spec.compile())[0]]
    return spec


def _drives(
    posed: mujoco.MjModel,
    model: mujoco.MjModel,
    jointed: Mapping[int, str],
    feet: Sequence[str],
    rest: Pose,
    torques: Mapping[str, float],
    gains: Mapping[str, float],
) -> dict[str, Drive]:
    """Choose the drive of each joint of a body that stands in its rest pose."""
    known = {
        body: (*(model.joint(joint).name for joint in joints_of(model, body)), name) for body, name in jointed.items()
    }
    torque = matched(torques, known, "--torque")
    gain = matched(gains, known, "--gain")
    soles = [posed.body(foot).id for foot in feet]
    driven = driven_joints(model, rest.data.qpos)
    drives = {}
    for body, name in jointed.items():
        undriven = [model.joint(joint).name for joint in joints_of(model, body) if joint not in driven]
        if body not in torque and len(undriven) == len(joints_of(model, body)):
            remark = "--gain does not count without --torque" if body in gain else ""
            drives[name] = passive_drive(model, body).with_remark(remark)
            continue
        needed = load(posed, posed.body(name).id, soles)
        remark = f"drives {', '.join(undriven)} too, without a motor in the file" if undriven else ""
        drives[name] = drive(model, body, needed, torque.get(body), gain.get(body)).with_remark(remark)
    return drives


def key_bodies(model: mujoco.MjModel) -> list[str]:
    """Return the bodies at the ends of the limbs, whose positions best describe a pose."""
    parents = set(model.body_parentid.tolist())
    return [model.body(body).name for body in range(2, model.nbody) if body not in parents]


def _roots(model: mujoco.MjModel) -> list[int]:
    """Bodies that hang on the world."""
    return (np.flatnonzero(model.body_parentid[1:] == 0) + 1).tolist()


def _root(model: mujoco.MjModel, name: str | None) -> int:
    """Find the root: the body of a name, or the one on the world that carries the most bodies."""
    every = [model.body(body).name for body in range(1, model.nbody)]
    if not every:
        raise ValueError("the file has no body: pass the file of a robot")
    if name is not None and name not in every:
        raise ValueError(f"the file has no body {name} for the root: pass one of {', '.join(filter(None, every))}")
    if name is not None:
        return every.index(name) + 1
    return int(np.bincount(model.body_rootid[1:]).argmax())


def _require_convertible(model: mujoco.MjModel, names: Mapping[int, str]) -> None:
    trunk, *others = names
    hanging = [body for body in _roots(model) if kinds_of(model, body) not in ([], [FREE])]
    if trunk in hanging and (len(hanging) > 1 or any(model.geom_type[model.geom_bodyid == 0] != PLANE)):
        raise ValueError(
            f"{', '.join(model.body(body).name for body in hanging)} are attached to the world by joints, because the "
            "trunk of the file is fixed and part of the world: pass --floating, or let a joint of type floating "
            "connect a link called world with the base of the URDF"
        )
    if trunk in hanging:
        raise ValueError(
            f"the root {names[trunk]} has joints other than a free joint: replace them by a freejoint, or pass "
            "--floating if its trunk is fixed to the world"
        )
    for body in others:
        kinds = kinds_of(model, body)
        if any(kind not in (BALL, HINGE) for kind in kinds) or (BALL in kinds and len(kinds) > 1):
            raise ValueError(f"{names[body]} has a joint that is neither hinge nor ball: replace or weld it")
    for geom in _touching(model):
        kind = mujoco.mjtGeom(model.geom_type[geom])
        if kind not in KINDS and model.geom_bodyid[geom] in names:
            shape = model.geom(geom).name or "a shape without a name"
            owner = names[model.geom_bodyid[geom]]
            raise ValueError(f"{shape} of the body {owner} is a {kind.name} that collides: draw capsules or boxes")


def _touching(model: mujoco.MjModel) -> set[int]:
    """Return the shapes of moving bodies that collide, in general or in a named pair with a shape of the world."""
    pairs = np.stack([model.pair_geom1, model.pair_geom2], axis=1)
    moves = model.geom_bodyid[pairs] > 0
    return {*colliding(model), *pairs[moves & ~moves[:, ::-1]].tolist()}


def _possible(inertia: np.ndarray) -> np.ndarray:
    """Principal moments that stay possible when a file rounds them: none exceeds the sum of the others."""
    smallest, middle, largest = inertia.argsort()
    inertia = np.maximum(inertia, LEAST_INERTIA)
    inertia[smallest] = max(inertia[smallest], 1.0001 * inertia[largest] - inertia[middle])
    return inertia


def _feet(
    given: Sequence[str] | None, posed: mujoco.MjModel, sides: Sides, names: Mapping[int, str]
) -> tuple[str, ...]:
    every = list(names.values())
    if given is not None:
        if unknown := [name for name in given if name not in every]:
            raise ValueError(f"the file has no body {', '.join(unknown)} for the feet: pass some of {', '.join(every)}")
        return tuple(given)
    if every[0] in lowest_bodies(posed)[1]:
        raise ValueError(
            f"{every[0]}, the root, is lowest in the rest pose: choose one that stands on feet, such as --pose "
            "KEYFRAME or --pose knee=-1.2, or name the feet (--feet)"
        )
    return tuple(guessed_feet(posed, sides))


def _add_joint(target: mujoco.MjsBody, name: str, model: mujoco.MjModel, body: int, rest: Pose) -> None:
    """Add a body's joint."""
    joints = joints_of(model, body)
    kinds = kinds_of(model, body)
    if not joints or kinds == [FREE]:
        if target.parent.name == "world":
            target.add_freejoint(name=name)
        return
    joint = target.add_joint(name=name, pos=model.jnt_pos[joints].mean(0), limited=True)
    targets = _ranges(model, body, rest)
    if kinds == [HINGE]:
        joint.axis = model.jnt_axis[joints[0]]
        joint.range = targets[0]
        joint.ref = rest.angle(joints[0])
        joint.springref = model.qpos_spring[model.jnt_qposadr[joints[0]]]
        return
    joint.type = mujoco.mjtJoint.mjJNT_BALL
    joint.range = [0.0, min(float(np.linalg.norm(abs(targets).max(1))), 3.1)]


def _ranges(model: mujoco.MjModel, body: int, rest: Pose) -> np.ndarray:
    """Range of a hinge, ``(1, 2)``, or of rotation about x, y and z, to first order, ``(3, 2)``, in radians."""
    joints = joints_of(model, body)
    kinds = kinds_of(model, body)
    if kinds == [HINGE]:
        return np.array([rest.range(joints[0])])
    if kinds == [BALL]:
        largest = model.jnt_range[joints[0], 1] if model.jnt_limited[joints[0]] else FREE_RANGE
        return np.tile([-largest, largest], (3, 1))
    ranges = np.zeros((3, 2))
    for hinge in joints:
        ends = np.outer(model.jnt_axis[hinge], np.subtract(rest.range(hinge), rest.angle(hinge)))
        ranges += np.sort(ends, axis=1)
    narrow = ranges[:, 1] - ranges[:, 0] < 0.2  # a small range about axes without a hinge
    ranges[narrow] = [-0.1, 0.1]
    return ranges


def _add_servos(spec: mujoco.MjSpec, name: str, chosen: Drive, ranges: np.ndarray) -> None:
    """Add the servo of a hinge, or the three of a ball joint."""
    suffixes = [""] if len(ranges) == 1 else ["_x", "_y", "_z"]
    for suffix, gear, limit, (low, high) in zip(suffixes, np.eye(6), chosen.limits, ranges, strict=False):
        middle, half = (low + high) / 2, BEYOND * (high - low) / 2
        actuator = spec.add_actuator(
            name=name + suffix,
            target=name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gear=gear,
            ctrllimited=True,
            ctrlrange=[middle - half, middle + half],
            forcelimited=True,
            forcerange=[-limit, limit],
        )
        actuator.set_to_position(kp=chosen.gain, kv=chosen.damping)


def _add_shapes(target: mujoco.MjsBody, model: mujoco.MjModel, body: int) -> None:
    """Add a body's shapes; decorative shapes of other kinds are left out."""
    touching = _touching(model)
    for geom in np.flatnonzero(model.geom_bodyid == body):
        kind = mujoco.mjtGeom(model.geom_type[geom])
        size = model.geom_size[geom].copy()
        if kind not in KINDS:
            continue
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            size[1] = max(size[1] - size[0], 0.001)
        collides = geom in touching
        target.add_geom(
            name=model.geom(geom).name,
            type=KINDS[kind],
            size=size,
            pos=model.geom_pos[geom],
            quat=model.geom_quat[geom],
            rgba=[*model.geom_rgba[geom, :3], 1.0 if collides else model.geom_rgba[geom, 3]],
            friction=model.geom_friction[geom],
            contype=0,
            conaffinity=int(collides),
        )
