"""Initial states of episodes: at rest, or in the middle of a motion."""

from collections.abc import Mapping

import torch
from torch import Tensor

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.corpus import generated_library
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.motions.placement import placing

KINDS = ("rest", "motions")
"""Kinds of initial states: standing still in the rest pose, and a random moment of a random motion."""


class InitialStates:
    """Draws initial states of episodes, with the root over the origin and facing along x.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        initial_states: ``"rest"``, ``"motions"``, or a weight for each: its share of the sum is its probability.
        motions: Library of motions, or clips by name; None for the character's generated motions, which are generated
            only if needed.
        device: Device of the states.

    Raises:
        ValueError: If a kind of states or a weight is invalid, or the motions are of another character.
    """

    def __init__(
        self,
        character: str,
        initial_states: str | Mapping[str, float] = "rest",
        motions: MotionLibrary | Mapping[str, MotionClip] | None = None,
        device: torch.device | str = "cpu",
    ) -> None:
        weights = {initial_states: 1.0} if isinstance(initial_states, str) else dict(initial_states)
        total = sum(weights.values())
        if not set(weights) <= set(KINDS) or min(weights.values(), default=-1) < 0 or not 0 < total < float("inf"):
            raise ValueError(
                f"initial_states={initial_states!r} is unknown: pass rest, motions, or a weight of at least 0 for each"
            )
        model = character_model(character)
        self.rest = torch.from_numpy(model.qpos0).to(device)
        self.num_velocities = model.nv
        self.in_motion = weights.get("motions", 0.0) / total
        self.library = self._library(character, motions).to(device) if self.in_motion else None

    def draw(self, num: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Draw states of the character: ``qpos``, shape ``(num, nq)``, and ``qvel``, ``(num, nv)``."""
        qpos = self.rest.repeat(num, 1)
        qvel = qpos.new_zeros(num, self.num_velocities)
        if self.library is None or not num:
            return qpos, qvel
        shares = torch.rand(num, device=qpos.device, generator=generator)
        moving = (shares < self.in_motion).nonzero().squeeze(-1)
        clips, times = self.library.sample(num, generator)
        moment = self.library.at(clips, times)
        placement = placing(moment.qpos, qpos)
        qpos[moving] = placement.qpos(moment.qpos)[moving].double()
        qvel[moving] = placement.qvel(moment.qvel)[moving].double()
        return qpos, qvel

    def fill(self, start: dict[str, Tensor], generator: torch.Generator) -> dict[str, Tensor]:
        """Return states of a scene with drawn states of the character.

        Args:
            start: The scene's ``qpos`` and ``qvel``, ``(num, ...)``, in which the character comes first; changed.
            generator: Source of randomness.
        """
        qpos, qvel = self.draw(len(start["qpos"]), generator)
        start["qpos"][:, : qpos.shape[1]] = qpos
        start["qvel"][:, : qvel.shape[1]] = qvel
        return start

    def poses(self, interval: float = 0.1) -> Tensor:
        """Possible poses, ``(P, nq)``: the rest pose, and the motions every ``interval`` seconds."""
        if self.library is None:
            return self.rest.unsqueeze(0)
        every = [
            (clip, time)
            for clip, duration in enumerate(self.library.durations.tolist())
            for time in torch.arange(0.0, duration, interval, dtype=torch.float64).tolist()
        ]
        clips, times = zip(*every, strict=True)
        device = self.rest.device
        moments = torch.tensor(clips, device=device), torch.tensor(times, dtype=torch.float64, device=device)
        poses = self.library.at(*moments).qpos.double()
        rest = self.rest.expand(len(poses), -1)
        return torch.cat([self.rest.unsqueeze(0), placing(poses, rest).qpos(poses)])

    @staticmethod
    def _library(character: str, motions: MotionLibrary | Mapping[str, MotionClip] | None) -> MotionLibrary:
        if motions is None:
            return generated_library(character, seed=0)
        library = motions if isinstance(motions, MotionLibrary) else MotionLibrary(motions)
        if library.character != character:
            raise ValueError(f"motions are of {library.character}: pass motions of character={character!r}")
        return library
