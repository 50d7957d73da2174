"""Torques and gains of a body's joints: those of its file, those given, and guesses for the rest."""

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from torchrl_mcp.envs.characters.contract import joints_of, line_of
from torchrl_mcp.envs.characters.pose import FREE_RANGE

TIMESTEP = 1 / 120
"""Seconds of a physics step."""

LIMIT_ANGLE = 0.4
"""Distance in radians from its target at which a joint's torque reaches its limit, as at the biped's hip."""

HOLDING = 3.0
"""Guessed torque of a joint that carries no weight, in torques that hold its lighter side level."""

STEADY = 2.0
"""Guessed gain of a leg's joint, in gains at which gravity just topples what it carries."""

LEAST = 0.005
"""Least guessed torque, in weights of the body times the height of its root."""

LEAST_APART = 1e-3
"""Distance in metres of a hinge's anchor from the mean of its body's above which it is told of."""

FILE, GIVEN, GUESSED, PASSIVE = "file", "given", "guessed", "passive"


class Drive(NamedTuple):
    """Drive of a body's joint.

    Args:
        torque: Limit of the torque, in N m; of several hinges the largest.
        torque_from: ``"file"``, ``"given"``, ``"guessed"``, or ``"passive"`` for a joint without a motor.
        limits: Limits of the torques about x, y and z; of a single hinge they are the same.
        gain: Stiffness kp of the servo, in N m/rad.
        gain_from: As ``torque_from``.
        damping: Damping kv of the servo, in N m s/rad.
        passive: Damping of the joint, in N m s/rad.
        armature: Armature in kg m^2.
        friction: Friction loss in N m.
        spring: Stiffness of the joint, in N m/rad.
        remark: What was changed.
    """

    torque: float
    torque_from: str
    limits: tuple[float, ...]
    gain: float
    gain_from: str
    damping: float
    passive: float
    armature: float
    friction: float
    spring: float
    remark: str

    def with_remark(self, remark: str) -> "Drive":
        """Add a remark, unless it is empty."""
        return self._replace(remark=", ".join(filter(None, [self.remark, remark])))


class Motor(NamedTuple):
    """What a file says about the motors of a joint; 0 where it says nothing.

    Args:
        torque: Limit of the torque, in N m.
        gain: Stiffness of a servo, in N m/rad.
        damping: Damping of a servo, in N m s/rad.
    """

    torque: float
    gain: float
    damping: float


def motor(model: mujoco.MjModel, joint: int) -> Motor:
    """Read the motors of a joint.

    The torque is limited by the ``forcerange`` of an actuator, the ``ctrlrange`` of a motor, and the
    ``actuatorfrcrange`` of the joint: the smallest counts.
    """
    torque = 0.0
    gain = 0.0
    damping = 0.0
    kinds = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
    for index in np.flatnonzero((model.actuator_trnid[:, 0] == joint) & np.isin(model.actuator_trntype, kinds)):
        gear, strength, (_, kp, kv) = (
            float(abs(model.actuator_gear[index]).max()),
            float(model.actuator_gainprm[index, 0]),
            model.actuator_biasprm[index, :3].tolist(),
        )
        if kp == -strength < 0:
            gain = max(gain, strength * gear**2)
            damping = max(damping, -kv * gear**2)
        forces = []
        if model.actuator_forcelimited[index]:
            forces.append(float(abs(model.actuator_forcerange[index]).max()))
        if model.actuator_ctrllimited[index] and model.actuator_biastype[index] == mujoco.mjtBias.mjBIAS_NONE:
            forces.append(float(abs(model.actuator_ctrlrange[index]).max()) * abs(strength))
        torque = max(torque, min(forces, default=0.0) * gear)
    if model.jnt_actfrclimited[joint]:
        limit = float(abs(model.jnt_actfrcrange[joint]).max())
        torque = min(torque, limit) if torque else limit
    return Motor(torque, gain, damping)


def driven_joints(model: mujoco.MjModel, qpos: np.ndarray) -> set[int]:
    """Return the joints on which actuators act, directly or through tendons; all joints if there is no actuator.

    Args:
        model: The body.
        qpos: The rest pose, shape ``(nq,)``.
    """
    if not model.nu:
        return set(range(model.njnt))
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_fwdPosition(model, data)
    moments = np.zeros((model.nu, model.nv))
    mujoco.mju_sparse2dense(moments, data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    adheres = model.actuator_trntype == mujoco.mjtTrn.mjTRN_BODY
    return set(model.dof_jntid[moments[~adheres].any(0)].tolist())


def passive_drive(model: mujoco.MjModel, body: int) -> Drive:
    """Return the drive of a joint without a motor: damping, armature, friction and spring of its file.

    Args:
        model: The body as its file describes it.
        body: The body that the joint moves.
    """
    joints = joints_of(model, body)
    dofs = np.flatnonzero(np.isin(model.dof_jntid, joints))
    armature = float(model.dof_armature[dofs].max())
    return Drive(
        torque=0.0,
        torque_from=PASSIVE,
        limits=(),
        gain=0.0,
        gain_from=PASSIVE,
        damping=0.0,
        passive=float(model.dof_damping[dofs].max()),
        armature=armature,
        friction=float(model.dof_frictionloss[dofs].max()),
        spring=float(model.jnt_stiffness[joints].max()),
        remark=", ".join(_remarks(model, joints, [0.0], armature, armature)),
    )


class Load(NamedTuple):
    """What a joint has to carry in the rest pose.

    Args:
        torque: Guess of the torque that it needs, in N m.
        gain: Least gain with which it is steady, in N m/rad.
    """

    torque: float
    gain: float


def load(model: mujoco.MjModel, body: int, feet: Sequence[int]) -> Load:
    r"""Estimate the load of a body's joint.

    A leg, which ends in some of the feet, carries its share of the weight above it, with half of the feet on the
    ground, at the distance of its sole's furthest point; and gravity topples that weight about it at a gain of
    :math:`m g h` over the number of feet, where :math:`h` is the height of its centre above the joint. Any other joint
    holds what hangs on its lighter side, three times over.

    Args:
        model: The body in its rest pose.
        body: The body that the joint moves.
        feet: Bodies of the feet.
    """
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    gravity = 9.81
    total = float(model.body_subtreemass[1])
    mass = float(model.body_subtreemass[body])
    least = LEAST * gravity * total * float(data.xpos[1, 2])
    anchor = data.xanchor[joints_of(model, body)[0]]
    beyond = data.subtree_com[body]
    rest = max(total - mass, 1e-9)
    behind = (total * data.subtree_com[1] - mass * beyond) / rest
    below = [foot for foot in feet if body in line_of(model, foot)]
    if not below or len(below) == len(feet):
        centre, weight = (beyond, mass) if mass < rest else (behind, rest)
        return Load(max(HOLDING * gravity * weight * float(np.linalg.norm(centre - anchor)), least), 0.0)
    lever = max(_reach(model, data, foot, anchor) for foot in below)
    weight = gravity * rest
    topples = weight * max(float(behind[2] - anchor[2]), 0.0) / len(feet)
    return Load(max(weight / max(len(feet) // 2, 1) * lever, least), STEADY * topples)


def drive(model: mujoco.MjModel, body: int, needed: Load, torque: float | None, gain: float | None) -> Drive:
    """Choose the drive of a body's joint.

    Damping that the file lacks is critical for a joint of ``gain / 400`` kg m^2, as in the library's characters:
    a tenth of the gain, three quarters of it in the servo. Each hinge of several keeps its torque about its axis; about
    an axis without a hinge the limit is the smallest. The armature is raised where a light limb would chatter
    between the limits of its torque, or its servo would be unstable at the physics step.

    Args:
        model: The body as its file describes it.
        body: The body that the joint moves.
        needed: Its load.
        torque: Limit of the torque in N m that the user gives, or None.
        gain: Gain in N m/rad that the user gives, or None.
    """
    joints = joints_of(model, body)
    dofs = [dof for joint in joints for dof in np.flatnonzero(model.dof_jntid == joint)]
    motors = [motor(model, joint) for joint in joints]
    strongest = Motor(*np.max(motors, axis=0).tolist())
    limit, limit_from = _chosen(torque, strongest.torque, needed.torque)
    torques = [one.torque for one in motors]
    limits = _about_axes(model.jnt_axis[joints], torques) if limit_from == FILE and all(torques) else [limit] * 3
    kp, kp_from = _chosen(gain, strongest.gain, max(limit / LIMIT_ANGLE, needed.gain))
    passive = float(model.dof_damping[dofs].max())
    damping = strongest.damping if kp_from == FILE and (strongest.damping or passive) else 0.075 * kp
    passive = passive or (0.0 if strongest.damping and kp_from == FILE else 0.025 * kp)
    armature = float(model.dof_armature[dofs].max())
    steady = max(TIMESTEP * (damping / 2 - passive), TIMESTEP**2 * kp / 4, armature)
    return Drive(
        limit,
        limit_from,
        tuple(limits),
        kp,
        kp_from,
        damping,
        passive,
        steady,
        friction=float(model.dof_frictionloss[dofs].max()),
        spring=float(model.jnt_stiffness[joints].max()),
        remark=", ".join(_remarks(model, joints, limits, armature, steady)),
    )


def _about_axes(axes: np.ndarray, torques: Sequence[float]) -> list[float]:
    """Return torques in N m about x, y and z, of hinges with axes ``(N, 3)``: the smallest where there is none."""
    parts = (abs(axes) * np.asarray(torques)[:, None]).max(0)
    return np.maximum(parts, min(torques)).tolist()


def _remarks(
    model: mujoco.MjModel, joints: Sequence[int], limits: Sequence[float], armature: float, steady: float
) -> Iterator[str]:
    anchors = model.jnt_pos[joints]
    if not model.jnt_limited[joints].all():
        yield f"no limits in the file: {FREE_RANGE:g} rad to either side"
    if len(anchors) > 1:
        yield f"a ball for {len(anchors)} hinges"
        if (apart := float(np.linalg.norm(anchors - anchors.mean(0), axis=1).max())) > LEAST_APART:
            yield f"whose anchors are one, up to {100 * apart:.2g} cm away"
        if min(limits) < max(limits):
            yield f"torques {', '.join(f'{limit:.3g}' for limit in limits)} about x, y, z"
    if 0 < armature < steady:
        yield f"armature {armature:.3g} raised"


def matched(patterns: Mapping[str, float], names: Mapping[int, Sequence[str]], option: str) -> dict[int, float]:
    """Return the value for each body of which a pattern is found in a name; a later pattern wins.

    Args:
        patterns: Values by regular expression.
        names: Names of each body and of its joints.
        option: Name of the option, for errors.

    Raises:
        ValueError: If a pattern is found in no name.
    """
    found: dict[int, float] = {}
    for pattern, value in patterns.items():
        bodies = [body for body, known in names.items() if any(re.search(pattern, name) for name in known)]
        if not bodies:
            every = ", ".join(known[-1] for known in names.values())
            raise ValueError(f"{option} {pattern}={value:g} matches no joint: they are {every}")
        found |= dict.fromkeys(bodies, value)
    return found


def _chosen(given: float | None, own: float, guess: float) -> tuple[float, str]:
    if given is not None:
        return given, GIVEN
    return (own, FILE) if own else (guess, GUESSED)


def _reach(model: mujoco.MjModel, data: mujoco.MjData, foot: int, anchor: np.ndarray) -> float:
    """Distance in metres from a joint to the furthest point of a foot's shapes near the ground."""
    corners = []
    for geom in np.flatnonzero((model.geom_bodyid == foot) & ((model.geom_contype | model.geom_conaffinity) != 0)):
        signs = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
        local = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
        corners.append(data.geom_xpos[geom] + local @ data.geom_xmat[geom].reshape(3, 3).T)
    points = np.concatenate(corners) if corners else data.xpos[foot][None]
    sole = points[points[:, 2] < points[:, 2].min() + 0.03]
    return float(np.linalg.norm(sole - anchor, axis=1).max())
