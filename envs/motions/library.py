"""Many motion clips, read in one batch."""

import copy
import hashlib
from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import joint_layout
from torchrl_mcp.envs.characters.kinematics import BodyStates, body_names, body_states
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.placement import Placement, placing
from torchrl_mcp.envs.rotations import continuous


class MotionState(NamedTuple):
    """Moments of reference motions, at the positions and headings of their clips.

    Args:
        qpos: States of the character, shape ``(N, nq)``.
        qvel: Velocities in MuJoCo's convention, shape ``(N, nv)``.
        bodies: The bodies in world coordinates, each ``(N, L, ...)``.
    """

    qpos: Tensor
    qvel: Tensor
    bodies: BodyStates


class PlacedMotion:
    """Moments of reference motions at other positions and headings, computed lazily.

    Args:
        moment: N moments.
        placement: N turns and shifts, or None for no change.
    """

    def __init__(self, moment: MotionState, placement: Placement | None) -> None:
        self.moment = moment
        self.placement = placement
        if placement is not None:
            self._each = Placement(placement.turn.unsqueeze(-1), placement.shift.unsqueeze(-2))

    @cached_property
    def qpos(self) -> Tensor:
        """States of the character, shape ``(N, nq)``."""
        return self.moment.qpos if self.placement is None else self.placement.qpos(self.moment.qpos)

    @cached_property
    def qvel(self) -> Tensor:
        """Velocities in MuJoCo's convention, shape ``(N, nv)``."""
        return self.moment.qvel if self.placement is None else self.placement.qvel(self.moment.qvel)

    @cached_property
    def positions(self) -> Tensor:
        """Positions of the bodies, shape ``(N, L, 3)``."""
        positions = self.moment.bodies.positions
        return positions if self.placement is None else self._each.points(positions)

    @cached_property
    def orientations(self) -> Tensor:
        """Orientations of the bodies as unit quaternions, shape ``(N, L, 4)``."""
        orientations = self.moment.bodies.orientations
        return orientations if self.placement is None else self._each.quaternions(orientations)

    @cached_property
    def bodies(self) -> BodyStates:
        """States of the bodies in the world."""
        velocities = (self.moment.bodies.linear_velocities, self.moment.bodies.angular_velocities)
        if self.placement is not None:
            velocities = (self._each.vectors(velocities[0]), self._each.vectors(velocities[1]))
        return BodyStates(self.positions, self.orientations, *velocities)

    def carried(self, placement: Placement) -> "PlacedMotion":
        """Return these moments moved further by N turns and shifts."""
        return PlacedMotion(self.moment, placement if self.placement is None else placement.after(self.placement))

    def __getitem__(self, index: slice) -> "PlacedMotion":
        """Some of the moments."""
        return self._of([part[index] for part in self._parts()])

    def replaced(self, ids: Tensor, others: "PlacedMotion") -> "PlacedMotion":
        """Return these moments with ``others`` in the rows ``ids``; both have a placement, or neither has."""
        pairs = zip(self._parts(), others._parts(), strict=True)
        return self._of([part.index_copy(0, ids, other) for part, other in pairs])

    def _parts(self) -> list[Tensor]:
        return [self.moment.qpos, self.moment.qvel, *self.moment.bodies, *(self.placement or ())]

    @classmethod
    def _of(cls, parts: list[Tensor]) -> "PlacedMotion":
        qpos, qvel, *bodies = parts[:6]
        return cls(MotionState(qpos, qvel, BodyStates(*bodies)), Placement(*parts[6:]) if parts[6:] else None)


class MotionLibrary:
    """Clips of one character in one table of frames, from which moments of many clips are read in one batch.

    Between frames all numbers are interpolated linearly, and quaternions are normalised again. At 30 frames per second
    or more and at walking speeds, the result is within a thousandth of a radian of :meth:`MotionClip.at`.

    Args:
        clips: Clips of one character, by name.
        weights: Relative probability of each clip, by name; None for the durations, which draws all moments equally
            often.
        dtype: Type of the moments.

    Raises:
        ValueError: If there are no clips, they are of several characters, or the weights do not fit them.
    """

    def __init__(
        self,
        clips: Mapping[str, MotionClip],
        weights: Mapping[str, float] | None = None,
        *,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        if len(characters := sorted({clip.character for clip in clips.values()})) != 1:
            raise ValueError(f"clips are of {characters or 'no character'}: pass one or more, all of one character")
        self.character = characters[0]
        self.names = list(clips)
        self.body_names = body_names(self.character)
        self.durations = torch.tensor([clip.duration for clip in clips.values()], dtype=torch.float64)
        """Seconds of each clip, or of one cycle if it loops, shape ``(C,)``."""
        self.loops = torch.tensor([clip.loop for clip in clips.values()])
        """Whether each clip loops, shape ``(C,)``, bool."""
        self.weights = self.durations if weights is None else self._checked(weights)
        """Relative probability of each clip, shape ``(C,)``."""
        self.digest = _digest(clips, self.weights)
        """SHA-256 of clips and weights, with which a checkpoint identifies its motions."""
        self._fps = torch.tensor([clip.fps for clip in clips.values()], dtype=torch.float64)
        lengths = torch.tensor([len(clip.qpos) for clip in clips.values()])
        self._last = lengths - 1
        self._start = lengths.cumsum(0) - lengths
        first = torch.stack([clip.qpos[0] for clip in clips.values()])
        self._cycles = placing(first, torch.stack([clip.qpos[-1] for clip in clips.values()]))
        layout = joint_layout(self.character)
        self._order = torch.cat([layout.quaternions.mT.flatten(), torch.arange(3), layout.angles]).argsort()
        self._num_turns = len(layout.quaternions)
        rows = [_rows(clip) for clip in clips.values()]
        self._table = torch.cat([torch.cat(row, dim=-1) for row in rows]).to(dtype)
        self._sizes = [part.shape[-1] for part in rows[0]]

    def __len__(self) -> int:
        return len(self.names)

    def to(self, device: torch.device | str) -> "MotionLibrary":
        """Return the library on a device."""
        if self._table.device == torch.device(device):
            return self
        moved = copy.copy(self)
        for name, value in vars(self).items():
            if isinstance(value, Tensor):
                setattr(moved, name, value.to(device))
        moved._cycles = Placement(*(part.to(device) for part in self._cycles))
        return moved

    def at(self, clips: Tensor, times: Tensor, placement: Placement | None = None) -> PlacedMotion:
        """Read moments of clips.

        Args:
            clips: Index of each clip, shape ``(N,)``, int64.
            times: Seconds since the clip's first frame, shape ``(N,)``; held at the ends unless the clip loops.
            placement: Turn and shift of each clip, N of them, or None for no change.
        """
        last = self._last[clips]
        frames = times.double() * self._fps[clips]
        cycles = torch.where(self.loops[clips], torch.floor(frames / last), 0.0)
        frames = torch.minimum((frames - cycles * last).clamp_min(0.0), last)
        whole = torch.minimum(frames.long(), last - 1)
        rows = self._start[clips] + whole
        fraction = (frames - whole).to(self._table.dtype)
        before, after = self._table.index_select(0, rows), self._table.index_select(0, rows + 1)
        moments = torch.lerp(before, after, fraction.unsqueeze(-1)).split(self._sizes, dim=-1)
        quaternions = moments[0].unflatten(-1, (4, -1))
        quaternions *= quaternions.square().sum(-2, keepdim=True).rsqrt()
        joints = torch.cat([quaternions[..., : self._num_turns].flatten(1), moments[1]], dim=-1)
        qpos = joints.index_select(1, self._order)
        orientations = quaternions[..., self._num_turns :].mT
        positions, linear, angular = (part.unflatten(-1, (3, -1)).mT for part in moments[2:5])
        state = MotionState(qpos, moments[5], BodyStates(positions, orientations, linear, angular))
        looped = Placement(self._cycles.turn[clips], self._cycles.shift[clips]).power(cycles) if cycles.any() else None
        motion = PlacedMotion(state, looped)
        return motion if placement is None else motion.carried(placement)

    def sample(self, num: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw moments: clips by their weights, times uniformly over a clip or one cycle.

        Args:
            num: Number of moments.
            generator: Source of randomness.

        Returns:
            Clips, shape ``(num,)``, int64, and times in seconds, shape ``(num,)``, float64.
        """
        clips = torch.multinomial(self.weights, num, replacement=True, generator=generator)
        durations = self.durations[clips]
        return clips, torch.rand(num, generator=generator, dtype=torch.float64, device=durations.device) * durations

    def _checked(self, weights: Mapping[str, float]) -> Tensor:
        if set(weights) != set(self.names):
            raise ValueError(f"weights are of {sorted(weights)}: pass one for each of the clips {self.names}")
        values = torch.tensor([weights[name] for name in self.names], dtype=torch.float64)
        if not (values >= 0).all() or not 0 < values.sum() < torch.inf:
            raise ValueError(f"weights={dict(weights)}: pass finite numbers of at least 0, not all of them 0")
        return values


def _rows(clip: MotionClip) -> list[Tensor]:
    """Return the columns of the table for a clip, each ``(T, *)``.

    These are quaternions of joints and bodies, root position and hinges, positions and velocities of bodies, and
    ``qvel``. Vectors and quaternions are stored by component, which is several times as fast as by body.
    """
    layout = clip.layout
    bodies = body_states(clip.character, clip.qpos, clip.qvel)
    turns = continuous(torch.cat([clip.qpos[:, layout.quaternions], bodies.orientations], dim=1).transpose(0, 1))
    others = torch.cat([clip.qpos[:, :3], clip.qpos[:, layout.angles]], dim=-1)
    vectors = (bodies.positions, bodies.linear_velocities, bodies.angular_velocities)
    return [turns.permute(1, 2, 0).flatten(1), others, *(vector.mT.flatten(1) for vector in vectors), clip.qvel]


def _digest(clips: Mapping[str, MotionClip], weights: Tensor) -> str:
    digest = hashlib.sha256(repr(weights.tolist()).encode())
    for name, clip in clips.items():
        digest.update(repr((name, clip.character, clip.layout.names, clip.fps, clip.loop, clip.qpos.shape)).encode())
        digest.update(clip.qpos.numpy().tobytes())
    return digest.hexdigest()
