"""Environments of Gymnasium, side by side in one process."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from torchrl.data import Composite, Unbounded
from torchrl.envs import GymWrapper, default_info_dict_reader

from torchrl_mcp.adapters.adapter import Adapter, described
from torchrl_mcp.values import Count, Names

RGB_ARRAY = "rgb_array"

FRAMES_PER_SECOND = 20
"""Steps per second of environments whose metadata do not say it."""

FINAL = ("final_observation", "final_obs")
"""Entries by which environments that reset themselves tell of the true last observation."""


class GymnasiumEnvs(Adapter):
    """N environments of Gymnasium side by side, for ``task=gymnasium``.

    They are a ``SyncVectorEnv`` of Gymnasium in TorchRL's ``GymWrapper``. With ``collector=processes`` each process has
    one. If there is a single environment, as in films, it has ``render_mode="rgb_array"``.

    Args:
        id: Name for ``gymnasium.make``, such as ``HalfCheetah-v5`` or ``module:name``.
        num_envs: Number N of environments.
        seed: Seed of the first environment; the others have the seeds that follow.
        kwargs: Further arguments of ``gymnasium.make``.
        info: Names of entries of ``info`` that are metrics, such as ``is_success``.
        max_episode_steps: Steps after which an episode is ``truncated``; None for the limit of Gymnasium.
        **settings: Passed on to :class:`~torchrl_mcp.adapters.adapter.Adapter`.

    Raises:
        ValueError: If there is no such environment, or for the reasons of
            :class:`~torchrl_mcp.adapters.adapter.Adapter`.

    Example:
        >>> from torchrl_mcp.adapters.gym import GymnasiumEnvs
        >>> env = GymnasiumEnvs("Pendulum-v1", 2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 3])
    """

    def __init__(
        self,
        id: str | None,
        num_envs: Count,
        *,
        seed: int | None = None,
        kwargs: Mapping[str, Any] = MappingProxyType({}),
        info: Names = (),
        max_episode_steps: Count | None = None,
        **settings: Any,
    ) -> None:
        if id is None:
            raise ValueError("no environment is named: pass task.pretrain.id=NAME, such as HalfCheetah-v5")
        limit = {} if max_episode_steps is None else {"max_episode_steps": max_episode_steps}
        probe = _made(id, {**limit, **kwargs})
        kinds = _kinds(probe, info, id) if info else {}
        drawn = num_envs == 1 and RGB_ARRAY in probe.metadata.get("render_modes", ())
        arguments = {**({"render_mode": RGB_ARRAY} if drawn else {}), **limit, **kwargs}
        makers = [lambda: Informing(_made(id, arguments), info)] * num_envs
        batch = SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)
        env = GymWrapper(batch)
        if info:
            specs = {name: Unbounded((num_envs,), dtype=kind) for name, kind in kinds.items()}
            env.set_info_dict_reader(default_info_dict_reader(list(info), Composite(specs, shape=[num_envs])))
        known = {
            "max_episode_steps": probe.spec and probe.spec.max_episode_steps,
            "control_timestep": 1 / (probe.metadata.get("render_fps") or FRAMES_PER_SECOND),
            "metrics": info,
            "render": (lambda index: batch.envs[index].render()) if batch.render_mode == RGB_ARRAY else None,
            "name": id,
        }
        probe.close()
        super().__init__(env, **{**known, **settings})
        if seed is not None:
            self.set_seed(seed)


class Informing(gymnasium.Wrapper):
    """An environment that tells the named entries of ``info`` alone, which are fast to put side by side.

    Args:
        env: The environment.
        names: Names of the entries.
    """

    def __init__(self, env: gymnasium.Env, names: Sequence[str]) -> None:
        super().__init__(env)
        self._names = names

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        observation, info = self.env.reset(**kwargs)
        return observation, self._named(info)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take an action.

        Raises:
            ValueError: If the environment resets itself.
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if finals := [name for name in FINAL if name in info]:
            raise ValueError(
                f"the environment resets itself (info has {finals[0]}): take off the wrapper that resets it"
            )
        return observation, reward, terminated, truncated, self._named(info)

    def _named(self, info: Mapping[str, Any]) -> dict[str, Any]:
        return {name: info[name] for name in self._names if name in info}


def _made(id: str, arguments: Mapping[str, Any]) -> gymnasium.Env:
    """Return an environment by its name."""
    try:
        env = gymnasium.make(id, **arguments)
    except (gymnasium.error.Error, ImportError, TypeError) as error:
        raise ValueError(f"gymnasium.make cannot make id={id}: {error}") from error
    except Exception as error:  # others' environments raise anything, for example with another version of MuJoCo
        raise ValueError(f"gymnasium.make cannot make id={id}: {described(error)}") from error
    wrapper: Any = env
    while isinstance(wrapper, gymnasium.Wrapper):
        if isinstance(wrapper, gymnasium.wrappers.Autoreset):
            raise ValueError(f"id={id} has the wrapper Autoreset, but episodes are reset by the loop: make it without")
        wrapper = wrapper.env
    return env


def _kinds(env: gymnasium.Env, names: Sequence[str], id: str) -> dict[str, torch.dtype]:
    """Return the types of entries of ``info``, of the first step of an episode."""
    env.reset(seed=0)
    env.action_space.seed(0)
    *_, info = env.step(env.action_space.sample())
    if missing := [name for name in names if name not in info or np.ndim(info[name])]:
        numbers = ", ".join(name for name, value in info.items() if not np.ndim(value)) or "nothing"
        raise ValueError(f"info=[{missing[0]}] must name a number of id={id}: after a step, its info has {numbers}")
    return {name: torch.as_tensor(np.asarray(info[name])).dtype for name in names}
