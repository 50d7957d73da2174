"""Motion clips: trajectories of a character's root and joints."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Self

import numpy as np
import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import JointLayout, character_model, joint_layout
from torchrl_mcp.envs.characters.mirror import require_mirror_images
from torchrl_mcp.envs.motions.archive import UNREADABLE, load_arrays
from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.placement import Placement, placing
from torchrl_mcp.envs.rotations import continuous, inverse, multiply, slerp, to_rotation_vector

OPEN = 0.2
"""Angle in radians by which a joint may differ between the ends of a clip that loops."""


@dataclass(frozen=True, eq=False)
class MotionClip:
    """A trajectory of a character's root and joints at a constant frame rate.

    The quaternions are normalised, with signs that make them continuous. A looping clip ends in the pose of its
    beginning. Each further cycle continues from the horizontal position and heading at the end of the last one, with
    height, roll and pitch from the first frame.

    Args:
        character: Name of the character.
        qpos: States in MuJoCo's order for the character's model, shape ``(T, nq)``, float64, T >= 2: root position and
            quaternion ``(w, x, y, z)``, then the joints in the order of the bodies. Read-only.
        fps: Frames per second.
        loop: Whether the motion repeats.

    Raises:
        ValueError: If the states have another shape, are not finite or not rotations, ``fps`` is not positive, or a
            loop does not end as it began.

    Example:
        >>> import torch
        >>> from torchrl_mcp.envs.characters.joints import character_model
        >>> gliding = torch.from_numpy(character_model("humanoid").qpos0).repeat(2, 1)
        >>> gliding[1, 0] += 0.5
        >>> clip = MotionClip("humanoid", gliding, fps=2.0, loop=True)
        >>> clip.at(torch.tensor([0.25, 1.75]))[:, 0]
        tensor([0.2500, 1.7500], dtype=torch.float64)
    """

    character: str
    qpos: Tensor
    fps: float
    loop: bool = False

    def __post_init__(self) -> None:
        layout = self.layout
        if self.qpos.ndim != 2 or self.qpos.shape[1] != layout.nq or len(self.qpos) < 2:
            raise ValueError(f"qpos has shape {tuple(self.qpos.shape)}: pass (T, {layout.nq}) with T >= 2")
        if not 0 < self.fps < math.inf:
            raise ValueError(f"fps={self.fps} must be a positive, finite frame rate")
        qpos = self.qpos.detach().to("cpu", torch.float64, copy=True)
        if not qpos.isfinite().all():
            frame = int((~qpos.isfinite()).any(-1).nonzero()[0])
            raise ValueError(f"qpos is not finite in frame {frame}: correct or remove it")
        qpos[:, layout.quaternions] = _canonical(qpos[:, layout.quaternions])
        if self.loop and (gap := _gap(qpos, layout)) > OPEN:
            raise ValueError(
                f"the clip ends with a joint {gap:.2f} rad from where it began: pass loop=False, or close it"
            )
        object.__setattr__(self, "qpos", qpos)
        object.__setattr__(self, "fps", float(self.fps))

    @property
    def layout(self) -> JointLayout:
        """Indices of the joints in a state."""
        return joint_layout(self.character)

    @property
    def duration(self) -> float:
        """Seconds from the first frame to the last; one cycle of a loop."""
        return (len(self.qpos) - 1) / self.fps

    @cached_property
    def cycle(self) -> Placement:
        """Change of the root's horizontal position and heading over one cycle."""
        return placing(self.qpos[0], self.qpos[-1])

    @cached_property
    def qvel(self) -> Tensor:
        """Velocities in MuJoCo's convention at every frame, shape ``(T, nv)``: means of the differences on both sides.

        The root's linear velocity is in the world; angular velocities of the root and of ball joints are in the frames
        of their bodies.
        """
        steps = differences(self.qpos, self.layout) * self.fps
        before, after = steps[:1], steps[-1:]
        if self.loop:
            before, after = self.cycle.power(torch.tensor(-1)).qvel(steps[-1:]), self.cycle.qvel(steps[:1])
        return (torch.cat([before, steps]) + torch.cat([steps, after])) / 2

    def at(self, times: Tensor) -> Tensor:
        """State at any time, shape ``(*B, nq)``: slerp for quaternions, linear for the rest.

        Args:
            times: Seconds since the first frame, shape ``(*B)``; held at the ends unless the clip loops.
        """
        frame, fraction, cycles = self._locate(times)
        before = self.qpos[frame]
        after = self.qpos[frame + 1]
        quaternions = self.layout.quaternions
        qpos = torch.lerp(before, after, fraction.unsqueeze(-1))
        qpos[..., quaternions] = slerp(before[..., quaternions], after[..., quaternions], fraction.unsqueeze(-1))
        return self.cycle.power(cycles).qpos(qpos) if self.loop else qpos

    def velocity(self, times: Tensor) -> Tensor:
        """Velocity at any time, shape ``(*B, nv)``, interpolated linearly between frames; see :attr:`qvel`."""
        frame, fraction, cycles = self._locate(times)
        qvel = torch.lerp(self.qvel[frame], self.qvel[frame + 1], fraction.unsqueeze(-1))
        return self.cycle.power(cycles).qvel(qvel) if self.loop else qvel

    def mirrored(self) -> Self:
        """Exchange left and right, exactly: the mirror image of the mirror image is the clip.

        Raises:
            ValueError: If the character's frames are no mirror images of each other.
        """
        require_mirror_images(character_model(self.character), CHARACTERS[self.character].sides)
        return replace(self, qpos=self.qpos[:, self.layout.mirror] * self.layout.mirror_sign)

    def resampled(self, fps: float) -> Self:
        """Return the clip at the frame rate nearest to ``fps`` that divides its duration into whole frames."""
        frames = max(1, round(self.duration * fps))
        times = torch.linspace(0, self.duration, frames + 1, dtype=torch.float64)
        return replace(self, qpos=self._within(times), fps=frames / self.duration)

    def section(self, start: float, stop: float) -> Self:
        """Return the part between two times, in seconds, as a clip that does not loop.

        Raises:
            ValueError: If the part is empty or lies outside the clip.
        """
        if not 0 <= start < stop <= self.duration + 1e-9:
            raise ValueError(
                f"start={start}, stop={stop} must be a part of the clip: pass 0 <= start < stop <= {self.duration:g}"
            )
        frames = max(1, round((stop - start) * self.fps))
        times = start + torch.arange(frames + 1, dtype=torch.float64) / self.fps
        return replace(self, qpos=self._within(times), loop=False)

    def placed(self, placement: Placement) -> Self:
        """Return the clip at another horizontal position and heading."""
        return replace(self, qpos=placement.qpos(self.qpos))

    def save(self, path: str | Path | BinaryIO) -> None:
        """Write a NumPy archive (``.npz``) of plain arrays, bit for bit; reading it runs no code."""
        joints = np.array(self.layout.names)
        np.savez_compressed(
            path, character=self.character, joints=joints, qpos=self.qpos.numpy(), fps=self.fps, loop=self.loop
        )

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file of :meth:`save`.

        Raises:
            MotionFormatError: If the file is no clip, is damaged, is of a character that is not known, or has other
                joints than the character's model.
        """
        try:
            return cls._from_arrays(path, load_arrays(Path(path)))
        except MotionFormatError:
            raise
        except UNREADABLE as error:
            raise MotionFormatError(
                path,
                f"must be a motion clip ({error}): pass one that torchrl-mcp-motions import has written, or import it "
                "again",
            ) from error

    @classmethod
    def _from_arrays(cls, path: str | Path, arrays: Mapping[str, np.ndarray]) -> Self:
        if missing := {"character", "joints", "qpos", "fps", "loop"} - set(arrays):
            raise ValueError(f"it lacks {sorted(missing)}")
        character = str(arrays["character"])
        joints = tuple(map(str, arrays["joints"]))
        if character not in CHARACTERS:
            raise MotionFormatError(
                path,
                f"is a clip of character={character!r}, but only {', '.join(CHARACTERS)} exist: name the module that "
                "adds it (torchrl-mcp-motions --module), or take clips of another character",
            )
        if joints != (expected := joint_layout(character).names):
            raise ValueError(f"it has the joints {joints}, but the model of {character} has {expected}")
        return cls(character, torch.from_numpy(arrays["qpos"]), float(arrays["fps"]), loop=bool(arrays["loop"]))

    def _locate(self, times: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Frame before each time, fraction of the way to the next, and number of cycles completed."""
        times = times.double()
        cycles = torch.floor(times / self.duration) if self.loop else torch.zeros_like(times)
        position = ((times - cycles * self.duration) * self.fps).clamp(0, len(self.qpos) - 1)
        frame = position.long().clamp(max=len(self.qpos) - 2)
        return frame, position - frame, cycles

    def _within(self, times: Tensor) -> Tensor:
        """State at times within the first cycle, including its end."""
        return replace(self, loop=False).at(times)


def concatenated(clips: Sequence[MotionClip]) -> MotionClip:
    """Play clips one after another, each from the horizontal position and heading at the end of the last one.

    The first frame of a clip is identified with the last frame of the previous one: their poses should agree.

    Args:
        clips: One or more clips, of one character and frame rate.

    Raises:
        ValueError: If there are none, or they differ in character or frame rate.
    """
    if len({(clip.character, clip.fps) for clip in clips}) != 1:
        kinds = sorted({f"{clip.character} at {clip.fps:g} fps" for clip in clips})
        raise ValueError(
            f"clips are of {kinds or 'no kind'}: pass at least one, all of one character, and resample them"
        )
    first, *others = clips
    parts = [first.qpos]
    for clip in others:
        parts.append(placing(clip.qpos[0], parts[-1][-1]).qpos(clip.qpos[1:]))
    return replace(first, qpos=torch.cat(parts), loop=False)


def differences(qpos: Tensor, layout: JointLayout) -> Tensor:
    """Changes from each state to the next in MuJoCo's convention, as ``mj_differentiatePos``, shape ``(T - 1, nv)``.

    Args:
        qpos: States, shape ``(T, nq)``.
        layout: Layout of the character.
    """
    before, after = qpos[:-1], qpos[1:]
    change = qpos.new_empty(len(qpos) - 1, layout.nv)
    change[:, :3] = after[:, :3] - before[:, :3]
    change[:, layout.rates] = after[:, layout.angles] - before[:, layout.angles]
    turned = multiply(inverse(before[:, layout.quaternions]), after[:, layout.quaternions])
    change[:, layout.spins] = to_rotation_vector(turned)
    return change


def _gap(qpos: Tensor, layout: JointLayout) -> float:
    """Greatest angle in radians of a joint between the first and the last state."""
    first, last = qpos[0], qpos[-1]
    hinges = last[layout.angles] - first[layout.angles]
    balls = layout.quaternions[1:]
    turns = to_rotation_vector(multiply(inverse(first[balls]), last[balls])).norm(dim=-1)
    return float(torch.cat([torch.atan2(hinges.sin(), hinges.cos()).abs(), turns, hinges.new_zeros(1)]).max())


def _canonical(quaternions: Tensor) -> Tensor:
    """Normalise and make continuous, shape ``(T, Q, 4)``; valid quaternions keep every bit."""
    norm = torch.linalg.vector_norm(quaternions, dim=-1, keepdim=True)
    if (norm < 0.5).any():
        frame = int((norm < 0.5).flatten(1).any(-1).nonzero()[0])
        raise ValueError(f"qpos has a quaternion of length {norm.min():g} in frame {frame}: pass unit quaternions")
    scale = torch.where((norm - 1).abs() < 1e-12, torch.ones_like(norm), norm)
    return continuous((quaternions / scale).transpose(0, 1)).transpose(0, 1)
