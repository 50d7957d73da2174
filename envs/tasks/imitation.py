"""The imitation task, for pre-training primitives: follow reference motions."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, cast

import torch
from torch import Tensor

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.contract import CONTROL_TIMESTEP
from torchrl_mcp.envs.characters.joints import joint_layout
from torchrl_mcp.envs.characters.mirror import Mirror, mirror_bodies
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.library import MotionLibrary, PlacedMotion
from torchrl_mcp.envs.motions.placement import Placement, placing
from torchrl_mcp.envs.observations import bodies_in_heading_frame, bodies_layout
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.rotations import rotate
from torchrl_mcp.envs.tasks.imitation_reward import (
    Term,
    checked_terms,
    imitation_rewards,
    mismatch,
    squared_angles,
    squared_distances,
)
from torchrl_mcp.values import Count, Positive, PositiveOrInfinite, checked

NUM_TARGETS = 2
"""Number of future states of the reference in the goal (section 4)."""

# Clips to which the reference may jump
Switch = Literal["any", "same"]

# What the end of a clip may do
ClipEnd = Literal["truncate", "switch"]


class Imitation(PDCharacterEnv):
    r"""A character follows reference motions, which change in the middle of an episode.

    **Reference.** An episode begins at a random moment of a random clip, in the state of the reference. With
    probability :math:`\Delta t /` ``switch_interval`` per step, the reference jumps to another moment, and is moved to
    the character's position and heading. This moment is the most similar one of ``switch_candidates`` random moments:
    the one whose bodies are closest to the character's, by
    :func:`~torchrl_mcp.envs.tasks.imitation_reward.mismatch`.

    **Goal.** ``goal`` (2 x 13 L) has, for each of the next two steps, the positions of the reference's L bodies
    relative to the ground below the character, their orientations and their velocities, in the character's heading
    frame.

    **Reward.** The reward is the sum of :func:`~torchrl_mcp.envs.tasks.imitation_reward.imitation_rewards` of the
    errors that ``terms`` names:

    - ``pose``: the mean squared angle of joints,
    - ``velocity``: the mean squared difference of the joints' velocities,
    - ``root_pose``, ``root_velocity``: the squared distance plus a tenth of the squared angle of the root,
    - ``key_positions``: the mean squared distance of the character's key bodies relative to the root,
    - ``bodies``: the mean squared distance of all bodies in the world,
    - ``orientations``: the mean squared angle of all bodies in the world,
    - ``com``: the squared distance of the centre of mass.

    **Metrics.** ``tracking_error`` (1) is the mean distance of the bodies from the reference after the step, in metres.
    ``reward_terms`` (I) are the terms of the reward before a fall sets the reward to 0.

    **End.** An episode terminates, with reward 0, when the character falls or when the mean distance of its bodies from
    the reference exceeds ``max_error``. The end of a clip that does not loop truncates the episode, as the time limit
    does.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        clips: Reference motions of that character: a library, or clips by name.
        num_envs: Number N of simulations.
        terms: Weight and scale of each error in the reward, by name.
        max_error: Largest mean distance of bodies from the reference, in metres; 0.5 is clearly worse than 0.3.
        switch_interval: Mean time between changes of the reference, in seconds; infinite for no changes. The paper does
            not specify it.
        switch_candidates: Number of random moments, the most similar of which becomes the reference. With 1, the
            reference is "switched randomly" as in section 5.1, and some changes are impossible for a body, for example
            from a fast walk to standing. More candidates make changes easier.
        switch_to: ``"any"`` clip, or the ``"same"`` clip, which moves the reference back to a character that has
            drifted away because it does not observe the reference.
        clip_end: What happens at the end of a clip that does not loop: ``"truncate"`` ends the episode; ``"switch"``
            changes to another reference, so that every episode lasts until its time limit or a failure.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range, or the motions are of another character.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        section 4, https://arxiv.org/abs/1905.09808

    Example:
        >>> from torchrl_mcp.envs import Imitation
        >>> from torchrl_mcp.envs.motions import walking_corpus
        >>> terms = {"bodies": {"weight": 0.5, "scale": 50.0}, "velocity": {"weight": 0.5, "scale": 0.2}}
        >>> env = Imitation("biped", walking_corpus("biped", seed=0), num_envs=2, terms=terms, seed=0)
        >>> trajectories = env.rollout(3)
        >>> trajectories["goal"].shape, trajectories["next", "tracking_error"].shape
        (torch.Size([2, 3, 208]), torch.Size([2, 3, 1]))
    """

    _next: PlacedMotion  # states of the references after the next step

    @checked
    def __init__(
        self,
        character: str,
        clips: MotionLibrary | Mapping[str, MotionClip],
        num_envs: Count,
        *,
        terms: Mapping[str, Annotated[Mapping[str, float], Term]],
        max_error: Positive = 0.3,
        switch_interval: PositiveOrInfinite = 5.0,
        switch_candidates: Count = 1,
        switch_to: Switch = "any",
        clip_end: ClipEnd = "truncate",
        max_episode_steps: Count = 300,
        **kwargs: Any,
    ) -> None:
        if kwargs.get("curriculum") is not None:
            raise ValueError("imitation has no curriculum: leave it out")
        if not isinstance(clips, MotionLibrary | Mapping):
            raise ValueError(
                f"clips={clips!r} must be a MotionLibrary or clips by name: read a folder with folder_library of "
                "torchrl_mcp.envs.motions.corpus, or train with motions=folder motions.path=FOLDER"
            )
        library = clips if isinstance(clips, MotionLibrary) else MotionLibrary(clips)
        if library.character != character:
            raise ValueError(f"clips are of {library.character}: pass motions of character={character!r}")
        self.max_error = max_error
        self.clip_end = clip_end
        self.terms = checked_terms(terms)
        if "key_positions" in terms and not CHARACTERS[character].key_bodies:
            raise ValueError(f"terms names key_positions, but character={character!r} has no key_bodies: name some")
        self.switch_candidates = switch_candidates
        self.switch_to = switch_to
        self.switch_probability = CONTROL_TIMESTEP / switch_interval
        names = library.body_names
        reference = {
            "clip": torch.zeros((), dtype=torch.int64),
            "time": torch.zeros((), dtype=torch.float64),
            "turn": torch.zeros((), dtype=torch.float64),
            "shift": torch.zeros(2, dtype=torch.float64),
            "error": torch.zeros((), dtype=torch.float64),
            "terms": torch.zeros(len(terms), dtype=torch.float64),
        }
        super().__init__(character, num_envs, max_episode_steps=max_episode_steps, episode=reference, **kwargs)
        self.goal_layout = bodies_layout([f"step_{step + 1}.{name}" for step in range(NUM_TARGETS) for name in names])
        self.library = library.to(self.device)
        self._layout = joint_layout(character).to(self.device)
        self._keys = torch.tensor([names.index(body) for body in CHARACTERS[character].key_bodies], device=self.device)
        ahead = CONTROL_TIMESTEP * torch.arange(1, NUM_TARGETS + 1, dtype=torch.float64)
        self._ahead = ahead.unsqueeze(-1).to(self.device)
        self._horizontal = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64, device=self.device)
        model = self.simulation.model
        bodies = slice(1, 1 + len(self._bodies))
        masses = torch.from_numpy(model.body_mass[bodies])
        centres = torch.from_numpy(model.body_ipos[bodies])
        self._masses = masses.to(self.device)
        self._centres_of_mass = centres.to(self.device)
        self.make_specs()

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        r"""Return on a scale where 0 is the worst possible and 1 the best, :math:`R / (T \sum_i w_i)`."""
        return episode_return / (self.max_episode_steps * sum(term.weight for term in self.terms.values()))

    @property
    def metric_names(self) -> dict[str, list[str]]:
        """See :attr:`CharacterEnv.metric_names`."""
        return {**super().metric_names, "reward_terms": [f"reward_{name}" for name in self.terms]}

    def beginning(self, clips: Tensor, times: Tensor) -> dict[str, Tensor]:
        """Initial states for ``reset(set_state=True)`` at moments of clips, each ``(n, ...)``.

        Args:
            clips: Index of each clip in ``library``, shape ``(n,)``, int64.
            times: Seconds since the clip's first frame, shape ``(n,)``, float64.
        """
        num = len(clips)
        moment = self.library.at(clips, times)
        turn = torch.zeros_like(times)
        shift = -moment.qpos[:, :2]
        return {
            "qpos": torch.cat([torch.zeros_like(shift), moment.qpos[:, 2:]], -1),
            "qvel": moment.qvel,
            "clip": clips,
            "time": times,
            "turn": turn,
            "shift": shift,
            "error": torch.zeros_like(times),
            "terms": times.new_zeros(num, len(self.terms)),
        }

    def get_extra_state(self) -> dict[str, Any]:
        """See :meth:`CharacterEnv.get_extra_state`; adds a digest of the motions."""
        return {**super().get_extra_state(), "motions": self.library.digest}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore a result of :meth:`get_extra_state`.

        Raises:
            ValueError: If it comes from other motions.
        """
        if state["motions"] != self.library.digest:
            raise ValueError(
                "the run was trained on other motions, or on the same with other weights: resume it with these, or "
                "begin another from it with stage=pretrain pretrained=<folder>"
            )
        super().set_extra_state(state)

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """The state of the reference at random moments."""
        return self.beginning(*self._draw(num))

    def _draw(self, num: int, clips: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Draw moments, of ``clips`` if given."""
        if clips is not None:
            shares = torch.rand(num, generator=self.generator, dtype=torch.float64, device=self.device)
            return clips, shares * self.library.durations[clips]
        return self.library.sample(num, self.generator)

    def goal_mirror(self) -> Mirror:
        """See :meth:`PDCharacterEnv.goal_mirror`."""
        return mirror_bodies(self._bodies, repeats=NUM_TARGETS, sides=self.character.sides)

    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """State of the character, and the next states of the reference as the character sees them."""
        angle = self.heading(ids)
        place = self._positions[ids, 0]
        targets = self._look_ahead(ids)
        placement = cast("Placement", targets.placement)
        # Equivalent to moving the reference to the character: view the clip from the character's place in its frame.
        ground = place * self._horizontal
        origin = placement.inverse().points(ground.repeat(NUM_TARGETS, 1))
        turn = angle.repeat(NUM_TARGETS) - placement.turn
        dtype = targets.moment.qpos.dtype
        goal = bodies_in_heading_frame(turn.to(dtype), origin.to(dtype), targets.moment.bodies)
        return {
            "observation": self.see(ids)[0],
            "goal": goal.unflatten(0, (NUM_TARGETS, -1)).transpose(0, 1).flatten(1),
            "tracking_error": self.episode["error"][ids].unsqueeze(-1),
            "reward_terms": self.episode["terms"][ids],
        }

    def _look_ahead(self, ids: Tensor | slice) -> PlacedMotion:
        """References of n simulations in the next steps, ordered by step, ``(NUM_TARGETS * n, ...)``."""
        clip, time, turn, shift = (self.episode[key][ids] for key in ("clip", "time", "turn", "shift"))
        num = len(clip)
        times = (time + self._ahead).flatten()
        placement = Placement(turn.repeat(NUM_TARGETS), shift.repeat(NUM_TARGETS, 1))
        targets = self.library.at(clip.repeat(NUM_TARGETS), times, placement)
        first = targets[:num]
        self._next = first if isinstance(ids, slice) else self._next.replaced(ids, first)
        return targets

    def after_step(self, diverged: Tensor) -> None:
        """Measure the distance from the reference, and the terms of the reward."""
        reference = self._next
        distances = torch.linalg.vector_norm(self._positions - reference.positions, dim=-1)
        self.episode["error"].copy_(distances.mean(-1))
        errors = {name: self._error(name, reference) for name in self.terms}
        self.episode["terms"].copy_(imitation_rewards(errors, self.terms))

    def reward(self) -> Tensor:
        """Sum of the terms, or 0 where the reference is lost."""
        return self.episode["terms"].sum(-1).masked_fill(self.terminated(), 0.0)

    def terminated(self) -> Tensor:
        """Whether the bodies are too far from the reference."""
        return self.episode["error"] > self.max_error

    def update_goal(self) -> None:
        """Let the reference go on, and change some of them."""
        self.episode["time"] += CONTROL_TIMESTEP
        self._switch()

    def truncated(self) -> Tensor:
        """Whether the clip has ended, unless another reference follows."""
        return self._ended() & (self.clip_end == "truncate")

    def _switch(self) -> None:
        """Change the references of some simulations to a similar moment, at the character's position and heading."""
        changes = torch.rand(self.num_envs, generator=self.generator, device=self.device) < self.switch_probability
        if self.clip_end == "switch":
            changes |= self._ended()
        ids = changes.nonzero().squeeze(-1)
        if not len(ids):
            return
        each = ids.repeat(self.switch_candidates)
        clips, times = self._draw(len(each), self.episode["clip"][each] if self.switch_to == "same" else None)
        moments = self.library.at(clips, times)
        placement = placing(moments.qpos, self.simulation.state["qpos"][each])
        best = mismatch(self._body_states(each), moments.carried(placement).bodies).view(-1, len(ids)).argmin(0)
        chosen = best * len(ids) + self._everybody[: len(ids)]
        changed = {"clip": clips, "time": times, "turn": placement.turn, "shift": placement.shift}
        for key, values in changed.items():
            self.episode[key][ids] = values[chosen].to(self.episode[key].dtype)

    def _error(self, name: str, reference: PlacedMotion) -> Tensor:
        """One of ``ERRORS`` between character and reference, ``(N,)``."""
        qpos = self.simulation.state["qpos"]
        qvel = self.simulation.state["qvel"]
        layout = self._layout
        positions = self._positions
        targets = reference.positions
        match name:
            case "pose":
                turns = squared_angles(qpos[:, layout.quaternions[1:]], reference.qpos[:, layout.quaternions[1:]])
                hinges = (qpos[:, layout.angles] - reference.qpos[:, layout.angles]).square()
                return torch.cat([turns, hinges], -1).mean(-1)
            case "velocity":
                return squared_distances(qvel[:, 6:], reference.qvel[:, 6:]) / (len(layout.names) - 1)
            case "root_pose":
                turn = squared_angles(qpos[:, 3:7], reference.qpos[:, 3:7])
                return squared_distances(qpos[:, :3], reference.qpos[:, :3]) + 0.1 * turn
            case "root_velocity":
                linear, angular = (qvel - reference.qvel)[:, :6].square().split(3, -1)
                return linear.sum(-1) + 0.1 * angular.sum(-1)
            case "key_positions":
                offsets = positions[:, self._keys] - positions[:, :1]
                target_offsets = targets[:, self._keys] - targets[:, :1]
                return squared_distances(offsets, target_offsets).mean(-1)
            case "bodies":
                return squared_distances(positions, targets).mean(-1)
            case "orientations":
                return squared_angles(self._orientations, reference.orientations).mean(-1)
            case _:  # com
                return squared_distances(self.com, self._centre_of_mass(reference))

    def _centre_of_mass(self, reference: PlacedMotion) -> Tensor:
        """Centre of mass of the character with its bodies at the reference, ``(N, 3)``."""
        places = reference.positions + rotate(reference.orientations, self._centres_of_mass)
        return self._masses @ places / self._masses.sum()

    def _ended(self) -> Tensor:
        """Whether clips end before the last target of the next goal, ``(N,)``."""
        clips = self.episode["clip"]
        ahead = self.episode["time"] + NUM_TARGETS * CONTROL_TIMESTEP
        return (ahead > self.library.durations[clips]) & ~self.library.loops[clips]
