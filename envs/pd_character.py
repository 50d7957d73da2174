"""Characters under PD control: state, falls and scene, for all tasks with a character."""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Literal

import mujoco
import torch
from torch import Tensor

from torchrl_mcp.adapters.contract import TASK_REWARD
from torchrl_mcp.envs.base import ALL, CharacterEnv
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.contract import CONTROL_TIMESTEP
from torchrl_mcp.envs.characters.falls import falling_geoms, lowest_points
from torchrl_mcp.envs.characters.kinematics import BodyStates, origin_velocities
from torchrl_mcp.envs.characters.mirror import Mirror, mirror_actions, mirror_state, require_mirror_images
from torchrl_mcp.envs.characters.stance import rest_controls
from torchrl_mcp.envs.curriculum import Curriculum
from torchrl_mcp.envs.initial_states import InitialStates
from torchrl_mcp.envs.observations import UNITS, character_state, state_layout
from torchrl_mcp.envs.physics.arrays import as_array, as_tensor, by_component, contiguous, converted
from torchrl_mcp.envs.rendering.ground import add_ground
from torchrl_mcp.envs.rotations import heading
from torchrl_mcp.values import Count, Positive, checked

# MuJoCo's cones of contact forces
Cone = Literal["pyramidal", "elliptic"]

CONES = {"pyramidal": mujoco.mjtCone.mjCONE_PYRAMIDAL, "elliptic": mujoco.mjtCone.mjCONE_ELLIPTIC}


class PDCharacterEnv(CharacterEnv):
    r"""A character that follows target poses, on flat ground.

    - ``action`` ``(N, A)``, from -1 to 1, sets the targets of the PD controllers: exponential maps for ball joints,
      angles for hinges, both in radians. The action 0 is the rest pose, in which the character stands upright. The
      action 1 is half the width of the target's range, to which the target is clipped.
    - ``observation`` ``(N, S)`` is :func:`~torchrl_mcp.envs.observations.character_state`. ``observation_layout`` has
      the names of its entries.
    - ``com`` ``(N, 3)`` is the centre of mass in metres, a live view; ``velocity("com")`` is its velocity in m/s.

    Episodes begin at rest. The character *falls* when any body but its feet touches the ground. A fall ends the
    episode, and the reward of this step is 0, whatever ``reward`` returns.

    A ``curriculum`` changes training episodes. If it has ``reward_weights``, the reward is :meth:`training_reward`.

    Args:
        character: Name of a character, such as ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``.
        episode: Variables of the task in one simulation at the beginning of an episode, by name.
        furnish: Function that adds the task's objects to the scene, after character, ground and light.
        curriculum: How training differs from the task, a :class:`~torchrl_mcp.envs.curriculum.Curriculum` or its
            arguments by name; None for the task itself.
        physics_timestep: Duration of a physics step in seconds, 1/30 divided by a whole number; None for the value of
            the character.
        self_collision: Whether bodies of the character collide with one another.
        friction_cone: MuJoCo's cone of contact forces, ``"pyramidal"`` or ``"elliptic"``. A pyramid has edges along the
            world's axes, so that a motion that is turned by 45 degrees slides differently. An ellipse has no edges, but
            reduces the speed of the simulation by 26 to 38 %.
        terminate_on_fall: Whether a fall ends the episode.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.base.CharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.

    Example:
        A task in which a character earns reward for being high above the ground, in metres.

        >>> import torch
        >>> from torchrl_mcp.envs import PDCharacterEnv
        >>> class StandTall(PDCharacterEnv):
        ...     def __init__(self, character, num_envs, *, max_episode_steps=300, **kwargs):
        ...         super().__init__(character, num_envs, max_episode_steps=max_episode_steps, **kwargs)
        ...         self.make_specs()
        ...
        ...     def observe(self, ids):
        ...         state, _ = self.see(ids)
        ...         return {"observation": state, "goal": state[:, :0]}
        ...
        ...     def reward(self):
        ...         return self.com[:, 2].clone()
        >>> env = StandTall("humanoid", num_envs=2, seed=0)
        >>> env.rollout(3)["next", "reward"].shape
        torch.Size([2, 3, 1])
    """

    num_reward_terms = 0
    """Number of terms of the task's reward that the ``reward_weights`` of a curriculum may weigh."""

    units: Mapping[str, str] = MappingProxyType(UNITS)

    @checked
    def __init__(
        self,
        character: str,
        num_envs: Count,
        *,
        max_episode_steps: Count,
        episode: Mapping[str, Tensor] = MappingProxyType({}),
        curriculum: Curriculum | Mapping[str, Any] | None = None,
        furnish: Callable[[mujoco.MjSpec], None] = lambda spec: None,
        physics_timestep: Positive | None = None,
        self_collision: bool = False,
        friction_cone: Cone = "pyramidal",
        terminate_on_fall: bool = True,
        **kwargs: Any,
    ) -> None:
        if character not in CHARACTERS:
            raise ValueError(f"character={character!r} is unknown: pass one of {', '.join(CHARACTERS)}")
        self.character = CHARACTERS[character]
        self.curriculum = Curriculum.of(curriculum)
        weights = self.curriculum.reward_weights
        if weights is not None and len(weights) != self.num_reward_terms:
            raise ValueError(
                f"reward_weights={list(weights)}: {type(self).__name__} has {self.num_reward_terms} terms to weigh, "
                "pass as many numbers, or None"
            )
        spec = self.character.spec(self_collision=self_collision)
        self._bodies = [body.name for body in spec.bodies[1:]]
        spec.option.cone = CONES[friction_cone]
        add_ground(spec)
        furnish(spec)
        if physics_timestep is not None:
            spec.option.timestep = physics_timestep
        substeps = round(CONTROL_TIMESTEP / spec.option.timestep)
        if substeps < 1 or not math.isclose(substeps * spec.option.timestep, CONTROL_TIMESTEP, rel_tol=1e-6):
            raise ValueError(
                f"physics_timestep={spec.option.timestep} does not divide the control step of 1/30 s: pass 1/30 "
                "divided by a whole number, such as 1/120"
            )
        model = spec.compile()
        self.scene = spec.to_xml()
        super().__init__(
            model,
            num_envs,
            substeps=substeps,
            max_episode_steps=max_episode_steps,
            episode=episode if weights is None else {TASK_REWARD: torch.zeros((), dtype=torch.float64), **episode},
            outputs=["xpos", "xquat", "cvel", "subtree_com", "geom_xpos", "geom_xmat"],
            persistent=True,
            current=True,
            **kwargs,
        )
        self.terminate_on_fall = terminate_on_fall
        self.initial_states = InitialStates(
            character, self.curriculum.initial_states, self.curriculum.motions, self.device
        )
        self._scale = torch.from_numpy(model.actuator_ctrlrange @ [-0.5, 0.5]).to(self.device)
        self._rest = torch.from_numpy(model.qpos0).to(self.device)
        self._centre = torch.from_numpy(rest_controls(model)).to(self.device)
        self._mocap_rest: dict[str, Tensor] = {}  # of objects that are put, in the scene's rest pose
        if model.nmocap:
            data = mujoco.MjData(model)
            rest = {"mocap_pos": data.mocap_pos, "mocap_quat": data.mocap_quat}
            self._mocap_rest = {name: torch.from_numpy(value.copy()).to(self.device) for name, value in rest.items()}
        shapes = falling_geoms(model, self.character.feet, len(self._bodies))
        self._falling = [as_array(part.to(self.device)) for part in shapes]
        self.observation_layout = state_layout(self._bodies)
        # Live views, made once. Body 0 is the world; the character's bodies come next, and then the task's objects.
        bodies = slice(1, 1 + len(self._bodies))
        outputs = self.simulation.outputs
        self._positions = outputs["xpos"][:, bodies]
        self._orientations = outputs["xquat"][:, bodies]
        self.com = outputs["subtree_com"][:, 1]
        self.track(com=self.com)
        self._geom_heights = as_array(outputs["geom_xpos"])[..., 2]
        # Columns by component index are several times as fast as rows of matrices.
        self._geom_axes = as_array(outputs["geom_xmat"]).reshape(num_envs, -1)
        axes = torch.tensor([[6], [7], [8]])
        self._vertical_columns = as_array((9 * shapes[0] + axes).flatten().to(self.device))
        self._seen = [as_array(outputs[key])[:, 1:] for key in ("xpos", "xquat", "cvel")]
        trees = torch.from_numpy(model.body_rootid[1:]).to(self.device)
        self._centres = as_array(outputs["subtree_com"]), as_array(trees if len(trees.unique()) > 1 else trees[:1])

    @classmethod
    def characters(cls) -> tuple[str, ...]:
        """See :meth:`CharacterEnv.characters`: all known characters."""
        return tuple(CHARACTERS)

    def mirrors(self) -> dict[str, Mirror]:
        """See :meth:`CharacterEnv.mirrors`.

        Raises:
            ValueError: If the frames of right and left bodies are not mirror images of each other.
        """
        require_mirror_images(self.character.spec().compile(), self.character.sides)
        return {
            "observation": mirror_state(self._bodies, sides=self.character.sides),
            "goal": self.goal_mirror(),
            "action": mirror_actions(self.simulation.model, sides=self.character.sides),
        }

    def goal_mirror(self) -> Mirror:
        """Return the reflection of ``goal`` that exchanges left and right, for :meth:`mirrors`."""
        return super().mirrors()["goal"]

    def heading(self, ids: Tensor | slice = ALL) -> Tensor:
        """Heading of characters, in radians from the world's x axis, shape ``(n,)``, float64."""
        return heading(self._orientations[ids, 0])

    def fallen(self) -> Tensor:
        """Whether a body other than the feet touches the ground, shape ``(N,)``, bool."""
        heights, half_sizes, radii = self._geom_heights[:, self._falling[0]], *self._falling[1:]
        vertical = self._geom_axes[:, self._vertical_columns].reshape(len(heights), 3, -1).swapaxes(1, 2)
        return as_tensor((lowest_points(heights, vertical, half_sizes, radii) < 0).any(-1))

    def pose(self, body: str) -> tuple[Tensor, Tensor]:
        """Position ``(N, 3)`` and orientation ``(N, 4)`` of a body of the scene, by its name, as live views."""
        index = self.simulation.model.body(body).id
        outputs = self.simulation.outputs
        return outputs["xpos"][:, index], outputs["xquat"][:, index]

    def see(self, ids: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Return the state s of characters, and the objects around them.

        Args:
            ids: The simulations, as indices ``(n,)`` or the slice of all.

        Returns:
            The state ``(n, S)``, and for each of M objects, in the order of the scene, position relative to the root,
            orientation, linear and angular velocity in the character's heading frame, ``(n, M, 13)``.
        """
        seen = character_state(self.heading(ids).to(self._dtype), self._body_states(ids))
        size = 1 + 13 * len(self._bodies)
        return seen[:, :size], seen[:, size:].unflatten(-1, (-1, 13))

    def training_reward(self) -> Tensor:
        """Reward of the last step with the curriculum's ``reward_weights``, ``(N,)``, float64.

        A task whose reward has several terms (``num_reward_terms``) defines this method.
        """
        raise NotImplementedError

    def make_specs(self) -> None:
        """See :meth:`CharacterEnv.make_specs`.

        Raises:
            ValueError: If the curriculum mixes ranges, but the task has none.
        """
        if self.curriculum.mixture and not hasattr(self, "ranges"):
            raise ValueError(f"mixture mixes ranges, but {type(self).__name__} has none: leave it out")
        super().make_specs()

    def _outcome(self, diverged: Tensor) -> tuple[Tensor, Tensor]:
        """Reward and end of the step. A fall earns nothing, and ends the episode with ``terminate_on_fall``."""
        fallen = self.fallen()
        reward, terminated = super()._outcome(diverged)
        reward = reward.masked_fill(fallen, 0.0)
        terminated = terminated | (fallen & self.terminate_on_fall)
        if self.curriculum.reward_weights is None:
            return reward, terminated
        self.episode[TASK_REWARD].copy_(reward)[diverged] = 0.0
        return self.one_each("training_reward", self.training_reward()).masked_fill(fallen, 0.0), terminated

    def _observed_of(self, ids: Tensor | slice) -> dict[str, Tensor]:
        observed = self.observe(ids)
        if TASK_REWARD in self.episode:
            observed[TASK_REWARD] = self.episode[TASK_REWARD][ids].unsqueeze(-1)
        return observed

    def _body_states(self, ids: Tensor | slice) -> BodyStates:
        """States of all bodies in the world, in ``dtype``; stored by component, for speed."""
        rows = ids if isinstance(ids, slice) else as_array(ids)
        centres, trees = self._centres
        seen = (*(part[rows] for part in self._seen), centres[rows][:, trees])
        positions, orientations, twists, centres = map(by_component, seen)
        positions = contiguous(positions)
        angular = contiguous(twists[:, :3])
        linear = origin_velocities(angular, twists[:, 3:], positions - centres)
        parts = (positions, orientations, linear, angular)
        return BodyStates(*(converted(part, self._dtype).permute(2, 0, 1) for part in parts))

    def _action_bounds(self) -> Tensor:
        return torch.tensor([-1.0, 1.0]).expand(self.simulation.model.nu, 2)

    def _controls(self, action: Tensor) -> Tensor:
        return self._centre + action * self._scale

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """Return the scene at rest, with the character as the curriculum says.

        Tasks add what they draw.
        """
        qvel = torch.zeros(num, self.simulation.model.nv, dtype=torch.float64, device=self.device)
        start = self.initial_states.fill({"qpos": self._rest.repeat(num, 1), "qvel": qvel}, self.generator)
        start |= {name: rest.repeat(num, 1, 1) for name, rest in self._mocap_rest.items()}
        return start

    def first_episodes(self) -> dict[str, Tensor]:
        """Elapsed steps, if the curriculum shortens first episodes."""
        if not self.curriculum.random_first_length:
            return {}
        return {"elapsed_steps": (self._everybody * self.max_episode_steps // self.num_envs).unsqueeze(-1)}
