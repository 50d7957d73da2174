"""The rest pose of a body that is made a character."""

import re
from collections.abc import Sequence
from typing import NamedTuple, Self

import mujoco
import numpy as np

from torchrl_mcp.envs.characters.contract import HINGE, joints_of

FREE_RANGE = 1.57
"""Range in radians on both sides of the rest pose of a joint without limits."""

TOLERANCE = 0.01
"""Angle in radians by which a pose may exceed a joint's limits, for rounding: it is moved to the limit."""


class Pose(NamedTuple):
    """A pose of a model.

    Args:
        model: The model.
        data: Its data, in the pose.
    """

    model: mujoco.MjModel
    data: mujoco.MjData

    @classmethod
    def read(cls, model: mujoco.MjModel, words: Sequence[str], bodies: Sequence[int]) -> Self:
        """Read a pose, and check that it is within the joints' limits.

        Args:
            model: The model.
            words: Names or numbers of keyframes, and ``PATTERN=RADIANS`` for hinges in whose names the regular
                expression is found; a later word wins. Without any, it is the pose of the file.
            bodies: Bodies whose joints are checked.

        Raises:
            ValueError: If a word names nothing, or a hinge is beyond its limits.
        """
        data = mujoco.MjData(model)
        for word in words:
            pattern, equals, angle = word.rpartition("=")
            if equals:
                data.qpos[model.jnt_qposadr[_hinges(model, pattern, word)]] = _number(angle, word)
            else:
                data.qpos[:] = model.key_qpos[_keyframe(model, word)]
        joints = [joint for body in bodies for joint in joints_of(model, body)]
        _put_within(model, data, [joint for joint in joints if model.jnt_type[joint] == HINGE])
        mujoco.mj_kinematics(model, data)
        return cls(model, data)

    def relative(self, body: int, root: int) -> tuple[np.ndarray, np.ndarray]:
        """Position and orientation of a body in its parent; of the root in the world, above the origin."""
        position = self.data.xpos[body].copy()
        turn = self.data.xquat[body].copy()
        if body == root:
            return position * [0, 0, 1], turn
        parent = self.model.body_parentid[body]
        back = np.empty(4)
        place = np.empty(3)
        relative = np.empty(4)
        mujoco.mju_negQuat(back, self.data.xquat[parent])
        mujoco.mju_rotVecQuat(place, position - self.data.xpos[parent], back)
        mujoco.mju_mulQuat(relative, back, turn)
        return place, relative

    def angle(self, hinge: int) -> float:
        """Angle of a hinge in radians."""
        return float(self.data.qpos[self.model.jnt_qposadr[hinge]])

    def range(self, hinge: int) -> tuple[float, float]:
        """Limits of a hinge in radians."""
        if not self.model.jnt_limited[hinge]:
            return self.angle(hinge) - FREE_RANGE, self.angle(hinge) + FREE_RANGE
        low, high = self.model.jnt_range[hinge].tolist()
        return low, high


def _hinges(model: mujoco.MjModel, pattern: str, word: str) -> list[int]:
    hinges = np.flatnonzero(model.jnt_type == HINGE).tolist()
    names = {hinge: model.joint(hinge).name for hinge in hinges}
    try:
        matches = [hinge for hinge in hinges if re.search(pattern, names[hinge])]
    except re.error as error:
        raise ValueError(f"--pose {word}: {pattern} is not a regular expression: {error}") from error
    if matches:
        return matches
    raise ValueError(f"--pose {word} matches no hinge: they are {', '.join(names.values())}")


def _number(text: str, word: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"--pose {word}: {text!r} is not an angle in radians") from None


def _keyframe(model: mujoco.MjModel, word: str) -> int:
    names = [model.key(key).name or str(key) for key in range(model.nkey)]
    if word not in names:
        there = f"its keyframes are {', '.join(names)}" if names else "it has none, so give angles, such as knee=-1.2"
        raise ValueError(f"--pose {word} is not a keyframe of the file: {there}")
    return names.index(word)


def _put_within(model: mujoco.MjModel, data: mujoco.MjData, hinges: Sequence[int]) -> None:
    """Check that hinges are within their limits, and move them there if rounding exceeds these."""
    beyond = []
    for hinge in hinges:
        if not model.jnt_limited[hinge]:
            continue
        place, (low, high) = model.jnt_qposadr[hinge], model.jnt_range[hinge].tolist()
        angle = float(data.qpos[place])
        data.qpos[place] = min(max(angle, low), high)
        if abs(data.qpos[place] - angle) > TOLERANCE:
            beyond.append((model.joint(hinge).name, low, high))
    if beyond:
        shown = ", ".join(f"{name} ({low:.3g} to {high:.3g})" for name, low, high in beyond)
        example = " ".join(f"{name}={(low + high) / 2:.2f}" for name, low, high in beyond)
        raise ValueError(
            f"the rest pose is beyond the range in radians of {shown}: choose one within it, such as --pose KEYFRAME "
            f"or --pose {example}"
        )
