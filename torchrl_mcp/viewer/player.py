"""The player that viewers share: a policy in one simulation, step by step."""

from typing import NamedTuple

import mujoco
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.envs.rendering import Shape
from torchrl_mcp.envs.scenery import extent, scenery
from torchrl_mcp.methods.transforms import TransformedCharacterEnv


class Weights(NamedTuple):
    """The weight of each primitive.

    Args:
        title: What they are.
        values: Of the K primitives, from 0 to 1.
    """

    title: str
    values: list[float]


class Player:
    """A policy playing the first of a batch of simulations, episode after episode.

    Args:
        policy: From what the environment shows to ``action``, on the CPU.
        env: Environments.
        deterministic: Play the deterministic action rather than a sample.
        num_options: Number of options among which the policy chooses, 0 if it does not.
        aside: How far beside the character to draw a ghost, in units of the character's extent.

    Attributes:
        env: The environments without transforms.
        extent: How far the character extends from its centre of mass, in metres.
        began: Whether an episode has just begun.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        env: CharacterEnv | TransformedCharacterEnv,
        *,
        deterministic: bool = True,
        num_options: int = 0,
        aside: float = 1.0,
    ) -> None:
        self.env: CharacterEnv = env.base_env if isinstance(env, TransformedCharacterEnv) else env
        self.extent = extent(self.env.simulation.model)
        self.began = True
        self._policy, self._transformed, self._num_options = policy, env, num_options
        self._exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        self._aside = aside * self.extent
        self._state = env.reset()
        self._decision = self._state.empty()

    @torch.no_grad()
    def step(self) -> None:
        """Let the policy act once."""
        with set_exploration_type(self._exploration):
            self._decision = self._policy(self._state.select(*self._policy.in_keys))
        step, self._state = self._transformed.step_and_maybe_reset(self._state.update(self._decision))
        self.began = bool(step["next", "done"][0])

    @property
    def weights(self) -> Weights | None:
        """Gates of the last step, or 1 for the option that acted and 0 for the others; None without either."""
        if "gates" in self._decision:
            return Weights("gates", self._decision["gates"][0].tolist())
        if self._num_options and "option" in self._decision:
            active = torch.nn.functional.one_hot(self._decision["option"][0], self._num_options)
            return Weights("option", active.tolist())
        return None

    @property
    def data(self) -> mujoco.MjData:
        """The simulation now; the next step may write over it."""
        return self.env.simulation.data(0)

    @property
    def shapes(self) -> list[Shape]:
        """What to draw beside the simulation now."""
        return scenery(self.env, aside=self._aside)
