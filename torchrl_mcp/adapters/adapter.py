"""The adapter that makes environments of other libraries satisfy the contract."""

import inspect
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase, SerialEnv, step_mdp

from torchrl_mcp.adapters.contract import entry_names
from torchrl_mcp.adapters.reading import Number, Scaling, Vector, require_finite
from torchrl_mcp.values import Count, Finite, Names, Positive, Range, Rule, is_list

GOALS = ("desired_goal", "goal")
"""Keys of the goal, of which the first that is observed is taken by default; Gymnasium's is ``desired_goal``."""

LIMITS = ("max_episode_steps", "max_episode_length")
"""Attributes of environments with the number of steps of an episode; Isaac Lab's and mjlab's is the second."""

CONTROL_TIMESTEP = 0.05
"""Seconds of a step of environments that do not say how long it is; only films show it."""


# Keys of observations, of which nested keys are lists of names
Keys = Annotated[
    Sequence[NestedKey],
    Rule("a list of names", lambda value: is_list(value, lambda item: is_list(item, _is_name) or _is_name(item))),
]


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


class Adapter(EnvBase):
    r"""A batch of TorchRL environments, extended by what training, evaluation and films need.

    The adapter satisfies :class:`~torchrl_mcp.adapters.contract.Environments`. Inputs are concatenated to the vectors
    ``observation`` ``(N, S)`` and ``goal`` ``(N, G)``, float32. Actions ``(N, A)`` from -1 to 1 are scaled to the
    bounds of the environments.

    Args:
        env: Environments, batch size ``[N]``: any ``EnvBase``, such as TorchRL's ``SerialEnv``, ``ParallelEnv``,
            ``GymWrapper`` of a ``VectorEnv``, or a wrapper of a batched simulator.
        observation: Keys of the state of the policy, in order.
        goal: Keys of the goal of the policy, in order; ``()`` for environments without a goal. None takes
            ``desired_goal`` or ``goal`` if the environments observe one of them.
        goal_number: Key of the number of each episode's goal, one-hot or an integer; None for environments without such
            a number. ``method=hierarchical`` needs it in pre-training, because it trains a primitive for each goal.
        metrics: Keys of flags (bool) and numbers that are not inputs of the policy, such as ``success``.
        max_episode_steps: Steps after which an episode is ``truncated``, if it has not ended before. None takes the
            attribute of ``env`` of this name or ``max_episode_length``.
        worst: Return at which the normalised return is 0.
        solved: Return at which the normalised return is 1. With ``worst`` 0 and ``solved`` 1, the normalised return is
            the return itself.
        action_bounds: Lowest and highest action, in place of the bounds of ``env.action_spec``.
        control_timestep: Seconds of a step.
        render: Function that draws the environment of an index, ``(height, width, 3)``, uint8; None for no films.
        snapshots: Whether ``env.state_dict()`` contains the whole state of the environments, including their random
            generators, so that they continue from there after ``load_state_dict``. A resumed run is then the same bit
            for bit; otherwise it begins new episodes, with another seed.
        name: Name of the environments in errors; their class by default.

    Raises:
        ValueError: If the environments have no batch, no finite episodes, or inputs and actions of other kinds.

    Example:
        >>> from torchrl.envs import GymEnv, SerialEnv
        >>> env = Adapter(SerialEnv(2, lambda: GymEnv("Pendulum-v1")), max_episode_steps=200, worst=-1600, solved=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 3])
        >>> env.normalised_return(torch.tensor(-400.0))
        tensor(0.7500)
    """

    batch_locked = True
    num_diverged = 0
    goal_layout: Mapping[str, slice] = MappingProxyType({})

    def __init__(
        self,
        env: EnvBase,
        *,
        observation: Keys = ("observation",),
        goal: Keys | None = None,
        goal_number: NestedKey | None = None,
        metrics: Names = (),
        max_episode_steps: Count | None = None,
        worst: Finite = 0.0,
        solved: Finite = 1.0,
        action_bounds: Range | None = None,
        control_timestep: Positive = CONTROL_TIMESTEP,
        render: Callable[[int], Any] | None = None,
        snapshots: bool = False,
        name: str = "",
    ) -> None:
        name = name or type(env).__name__
        if len(env.batch_size) != 1:
            raise ValueError(
                f"{name} has the batch size {list(env.batch_size)}, but N environments side by side have [N]: wrap it "
                "in torchrl.envs.SerialEnv(N, ...)"
            )
        limit = max_episode_steps or _limit(env)
        if not limit:
            raise ValueError(f"{name} has no limit on the length of its episodes: pass max_episode_steps=STEPS")
        if solved == worst:
            raise ValueError(f"worst={worst} and solved={solved} must differ, because returns are scaled to them")
        super().__init__(device=env.device or torch.device("cpu"), batch_size=env.batch_size)
        self.is_closed = False  # collectors close what is open
        self.name = name
        self.num_envs: int = env.batch_size[0]
        self.max_episode_steps = int(limit)
        self.control_timestep = control_timestep
        self.resumes_episodes = snapshots
        self.physics_seconds = 0.0
        self._env = env
        self._range = worst, solved
        self._draw = render
        spec = env.observation_spec
        observed_goals = [key for key in GOALS if key in spec.keys(True)][:1]
        self._inputs = {
            "observation": Vector("observation", name, observation, spec),
            "goal": Vector("goal", name, observed_goals if goal is None else goal, spec),
        }
        self._metrics = {key: Vector("metrics", name, [key], spec) for key in metrics}
        self._flags = [key for key in metrics if spec[key].dtype is torch.bool]
        self._number = None if goal_number is None else Number(goal_number, spec)
        self.num_goals = self._number.count if self._number else 0
        self._scaling = Scaling(env, action_bounds)
        self._current: TensorDictBase | None = None  # observations and states of ``env`` for its next step
        self._elapsed = torch.zeros(self.num_envs, 1, dtype=torch.int64, device=self.device)
        self._restored = False
        self._seed: int | None = None
        self._starts = 0
        self._warned = False
        self._make_specs()

    @property
    def metric_names(self) -> dict[str, list[str]]:
        """See :class:`~torchrl_mcp.adapters.contract.Environments`."""
        return entry_names({key: vector.size for key, vector in self._metrics.items()})

    def normalised_return(self, episode_return: Tensor) -> Tensor:
        r"""Return on the scale of ``worst`` and ``solved``, :math:`\bar{R} = (R - R_0) / (R_1 - R_0)`."""
        worst, solved = self._range
        return (episode_return - worst) / (solved - worst)

    def reach(self) -> None:
        """Return None: what standing still and an ideal player earn is unknown."""

    def mirrors(self) -> dict[str, nn.Module]:
        """Raise a ``ValueError``: the mirror image of an observation is unknown."""
        raise ValueError(f"{self.name} has no mirror image, which symmetry needs: pass symmetry=none")

    def action_scaling(self) -> tuple[Tensor, Tensor]:
        """Centre and half range of the environments' own actions, to which -1 to 1 is scaled, ``(A,)`` each."""
        return self._scaling.centre, self._scaling.half

    def render(self, index: int = 0) -> Tensor:
        """Draw an environment, ``(height, width, 3)``, uint8.

        Raises:
            RuntimeError: If the environments cannot be drawn.
        """
        try:
            picture = None if self._draw is None else self._draw(index)
        except Exception as error:  # as in a step; drawing may need a package that is not installed
            raise RuntimeError(f"{self.name} cannot be drawn: {described(error)}") from error
        if picture is None:
            raise RuntimeError(
                f"{self.name} cannot be drawn: it needs a render_mode of rgb_array, or a method render(index)"
            )
        return torch.as_tensor(np.array(picture))

    def state_dict(self, *args: Any, **kwargs: Any) -> dict[str, Any]:
        """Return the state of a training: that of the episodes with ``snapshots``, else the number of starts."""
        state: dict[str, Any] = {"times_begun": self._starts}
        if self.resumes_episodes and self._current is not None:
            state["env"] = dict(self._env.state_dict())
            state["current"] = self._current.to_dict()
            state["elapsed"] = self._elapsed.clone()
        return state

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:
        """Restore a result of :meth:`state_dict`: the next reset of all environments returns to it.

        Without ``snapshots``, new episodes begin, with another seed than the first ones.
        """
        self._starts = int(state_dict["times_begun"]) + 1
        if "current" in state_dict:
            self._env.load_state_dict(state_dict["env"])
            self._current = TensorDict(state_dict["current"], self.batch_size, device=self._env.device)
            self._elapsed = state_dict["elapsed"].clone()
            self._restored = True
        elif self._seed is not None:
            seeds = np.random.SeedSequence((self._seed, self._starts)).generate_state(1)
            self._env.set_seed(int(seeds[0]) % 2**31)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Close the environments."""
        if not self.is_closed:
            self._env.close(raise_if_closed=False)
        super().close(raise_if_closed=raise_if_closed)

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step, and begin new episodes after ended ones; see ``EnvBase.step_and_maybe_reset``.

        Faster than TorchRL's, because outputs satisfy the specs and a partial reset returns all environments.
        """
        if tensordict.batch_size != self.batch_size or "next" in tensordict or "_step" in tensordict:
            return super().step_and_maybe_reset(tensordict)  # the caller sets or masks the outcome
        outcome = self._step(tensordict)
        tensordict.set("next", outcome)
        state = self._step_mdp(tensordict)
        if outcome["done"].any():
            began = self._reset(TensorDict({"_reset": outcome["done"]}, self.batch_size, device=self.device))
            self._warn_of_own_resets(outcome, began)
            state.update(began)
        return tensordict, state

    def _make_specs(self) -> None:
        shape = self.batch_size
        one = (self.num_envs, 1)
        place: dict[str, Any] = {"device": self.device}
        observed = {key: Unbounded((self.num_envs, vector.size), **place) for key, vector in self._inputs.items()}
        for key, vector in self._metrics.items():
            size = (self.num_envs, vector.size)
            observed[key] = (
                Binary(shape=size, dtype=torch.bool, **place) if key in self._flags else Unbounded(size, **place)
            )
        if self._number is not None:
            observed["goal_number"] = Categorical(self.num_goals, shape=shape, dtype=torch.int64, **place)
        self.observation_spec = Composite(observed, shape=shape, **place)
        self.action_spec = Bounded(-1.0, 1.0, shape=self._scaling.shape, dtype=torch.float32, **place)
        self.reward_spec = Unbounded(one, **place)
        done = Binary(1, shape=one, dtype=torch.bool, **place)
        dones = {key: done.clone() for key in ("done", "terminated", "truncated")}
        self.full_done_spec = Composite(dones, shape=shape, **place)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        assert self._current is not None, "reset comes before the first step"
        action = self._scaling(tensordict["action"])
        with self._called("a step"):
            step = self._env.step(self._current.set(self._env.action_key, action.to(self._env.action_spec.dtype)))
            self._current = step_mdp(step)
        outcome = step["next"]
        self._elapsed += 1
        terminated = outcome.get("terminated", torch.zeros_like(outcome["done"]))
        truncated = outcome["done"] & ~terminated | (self._elapsed >= self.max_episode_steps)
        reward = outcome["reward"].reshape(self.num_envs, 1).to(torch.float32)
        require_finite(reward, "reward", self.name)
        return self._emit(outcome, terminated.clone(), truncated).set("reward", reward)

    def _reset(
        self, tensordict: TensorDictBase | None = None, *, seed: int | None = None, **kwargs: Any
    ) -> TensorDictBase:
        if seed is not None:
            self.set_seed(seed)
        mask = None if tensordict is None else tensordict.get("_reset", None)
        no = torch.zeros(self.num_envs, 1, dtype=torch.bool, device=self.device)
        if self._restored and mask is None:
            self._restored = False
            return self._emit(self._current, no, no.clone())
        with self._called("a reset"):
            if mask is None or self._current is None:
                self._current = self._env.reset()
                self._elapsed.zero_()
            else:
                self._current = self._env.reset(self._current.set("_reset", mask.view(self.num_envs, 1)))
                self._elapsed[mask.view(self.num_envs)] = 0
        return self._emit(self._current, no, no.clone())

    def _emit(self, observed: TensorDictBase, terminated: Tensor, truncated: Tensor) -> TensorDict:
        """Return the output of the environments, without a reward."""
        emitted = {key: vector(observed) for key, vector in self._inputs.items()}
        for key, vector in self._metrics.items():
            emitted[key] = vector(observed).bool() if key in self._flags else vector(observed)
        if self._number is not None:
            emitted["goal_number"] = self._number(observed)
        emitted |= {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        return TensorDict(emitted, self.batch_size, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = seed
        self._env.set_seed(seed)

    @contextmanager
    def _called(self, what: str) -> Iterator[None]:
        """Time a call of the environments. If the call fails, the error names the environments and the call."""
        begun = time.perf_counter()
        try:
            yield
        except Exception as error:  # others' environments raise anything, also when a process of theirs has died
            raise ChildProcessError(f"{self.name} failed in {what}: {described(error)}") from error
        finally:
            self.physics_seconds += time.perf_counter() - begun

    def _warn_of_own_resets(self, outcome: TensorDictBase, began: TensorDictBase) -> None:
        """Warn once if the last observation of ended episodes is that of the next ones."""
        ended = outcome["done"].squeeze(-1)
        last, first = outcome["observation"][ended], began["observation"][ended]
        if self._warned or not torch.equal(last, first):
            return
        self._warned = True
        warnings.warn(
            f"{self.name} seems to reset itself: the last observation of an episode is the first of the next, so that "
            "values of truncated episodes are wrong. Turn its own resets off, or append the transform "
            "torchrl_mcp.adapters.autoreset.RepeatObservation",
            stacklevel=2,
        )


class OwnEnvs(Adapter):
    """Environments that a function makes, for ``task=torchrl``.

    Args:
        env: Function ``env(num_envs=, seed=)`` that makes environments of batch size ``[num_envs]``. A function without
            ``num_envs`` makes a single environment, and TorchRL's ``SerialEnv`` puts several side by side; if the
            function takes a seed, the i-th environment has ``seed + i``. Films call the method ``render(index)`` of the
            environments, if there is one; it returns what :meth:`Adapter.render` returns.
        num_envs: Number of environments.
        seed: Seed of the environments.
        **settings: Passed on to :class:`Adapter`.

    Raises:
        ValueError: For the reasons of :class:`Adapter`.
    """

    def __init__(
        self, env: Callable[..., EnvBase], num_envs: Count, *, seed: int | None = None, **settings: Any
    ) -> None:
        maker = env.func if isinstance(env, partial) else env
        # The signature of a class of environments is that of TorchRL's metaclass.
        taken = inspect.signature(maker.__init__ if inspect.isclass(maker) else maker).parameters
        seeds = [{"seed": None if seed is None else seed + i} if "seed" in taken else {} for i in range(num_envs)]
        if "num_envs" in taken:
            made = env(num_envs=num_envs, **seeds[0])
        else:
            made = SerialEnv(num_envs, env, create_env_kwargs=seeds)
        super().__init__(made, **{"render": _render(made), **settings})
        if seed is not None:
            self.set_seed(seed)


def described(error: Exception) -> str:
    """Return the type, the message and the place of an error of another library."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({frame.filename}, line {frame.lineno})"


def _limit(env: EnvBase) -> int | None:
    """Return the number of steps of an episode that environments name, if they do."""
    values = (getattr(env, name, None) for name in LIMITS)
    return next((value for value in values if isinstance(value, int)), None)


def _render(env: EnvBase) -> Callable[[int], Any] | None:
    """Return the method ``render(index)`` of environments, if there is one; libraries have others of the same name."""
    render = getattr(type(env), "render", None)
    return env.render if render is not None and "index" in inspect.signature(render).parameters else None
