"""Gymnasium environments of a single simulation."""

import math
from importlib.resources import files
from typing import Any

import gymnasium
import numpy as np
import torch
import yaml  # type: ignore[import-untyped]
from tensordict import TensorDict, TensorDictBase
from torchrl.data import TensorSpec

from torchrl_mcp import envs
from torchrl_mcp.envs.base import CharacterEnv
from torchrl_mcp.envs.motions import generated_library


class GymnasiumEnv(gymnasium.Env):
    """A single simulation of a task with Gymnasium's interface; training with many at once is several times faster.

    A copy, or what is unpickled, is a new simulation in the same state, with the same random numbers ahead.

    The observation is a dictionary of ``observation`` and ``goal``; ``info`` has the task's metrics, such as
    ``success`` of carrying and dribbling. ``gymnasium.make(max_episode_steps=)`` can only shorten episodes; a longer
    limit is the task's: ``GymnasiumEnv(Heading, character="biped", max_episode_steps=900)``.

    Args:
        task: The task's class.
        render_mode: ``"rgb_array"`` to draw, or None.
        **kwargs: Passed on to the task.

    Raises:
        ValueError: If ``render_mode`` is another.

    Example:
        >>> import torchrl_mcp.envs
        >>> env = gymnasium.make("torchrl_mcp/Heading-Biped-v0")
        >>> observation, info = env.reset(seed=0)
        >>> {name: value.shape for name, value in observation.items()}
        {'observation': (105,), 'goal': (2,)}
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, task: type[CharacterEnv], *, render_mode: str | None = None, **kwargs: Any) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode={render_mode!r} is unknown: pass rgb_array, or None")
        self._made = {"task": task, "render_mode": render_mode, **kwargs}
        self.env = task(num_envs=1, num_threads=1, **kwargs)
        self.metadata = {**self.metadata, "render_fps": round(1 / self.env.control_timestep)}
        self.render_mode = render_mode
        bounds = self.env.action_spec.space
        low = bounds.low[0].numpy()
        high = bounds.high[0].numpy()
        dtype = _dtype(self.env.action_spec)
        self.action_space = gymnasium.spaces.Box(low, high, dtype=dtype)
        observed = {key: self.env.observation_spec[key] for key in ("observation", "goal")}
        self.observation_space = gymnasium.spaces.Dict(
            {key: gymnasium.spaces.Box(-np.inf, np.inf, spec.shape[1:], _dtype(spec)) for key, spec in observed.items()}
        )

    def __getstate__(self) -> dict[str, Any]:
        """Return what rebuilds the environment, and its state: MuJoCo's batch itself cannot be copied."""
        rest = {name: value for name, value in vars(self).items() if name not in ("env", "metadata")}
        return {**rest, "state": self.env.get_extra_state()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Rebuild the environment in a state."""
        self.__init__(**state["_made"])  # type: ignore[misc]
        self.env.set_extra_state(state["state"])
        self.env.reset()  # to that state
        vars(self).update({name: value for name, value in state.items() if name != "state"})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode, after seeding with ``seed`` if given."""
        super().reset(seed=seed)
        if seed is not None:
            self.env.set_seed(seed)
        outcome = self.env.reset()
        return self._observed(outcome), self._measured(outcome)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Take an action."""
        given = TensorDict({"action": torch.as_tensor(action, dtype=self.env.action_spec.dtype).unsqueeze(0)}, [1])
        outcome = self.env.step(given)["next"]
        terminated = outcome["terminated"].item()
        truncated = outcome["truncated"].item()
        return self._observed(outcome), outcome["reward"].item(), terminated, truncated, self._measured(outcome)

    def render(self) -> np.ndarray | None:
        """Draw the simulation, shape ``(height, width, 3)``, uint8, or return None without ``render_mode``."""
        return self.env.render().numpy() if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Free the camera."""
        self.env.close()

    def _measured(self, outcome: TensorDictBase) -> dict[str, float]:
        metrics: dict[str, float] = {}
        for key, names in self.env.metric_names.items():
            metrics |= zip(names, outcome[key][0].tolist(), strict=True)
        return metrics

    def _observed(self, outcome: TensorDictBase) -> dict[str, np.ndarray]:
        return {key: outcome[key][0].numpy() for key in ("observation", "goal")}


def _dtype(spec: TensorSpec) -> type[np.floating]:
    return np.float64 if spec.dtype is torch.float64 else np.float32


def make(task: str, character: str, **kwargs: Any) -> GymnasiumEnv:
    """Return an environment that Gymnasium knows by name, with the defaults of its task.

    Holdout has all directions, and imitation follows the generated motions with the reward of ``imitation=fast``.

    Args:
        task: Name of the task's class.
        character: Name of the character.
        **kwargs: Passed on to :class:`GymnasiumEnv`.
    """
    kind = getattr(envs, task)
    if task == "Holdout":
        return GymnasiumEnv(kind, **{"directions": (0.0, 2 * math.pi), **kwargs})
    if task == "Imitation":
        terms = yaml.safe_load(files("torchrl_mcp.conf").joinpath("imitation/fast.yaml").read_text())["terms"]
        clips = kwargs.pop("clips", None) or generated_library(character, seed=0)
        kwargs = {"clips": clips, "terms": terms, **kwargs}
    return GymnasiumEnv(kind, character=character, **kwargs)
