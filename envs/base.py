"""The base class of all environments. Read :meth:`CharacterEnv._step` for what happens in a step, in order."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_mcp.adapters.contract import Reach, entry_names
from torchrl_mcp.envs.characters.mirror import Mirror
from torchrl_mcp.envs.physics.engines import Engine, named
from torchrl_mcp.envs.physics.simulation import LARGEST
from torchrl_mcp.envs.rendering.camera import Arrow, Camera
from torchrl_mcp.envs.steering import Steerable, UserGoal
from torchrl_mcp.values import Count, Whole, checked

ALL = slice(None)
"""Index of all simulations that makes no copy."""


class CharacterEnv(EnvBase):
    """N copies of a character with a task, simulated side by side in one process.

    **Division of labour.** A task defines :meth:`initial_state`, :meth:`observe` and :meth:`reward`. If necessary, it
    also defines :meth:`after_step`, :meth:`terminated`, :meth:`truncated`, :meth:`update_goal`,
    :meth:`normalised_return` and :meth:`steer`. Its constructor ends with :meth:`make_specs`. This class does the
    rest: stepping, specs, partial resets, seeding, time limit, snapshots and divergence.

    **State.** Variables of a task beyond the physics, such as a goal, are kept in ``episode``, which snapshots include.

    **Stepping.** All simulations step together, even under TorchRL's mask ``_step``, which only masks their outputs.

    **Divergence.** A simulation that diverges or gets a non-finite action ends only its own episode. It is
    ``terminated``, with reward 0 and the observation from before the step, and ``num_diverged`` counts it.

    Args:
        model: Character and scene.
        num_envs: Number N of simulations.
        substeps: Physics steps per action.
        max_episode_steps: Actions until an episode is ``truncated``.
        episode: Variables of the task in one simulation at the beginning of an episode, by name. They are stored as
            ``(N, ...)``.
        outputs: See :data:`~torchrl_mcp.envs.physics.engines.Engine`.
        model_fields: See :data:`~torchrl_mcp.envs.physics.engines.Engine`.
        physics: The engine: ``"mujoco"`` (threads on the CPU, in float64), ``"warp"`` (MuJoCo Warp, in float32), or
            another :data:`~torchrl_mcp.envs.physics.engines.Engine`.
        device: Device of simulations, rewards and outputs. With ``"mujoco"`` it must be the CPU.
        seed: Seed of ``generator``, or None to draw one.
        num_threads: Threads of the physics; 0 takes one per processor. Results do not depend on this number.
        persistent: See :data:`~torchrl_mcp.envs.physics.engines.Engine`.
        current: See :data:`~torchrl_mcp.envs.physics.engines.Engine`.
        dtype: Type of the outputs; rewards are computed in float64, physics in the type of the engine.
        pin_memory: Return pinned tensors, which copy to a CUDA device without blocking. (Under transforms,
            TorchRL merges the outputs of a partial reset into new tensors, which are not pinned.)

    Raises:
        ValueError: If an argument is out of range.

    Example:
        Every task has these methods, for example :class:`.Heading`.

        >>> from torchrl_mcp.envs import Heading
        >>> env = Heading("biped", num_envs=2, seed=0)
        >>> env.observation_layout["root.linear_velocity"], env.goal_layout["direction"], env.control_timestep
        (slice(8, 11, None), slice(0, 2, None), 0.0333)
        >>> state = env.get_state()
        >>> first, again = (env.reset(state, set_state=True)["observation"] for _ in range(2))
        >>> first.equal(again)
        True
    """

    scene: str = ""
    """MJCF of the character in its scene; empty if a task does not provide it."""

    observation_layout: Mapping[str, slice] = MappingProxyType({})
    """Slices of ``observation`` by name, in order; empty if a task does not name them."""

    goal_layout: Mapping[str, slice] = MappingProxyType({})
    """Slices of ``goal`` by name, in order; empty if a task does not name them."""

    units: Mapping[str, str] = MappingProxyType({})
    """Units of the entries of ``observation`` and ``goal``, by name or by what follows its last dot."""

    resumes_episodes = True
    """See :class:`~torchrl_mcp.adapters.contract.Environments`."""

    batch_locked = True
    _supports_set_state = True

    @checked
    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: Count,
        *,
        substeps: Count,
        max_episode_steps: Count,
        episode: Mapping[str, Tensor] = MappingProxyType({}),
        outputs: Sequence[str] = (),
        model_fields: Sequence[str] = (),
        physics: str | Engine = "mujoco",
        device: torch.device | str = "cpu",
        seed: int | None = None,
        num_threads: Whole = 0,
        persistent: bool = False,
        current: bool = False,
        dtype: torch.dtype = torch.float32,
        pin_memory: bool = False,
    ) -> None:
        if pin_memory and not torch.cuda.is_available():
            raise ValueError("pin_memory=True needs a CUDA device, but none is available: pass False")
        super().__init__(device=torch.device(device), batch_size=[num_envs])
        self.num_envs = num_envs
        self.substeps = substeps
        self.max_episode_steps = max_episode_steps
        self.control_timestep = substeps * model.opt.timestep
        self.simulation = named(physics)(
            model,
            num_envs,
            device=self.device,
            substeps=substeps,
            outputs=outputs,
            model_fields=model_fields,
            num_threads=num_threads,
            persistent=persistent,
            current=current,
        )
        blank = {"elapsed_steps": torch.zeros(1, dtype=torch.int64), **episode}
        self._blank = {key: value.to(self.device) for key, value in blank.items()}
        self.episode = {key: value.repeat(num_envs, *[1] * value.ndim) for key, value in self._blank.items()}
        self._tracked: dict[str, Tensor] = {}
        self.num_diverged = 0
        self._everybody = torch.arange(num_envs).to(self.device)
        self._snapshot: TensorDict | None = None
        self._observed: dict[str, Tensor] = {}
        self.generator = torch.Generator(self.device)
        self.set_seed(seed)
        self._dtype = dtype
        self._pin_memory = pin_memory
        self._camera: tuple[tuple[int, int], Camera] | None = None

    @abstractmethod
    def initial_state(self, num: int) -> dict[str, Tensor]:
        """Draw the states of ``num`` episodes at their beginning, with ``generator``.

        Returns:
            ``qpos``, ``qvel``, other state fields of the simulation, and entries of ``episode`` that differ from those
            given to the constructor, each ``(num, ...)``.
        """

    def first_episodes(self) -> dict[str, Tensor]:
        """Entries of the state with which episodes begin after a reset of all simulations, each ``(N, ...)``."""
        return {}

    @abstractmethod
    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """Observe simulations: ``observation``, ``goal`` and, for metrics, flags and numbers under other names.

        A task without a goal returns none, and emits one of shape ``(N, 0)``.

        Args:
            ids: The simulations, as indices ``(n,)`` or the slice of all.

        Returns:
            Observations, each ``(n, ...)``; live views are allowed.
        """

    @abstractmethod
    def reward(self) -> Tensor:
        """Reward of the last step, ``(N,)``, float64."""

    def after_step(self, diverged: Tensor) -> None:
        """Act right after a step: close a weld, for example, or store measurements in ``episode``.

        Args:
            diverged: Indices of simulations that did not move, shape ``(n,)``. Their rewards are ignored.
        """

    def terminated(self) -> Tensor:
        """Whether the last step ended the episode, by failure or success, ``(N,)``, bool; by default it did not."""
        return torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    def truncated(self) -> Tensor:
        """Whether to cut the episode short for another reason than the time limit, ``(N,)``, bool; by default not."""
        return torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)

    def update_goal(self) -> None:
        """Change the goal for the next action, after the reward of a step. For example, a direction wanders."""

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        r"""Return on a scale where 0 is the worst possible and 1 the best, :math:`\bar{R} = R / T`.

        :math:`R` is the undiscounted return and :math:`T` ``max_episode_steps``, for rewards from 0 to 1. The paper's
        normalisation is not documented.
        """
        return episode_return / self.max_episode_steps

    def track(self, **places: Tensor) -> None:
        """Keep the values of live views from before each step in ``episode``, for :meth:`velocity`.

        Args:
            **places: Live views of positions in metres by name, each ``(N, D)``.
        """
        self._tracked |= places
        self.episode |= {name: place.to(torch.float64, copy=True) for name, place in places.items()}

    def velocity(self, name: str) -> Tensor:
        """Mean velocity of a tracked place in the last step, in m/s, ``(N, D)``, float64."""
        return (self._tracked[name] - self.episode[name]) / self.control_timestep

    @classmethod
    def characters(cls) -> tuple[str, ...]:
        """Return the names of the characters that can do the task; empty for no restriction."""
        return ()

    def mirrors(self) -> dict[str, Mirror]:
        """Return the reflections that exchange left and right in ``observation``, ``goal`` and ``action``.

        The mirror image of a transition is a transition of the mirrored task, with the same reward.

        Raises:
            ValueError: If the character or the task has no mirror image.
        """
        raise ValueError(
            f"{type(self).__name__} has no mirror image, which symmetry needs: pass symmetry=none, or a task of biped, "
            "humanoid or T-Rex"
        )

    def reach(self) -> Reach | None:
        """Returns of standing still and of an ideal player in the present episodes, or None if they are unknown."""
        return None

    @property
    def steerable(self) -> Steerable:
        """What viewers can set of the goal with :meth:`steer`: by default nothing."""
        return Steerable()

    def steer(self, goal: UserGoal) -> None:
        """Set the goal of the first simulation as a user wants it, until the end of the next step.

        Args:
            goal: The user's goal. Quantities that are None return to the task.
        """

    @property
    def physics_seconds(self) -> float:
        """Wall-clock seconds spent inside MuJoCo so far."""
        return self.simulation.physics_seconds

    def to(self, device: torch.device | str | int) -> "CharacterEnv":
        """Return the environment itself, because the physics cannot move to another device.

        Raises:
            ValueError: If ``device`` is of another type than the physics.
        """
        if torch.device(device).type != self.device.type:
            raise ValueError(f"device={device}: the physics stays on {self.device}, so move the outputs instead")
        return self

    def root_positions(self) -> Tensor:
        """Horizontal position of each root, ``(N, 2)`` in metres, float64."""
        return self.simulation.state["qpos"][:, :2].clone()

    def get_state(self) -> TensorDict:
        """Snapshot of the whole state except ``generator``, each entry ``(N, ...)``.

        ``reset(state, set_state=True)`` restores the snapshot, and the continuation is bit-identical. A state may also
        consist of ``qpos`` and ``qvel`` alone. The other entries then have their values at the beginning of an episode
        in which the character stands at the origin and faces x.
        """
        state = {**self.simulation.state, **self.episode}
        return TensorDict({key: value.clone() for key, value in state.items()}, self.batch_size, device=self.device)

    def get_extra_state(self) -> dict[str, Any]:
        """State of a training: the snapshot, the generator and the count of divergences (``state_dict``)."""
        return {
            "snapshot": dict(self.get_state()),
            "generator": self.generator.get_state(),
            "diverged": self.num_diverged,
        }

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore a result of :meth:`get_extra_state`: the next reset of all simulations returns to the snapshot."""
        self._snapshot = TensorDict(state["snapshot"], self.batch_size, device=self.device)
        self.generator.set_state(state["generator"].cpu())
        self.num_diverged = state["diverged"]

    def render(self, index: int = 0, *, width: int = 480, height: int = 480, distance: float = 4.0) -> Tensor:
        """Draw one simulation from ``distance`` metres, shape ``(height, width, 3)``, uint8."""
        if not 0 <= index < self.num_envs:
            raise ValueError(f"index={index} is out of range: pass one of 0..{self.num_envs - 1}")
        camera = self._camera_of(width, height)
        return camera.picture(self.simulation.data(index), self.arrows(index), distance=distance)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Release the camera."""
        self._close_camera()
        super().close(raise_if_closed=raise_if_closed)

    def arrows(self, index: int) -> list[Arrow]:
        """Return arrows to the target of one simulation, for films and viewers. Tasks override this method.

        Args:
            index: The simulation.

        Returns:
            Arrows, each as tail and tip, ``(3,)`` in metres.
        """
        return []

    def _camera_of(self, width: int, height: int) -> Camera:
        """Return the camera for a picture size. Only one is kept, because each holds tens of megabytes."""
        if self._camera is None or self._camera[0] != (width, height):
            self._close_camera()
            self._camera = (width, height), Camera(self.simulation.model, width=width, height=height)
        return self._camera[1]

    def _close_camera(self) -> None:
        if self._camera is not None:
            self._camera[1].close()
            self._camera = None

    def make_specs(self) -> None:
        """Derive the specs from the observation; a task calls this at the end of its constructor."""
        shape = self.batch_size
        one = (self.num_envs, 1)
        bounds = self._action_bounds().to(self.device, self._dtype)
        low, high = bounds.expand(self.num_envs, -1, -1).unbind(-1)
        seen = {**self._observed_of(ALL)}
        name = f"{type(self).__name__}.observe()"
        if "observation" not in seen:
            raise ValueError(f"{name} lacks observation: return it, with shape ({self.num_envs}, numbers)")
        seen.setdefault("goal", torch.zeros(self.num_envs, 0, device=self.device))
        if wrong := [key for key, value in seen.items() if value.ndim != 2 or len(value) != self.num_envs]:
            raise ValueError(
                f"{wrong[0]} of {name} has shape {tuple(seen[wrong[0]].shape)}: return ({self.num_envs}, numbers)"
            )
        self._observed = {key: value.to(self._type(value), copy=True) for key, value in seen.items()}
        observed = {key: self._spec(value) for key, value in self._observed.items()}
        self.observation_spec = Composite(observed, shape=shape, device=self.device)
        self.action_spec = Bounded(low, high, dtype=self._dtype, device=self.device)
        self.reward_spec = Unbounded(one, dtype=self._dtype, device=self.device)
        done = Binary(1, shape=one, dtype=torch.bool, device=self.device)
        dones = {key: done.clone() for key in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(dones, shape=shape, device=self.device)

    def _type(self, value: Tensor) -> torch.dtype:
        """Type of an observed value in the output: flags remain bool."""
        return torch.bool if value.dtype is torch.bool else self._dtype

    def _spec(self, value: Tensor) -> Binary | Unbounded:
        kind = {"shape": value.shape, "dtype": self._type(value), "device": self.device}
        return Binary(**kind) if value.dtype is torch.bool else Unbounded(**kind)

    def _set_seed(self, seed: int | None) -> None:
        drawn = int(torch.empty((), dtype=torch.int64).random_()) if seed is None else seed
        self.generator.manual_seed(drawn)

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step all simulations and begin new episodes after ended ones; see ``EnvBase.step_and_maybe_reset``.

        Faster than TorchRL's: specs hold by construction and need no check, and ``_emit`` returns the observations of
        all simulations after a partial reset, which need no merging.
        """
        if tensordict.batch_size != self.batch_size or "next" in tensordict or "_step" in tensordict:
            return super().step_and_maybe_reset(tensordict)  # the caller sets or masks the outcome
        outcome = self._step(tensordict)
        tensordict.set("next", outcome)
        state = self._step_mdp(tensordict)
        ended = outcome["done"].view(self.num_envs).nonzero().squeeze(-1)
        if len(ended):
            state.update(self._begin_episodes(ended, {}))
        return tensordict, state

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict["action"]
        expected = (self.num_envs, self.simulation.model.nu)
        if action.shape != expected or action.device.type != self.device.type:
            raise ValueError(
                f"action has shape {tuple(action.shape)} on {action.device}: pass {expected} on {self.device}, "
                "where the physics runs"
            )
        diverged = self.simulation.step(self._controls(action))
        self.episode["elapsed_steps"] += 1
        self.after_step(diverged)
        reward, terminated = self._outcome(diverged)
        if len(diverged):
            reward[diverged] = 0.0
            terminated[diverged] = True
            self.num_diverged += len(diverged)
        for name, place in self._tracked.items():
            self.episode[name].copy_(place)
        self.update_goal()
        cut = self.one_each("truncated", self.truncated()).unsqueeze(-1)
        truncated = (self.episode["elapsed_steps"] >= self.max_episode_steps) | cut
        return self._emit(ALL, reward.unsqueeze(-1).to(self._dtype), terminated.unsqueeze(-1), truncated)

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, set_state: bool = False, seed: int | None = None
    ) -> TensorDict:
        if seed is not None:
            self.set_seed(seed)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if self._snapshot is not None and mask is None and not set_state:
            snapshot = self._snapshot
            self._snapshot = None
            return self._reset(snapshot, set_state=True)
        ids = self._everybody if mask is None else mask.view(self.num_envs).nonzero().squeeze(-1)
        if set_state:
            return self._begin_episodes(ids, self._checked(tensordict, ids))
        return self._begin_episodes(ids, self.first_episodes() if mask is None else {})

    def _begin_episodes(self, ids: Tensor, state: dict[str, Tensor]) -> TensorDict:
        """Begin episodes in the simulations ``ids``; entries that ``state`` lacks are drawn."""
        no = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        if not len(ids):
            return self._emit(ALL, None, no, no.clone())
        known = {*self.simulation.state, *self.episode}
        if not known <= state.keys():
            state = {**self.initial_state(len(ids)), **state}
        self.simulation.reset(ids, {key: state[key] for key in self.simulation.state if key in state})
        state = {**self._blank, **{name: place[ids] for name, place in self._tracked.items()}, **state}
        for key, memory in self.episode.items():
            memory[ids] = state[key].to(memory.dtype)
        return self._emit(ids if len(ids) < self.num_envs else ALL, None, no, no.clone())

    def _checked(self, tensordict: TensorDictBase | None, ids: Tensor) -> dict[str, Tensor]:
        """Rows ``ids`` of the state in ``tensordict``, after checking it."""
        known = {**self.simulation.state, **self.episode}
        ignored = {"_reset", "next", "action", "reward", *self.observation_spec.keys(), *self.done_keys} - known.keys()
        given = {} if tensordict is None else {k: v for k, v in tensordict.items() if k not in ignored}
        if missing := {"qpos", "qvel"} - given.keys():
            raise ValueError(f"set_state=True without {sorted(missing)}: pass at least qpos and qvel, or get_state()")
        for key, value in given.items():
            if key not in known:
                raise ValueError(f"{key!r} must not be in a state: remove it; a state has the parts {sorted(known)}")
            if value.shape != known[key].shape:
                raise ValueError(f"{key} has shape {tuple(value.shape)}: pass {tuple(known[key].shape)}")
            if value.dtype is not torch.bool and not (value[ids].abs() < LARGEST).all():
                raise ValueError(f"{key} is not finite, or beyond MuJoCo's limit of {LARGEST:g}: correct it")
        return {key: value[ids] for key, value in given.items()}

    def _emit(self, ids: Tensor | slice, reward: Tensor | None, terminated: Tensor, truncated: Tensor) -> TensorDict:
        """Output for all simulations, of which only ``ids`` have changed since the last output."""
        if not self._observed:
            raise RuntimeError(f"{type(self).__name__} has no specs: call make_specs() at the end of its constructor")
        for key, value in self._observed_of(ids).items():
            if isinstance(ids, slice):
                self._observed[key].copy_(value)
            else:
                self._observed[key][ids] = value.to(self._type(value))
        emitted = {key: value.clone() for key, value in self._observed.items()}
        emitted.update(terminated=terminated, truncated=truncated, done=terminated | truncated)
        if reward is not None:
            emitted["reward"] = reward
        out = TensorDict(emitted, self.batch_size, device=self.device)
        return out.pin_memory() if self._pin_memory else out

    def _action_bounds(self) -> Tensor:
        """Lower and upper bounds of the action, ``(A, 2)``: by default the bounds of the controls."""
        return torch.from_numpy(self.simulation.model.actuator_ctrlrange)

    def _controls(self, action: Tensor) -> Tensor:
        """Controls of the actuators, ``(N, A)``: by default the action."""
        return action

    def _observed_of(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """Output of simulations before rewards and ends: by default what the task observes."""
        return self.observe(ids)

    def _outcome(self, diverged: Tensor) -> tuple[Tensor, Tensor]:
        """Reward of the step (float64) and whether it ended the episode, ``(N,)`` each."""
        return self.one_each("reward", self.reward()), self.one_each("terminated", self.terminated())

    def one_each(self, method: str, value: Tensor) -> Tensor:
        """Return a copy of the value of a task's method, after checking that it has one entry for each simulation.

        The value may be a live view of the simulation or of the episode, which the next episode overwrites.

        Raises:
            ValueError: If its shape is not ``(N,)``.
        """
        if value.shape != (self.num_envs,):
            raise ValueError(
                f"{type(self).__name__}.{method}() has shape {tuple(value.shape)}: return {(self.num_envs,)}, one for "
                "each simulation"
            )
        return value.clone()

    @property
    def metric_names(self) -> dict[str, list[str]]:
        """Observations that are metrics and not inputs of the policy: the names of the entries of each key."""
        sizes = {key: value.shape[-1] for key, value in self._observed.items() if key not in ("observation", "goal")}
        return entry_names(sizes)
