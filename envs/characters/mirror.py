"""The two sides of a body, and mirror images of observations and actions, with left and right exchanged."""

import math
from collections.abc import Iterable, Iterator, Sequence

import mujoco
import numpy as np
import torch
from torch import Tensor, nn

Sides = tuple[tuple[str, str], ...]
"""Pairs of beginnings or ends of names, for the right and the left side."""

SIDES: Sides = (("right_", "left_"),)

USUAL: Sides = (
    *SIDES,
    ("_right", "_left"),
    ("R_", "L_"),
    ("_R", "_L"),
    ("r_", "l_"),
    ("_r", "_l"),
    ("FR_", "FL_"),
    ("RR_", "RL_"),
    ("HR_", "HL_"),
    ("RF_", "LF_"),
    ("RH_", "LH_"),
    ("fr_", "fl_"),
    ("hr_", "hl_"),
    ("_fr", "_fl"),
    ("_hr", "_hl"),
    ("Right", "Left"),
    ("right", "left"),
)
"""Pairs that makers of robots use, the most distinct first."""


def twin(name: str, sides: Sides = SIDES) -> str:
    """Name of the same part on the other side of the body; a central part is its own twin.

    Args:
        name: Name of a body or a joint.
        sides: Beginnings or ends of names, right and left.

    Example:
        >>> twin("left_knee"), twin("FR_calf", (("FR_", "FL_"),)), twin("coxa_right", (("_right", "_left"),))
        ('right_knee', 'FL_calf', 'coxa_left')
    """
    for right, left in sides:
        for side, other in ((right, left), (left, right)):
            if name.startswith(side):
                return other + name.removeprefix(side)
            if name.endswith(side):
                return name.removesuffix(side) + other
    return name


def guessed_sides(names: Iterable[str]) -> Sides:
    """Return the usual pairs by which names come in twos, for :func:`twin`, without those that add none."""
    names = set(names)
    pairs: Sides = ()
    for pair in USUAL:
        paired = {name for name in names if twin(name, pairs) == name != twin(name, (pair,))}
        if paired and {twin(name, (pair,)) for name in paired} == paired:
            pairs += (pair,)
    return pairs


BODY_SIGNS = (1, -1, 1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1)
"""Signs of a body's observation: a vector changes y; a rotation or spin, a pseudo-vector, changes x and z."""

VECTOR_SIGNS = (1, -1)
"""Signs of a horizontal vector."""

ALIKE = math.cos(math.radians(2))
"""Cosine of the largest angle between a frame, a hinge or its position and the mirror image of its twin's."""

APART = 0.05
"""Largest distance in metres between a body with a joint and the mirror image of its twin, or of itself.

It is twice a central body's distance from the middle, which is 2 cm at the head of Robotis' OP3."""

REFLECTION = np.diag([1.0, -1.0, 1.0])


class Mirror(nn.Module):
    """A reflection of features, as a permutation with signs. It is its own inverse.

    Args:
        sources: Index of the feature that replaces each feature, ``F`` of them.
        signs: Sign of each feature after the permutation.

    Example:
        >>> left_right_up = Mirror([1, 0, 2], [1, 1, -1])
        >>> left_right_up(torch.tensor([1.0, 2.0, 3.0]))
        tensor([ 2.,  1., -3.])
    """

    sources: Tensor
    signs: Tensor

    def __init__(self, sources: Sequence[int], signs: Sequence[float]) -> None:
        super().__init__()
        self.register_buffer("sources", torch.as_tensor(sources), persistent=False)
        self.register_buffer("signs", torch.as_tensor(signs, dtype=torch.float32), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        """Return the mirror image of ``x``, shape ``(*B, F)``."""
        return x[..., self.sources] * self.signs


def mirror_signs(signs: Sequence[float]) -> Mirror:
    """Return the reflection that changes signs only."""
    return Mirror(range(len(signs)), signs)


def without_twin(model: mujoco.MjModel, sides: Sides = SIDES) -> Iterator[str]:
    """Yield the bodies with joints whose twin is missing or has other kinds of joints.

    Args:
        model: The body alone.
        sides: Beginnings or ends of names, right and left.
    """
    kinds = {model.body(body).name: _kinds(model, body) for body in range(1, model.nbody)}
    yield from (name for name, own in kinds.items() if name and own and kinds.get(twin(name, sides)) != own)


def without_mirror_image(model: mujoco.MjModel, sides: Sides = SIDES) -> Iterator[str]:
    """Yield the bodies whose frames or hinges, in the rest pose, are no mirror images of their twins'.

    Features and motions of such a body have no mirror image by exchange and signs. A body whose name has no side is its
    own twin. Bodies without a twin are left out, and places of bodies without a joint, such as sensors.

    Args:
        model: The body alone.
        sides: Beginnings or ends of names, right and left.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = [model.body(body).name for body in range(model.nbody)]
    for body, name in enumerate(names[1:], start=1):
        if not name or (other := twin(name, sides)) not in names:
            continue
        there = names.index(other)
        image = REFLECTION @ data.xmat[there].reshape(3, 3) @ REFLECTION
        frame = data.xmat[body].reshape(3, 3)
        alike = (float((image * frame).sum()) - 1) / 2 > ALIKE
        if kinds := _kinds(model, body):
            place, other_place = data.xpos[[body, there]] - data.xpos[1]
            alike &= bool(np.linalg.norm(place - REFLECTION @ other_place) < APART)
        if kinds == _kinds(model, there) == [mujoco.mjtJoint.mjJNT_HINGE]:
            hinges = model.body_jntadr[[body, there]]
            (axis, other_axis), (angle, other_angle) = model.jnt_axis[hinges], model.qpos0[model.jnt_qposadr[hinges]]
            sign = -float(axis @ REFLECTION @ other_axis)  # axes are pseudo-vectors
            alike &= abs(sign) > ALIKE and math.cos(angle - round(sign) * other_angle) > ALIKE
        if not alike:
            yield name


def _kinds(model: mujoco.MjModel, body: int) -> list[int]:
    """Kinds of the joints of a body."""
    first = model.body_jntadr[body]
    kinds: list[int] = model.jnt_type[first : first + model.body_jntnum[body]].tolist()
    return kinds


def require_mirror_images(model: mujoco.MjModel, sides: Sides = SIDES) -> None:
    """Check that each body's frame and joints in the rest pose are the mirror images of its twin's.

    Raises:
        ValueError: If one's are not.
    """
    if alone := list(without_twin(model, sides)):
        raise ValueError(
            f"the joints of {', '.join(alone)} are missing or of other kinds on the other side: give both sides the "
            "same, or do without mirror images"
        )
    if crooked := list(without_mirror_image(model, sides)):
        raise ValueError(
            f"the frames of {', '.join(crooked)} must mirror the frames on the other side in the rest pose: "
            "turn them in the body's file, with x forward and y to the left, name the sides (sides "
            "of the Character), or do without mirror images"
        )


def mirror_bodies(names: Sequence[str], *, repeats: int = 1, sides: Sides = SIDES) -> Mirror:
    """Return the reflection of :func:`~torchrl_mcp.envs.observations.bodies_in_heading_frame`.

    Args:
        names: Names of the bodies.
        repeats: Number of consecutive observations of all bodies.
        sides: Beginnings or ends of names, right and left.

    Raises:
        ValueError: If a body has no twin.
    """
    if alone := [name for name in names if twin(name, sides) not in names]:
        raise ValueError(f"{', '.join(alone)} has no twin on the other side: rename it, or do without mirror images")
    size = len(BODY_SIGNS)
    twins = [names.index(twin(name, sides)) for name in names]
    once = [size * body + entry for body in twins for entry in range(size)]
    sources = [len(once) * time + source for time in range(repeats) for source in once]
    return Mirror(sources, list(BODY_SIGNS) * len(names) * repeats)


def mirror_state(names: Sequence[str], *, sides: Sides = SIDES) -> Mirror:
    """Return the reflection of a :func:`~torchrl_mcp.envs.observations.character_state` of the bodies ``names``."""
    bodies = mirror_bodies(names, sides=sides)
    return Mirror([0, *(1 + bodies.sources).tolist()], [1.0, *bodies.signs.tolist()])


def mirror_actions(model: mujoco.MjModel, *, sides: Sides = SIDES) -> Mirror:
    """Return the reflection of a character's controls, which are rotation targets with the same scale on both sides."""
    names = [model.actuator(index).name for index in range(model.nu)]
    axes = torch.tensor([_axis(model, index) for index in range(model.nu)])
    joints = [model.joint(index).name for index in model.actuator_trnid[:, 0]]
    sources = torch.tensor(
        [names.index(twin(joint, sides) + name.removeprefix(joint)) for joint, name in zip(joints, names, strict=True)]
    )
    signs = (axes * axes[sources] * torch.tensor([-1.0, 1.0, -1.0])).sum(-1).round()
    return Mirror(sources.tolist(), signs.tolist())


def _axis(model: mujoco.MjModel, actuator: int) -> list[float]:
    """Rotation axis of an actuator in the rest pose."""
    joint = model.actuator_trnid[actuator, 0]
    hinge = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    axis: list[float] = (model.jnt_axis[joint] if hinge else model.actuator_gear[actuator, :3]).tolist()
    return axis
