"""Retargeting the motion of a human skeleton to any character by inverse kinematics."""

from collections.abc import Mapping
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.anatomy import ARM, LEG, SIDES, bones, limb
from torchrl_mcp.envs.motions.capture.feet import flat, from_straight, slope, stands
from torchrl_mcp.envs.motions.capture.joint_motion import JointMotion
from torchrl_mcp.envs.motions.capture.recording import Recording
from torchrl_mcp.envs.rotations import multiply, rotate

COSTS = {
    "root": (2.0, 2.0),
    "chest": (0.0, 1.0),
    "neck": (0.0, 0.3),
    "hip": (0.0, 0.0),
    "knee": (1.0, 0.0),
    "ankle": (20.0, 3.0),
    "shoulder": (0.0, 0.0),
    "elbow": (1.0, 0.0),
    "wrist": (1.0, 0.0),
}
"""Costs of each part's position, per metre, and orientation, per radian."""

ANKLES = ("right_ankle", "left_ankle")

POSTURE = 0.02
"""Cost per radian from the rest pose, for joints that no part determines."""

DAMPING = 1e-3
STEPS = 10
"""Most steps of the solver per frame; the first frame takes ten times as many."""

SETTLED = 1e-3
"""Length of a step in radians or metres after which a frame is solved."""


def solved(body: Recording, character: str, bodies: Mapping[str, str]) -> tuple[JointMotion, Tensor]:
    """Fit a character to a recorded motion, with joints within their limits.

    Feet follow the recorded ankles, scaled by the height of the hips: a foot that stands in the recording stands.
    Root, chest, head and feet turn as recorded, relative to standing; knees and arms follow the directions of the
    recorded bones. The task costs of :data:`COSTS` weigh what joints cannot reach at once.

    Args:
        body: The recording.
        character: Name of the character.
        bodies: Bodies by part, from :func:`~torchrl_mcp.envs.motions.capture.key_bodies.key_map`.

    Returns:
        The motion, and the greatest angle in radians by which a bone misses its direction in each frame, ``(T,)``.

    Raises:
        ImportError: If mink is not installed.
    """
    model = character_model(character)
    mink = _mink()
    positions, turns = _targets(body, model, bodies)
    tasks = {}
    for part in bodies:
        place, turn = COSTS[part.split("_")[-1]]
        if place or turn:
            tasks[part] = mink.FrameTask(bodies[part], "body", place, turn, lm_damping=1e-3)
    qpos = _solve(mink, model, tasks, {part: _poses(positions[part], turns[part]) for part in tasks})
    motion = {model.joint(index).name: _values(model, qpos, index) for index in range(1, model.njnt)}
    missed = _misses(model, qpos, positions, bodies)
    return JointMotion(qpos[:, :3], {"root": qpos[:, 3:7], **motion}, body.times), missed


def _mink() -> ModuleType:
    """Import mink.

    Raises:
        ImportError: If it is missing.
    """
    try:
        import daqp  # noqa: F401 - the solver
        import mink
    except ImportError as error:
        raise ImportError(
            f"retargeting to this character needs {error.name}: pip install 'torchrl-mcp[retargeting]'"
        ) from error
    return mink


def _targets(
    body: Recording, model: mujoco.MjModel, bodies: Mapping[str, str]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Positions ``(T, 3)`` and orientations ``(T, 4)`` of the bodies of parts."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rest = {part: torch.from_numpy(data.body(name).xpos.copy()) for part, name in bodies.items()}
    turned = {part: torch.from_numpy(data.body(name).xquat.copy()) for part, name in bodies.items()}
    positions = _legs(body, rest)
    positions |= _upper_body(body, rest, positions["root"])
    turns = {**body.turns} | {ankle: flat(body, ankle) for ankle in ANKLES}
    return positions, {part: multiply(turns[part], turned[part].expand_as(turns[part])) for part in bodies}


def _legs(body: Recording, rest: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Positions of root and legs, ``(T, 3)``, from positions in the rest pose, ``(3,)``."""
    middle = (rest["right_hip"] + rest["left_hip"]) / 2
    sole = (rest["right_ankle"][2] + rest["left_ankle"][2]) / 2
    scale = float(middle[2] - sole) / body.leg_length()
    floor = _floor(body)

    def scaled(positions: Tensor) -> Tensor:
        height = _height(body, positions) - floor
        return torch.cat([scale * positions[:, :2], scale * height.unsqueeze(-1) + sole], dim=-1)

    hips = scaled((body.positions["right_hip"] + body.positions["left_hip"]) / 2)
    targets = {"root": hips + _carried(body.turns["root"], rest["root"] - middle)}
    for side in SIDES:
        hip, knee, ankle = limb(side, LEG)
        targets[hip] = hips + _carried(body.turns["root"], rest[hip] - middle)
        targets[knee] = targets[hip] + _carried(from_straight(body, hip, knee), rest[knee] - rest[hip])
        targets[ankle] = scaled(body.positions[ankle])
    return targets


def _upper_body(body: Recording, rest: Mapping[str, Tensor], root: Tensor) -> dict[str, Tensor]:
    """Positions of chest, head and arms, ``(T, 3)``, as far as the character has them."""
    found: dict[str, Tensor] = {}
    trunk = "chest" if "chest" in rest else "root"
    chest = root + _carried(body.turns["root"], rest[trunk] - rest["root"])
    for part in rest.keys() & {"chest", "neck", "right_shoulder", "left_shoulder"}:
        found[part] = chest + _carried(body.turns["chest"], rest[part] - rest[trunk])
    for start, end in bones(ARM):
        if start in found and end in rest:
            found[end] = found[start] + (rest[end] - rest[start]).norm() * body.direction(start, end)
    return found


def _carried(turns: Tensor, arm: Tensor) -> Tensor:
    """A vector ``(3,)`` of the rest pose, turned, ``(T, 3)``."""
    return rotate(turns, arm.expand(len(turns), 3))


def _height(body: Recording, positions: Tensor) -> Tensor:
    """Height of positions ``(T, 3)`` above the slope of the laboratory, ``(T,)``."""
    return positions[:, 2] - positions[:, :2] @ slope(body)


def _floor(body: Recording) -> Tensor:
    """Height of standing ankles in metres, over the slope of the laboratory."""
    heights = []
    for ankle in ANKLES:
        height = _height(body, body.positions[ankle])
        standing = stands(body, ankle)
        heights.append(height[standing] if standing.any() else height.min().unsqueeze(0))
    return torch.cat(heights).median()


def _poses(positions: Tensor, turns: Tensor) -> np.ndarray:
    """Quaternion and position of each frame, as mink stores them, ``(T, 7)``."""
    return torch.cat([turns, positions], dim=-1).numpy()


def _solve(
    mink: ModuleType, model: mujoco.MjModel, tasks: Mapping[str, Any], poses: Mapping[str, np.ndarray]
) -> Tensor:
    """States that follow the poses, ``(T, nq)``."""
    configuration = mink.Configuration(model, model.qpos0)
    posture = mink.PostureTask(model, POSTURE)
    posture.set_target(model.qpos0)
    limits = [mink.ConfigurationLimit(model)]
    start = configuration.q.copy()
    start[:2] = poses["root"][0, 4:6]
    start[3:7] = poses["root"][0, :4]
    configuration.update(start)
    frames = len(poses["root"])
    qpos = np.empty((frames, model.nq))
    for frame in range(frames):
        for part, task in tasks.items():
            task.set_target(mink.SE3(poses[part][frame]))
        for _ in range(STEPS if frame else 10 * STEPS):
            velocity = mink.solve_ik(
                configuration, [*tasks.values(), posture], 1.0, "daqp", damping=DAMPING, limits=limits
            )
            configuration.integrate_inplace(velocity, 1.0)
            if abs(velocity).max() < SETTLED:
                break
        qpos[frame] = configuration.q
    return torch.from_numpy(qpos)


def _values(model: mujoco.MjModel, qpos: Tensor, joint: int) -> Tensor:
    """Angles ``(T,)`` or quaternions ``(T, 4)`` of a joint."""
    place = model.jnt_qposadr[joint]
    ball = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL
    return qpos[:, place : place + 4] if ball else qpos[:, place]


def _misses(model: mujoco.MjModel, qpos: Tensor, targets: Mapping[str, Tensor], bodies: Mapping[str, str]) -> Tensor:
    """Greatest angle in radians between the bones of a state and of its targets, ``(T,)``."""
    ids = {part: model.body(name).id for part, name in bodies.items()}
    data = mujoco.MjData(model)
    reached = np.empty((len(qpos), model.nbody, 3))
    for frame, data.qpos in enumerate(qpos.numpy()):
        mujoco.mj_kinematics(model, data)
        reached[frame] = data.xpos
    worst = torch.zeros(len(qpos), dtype=torch.float64)
    for start, end in [pair for joints in (LEG, ARM) for pair in bones(joints)]:
        if start in bodies and end in bodies:
            bone = torch.from_numpy(reached[:, ids[end]] - reached[:, ids[start]])
            wanted = targets[end] - targets[start]
            cosine = (normalize(bone, dim=-1) * normalize(wanted, dim=-1)).sum(-1)
            worst = torch.maximum(worst, cosine.clamp(-1, 1).acos())
    return worst
