"""The player of all viewers, which lets a policy act in one simulation, step by step."""

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.envs.rendering.camera import Shape
from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.viewer.scenery import extent, scenery


class Weights(NamedTuple):
    """The weights of all primitives.

    Args:
        title: Kind of weights, ``gates`` or ``option``.
        values: Weights of the K primitives, from 0 to 1.
    """

    title: str
    values: list[float]


class Player:
    """A policy that acts in a batch of environments, episode after episode; viewers show the first environment.

    Args:
        policy: From the environment's observations to ``action``, on the CPU.
        env: Environments.
        deterministic: Play the deterministic action instead of a sample.
        num_options: Number of options of the policy, 0 without options.
        aside: Distance of a ghost from the character, as a multiple of the character's extent.
        before_step: Called before each step, for example to load a newer checkpoint.

    Attributes:
        env: The environments without transforms.
        simulated: Whether the environments are MuJoCo simulations of this library; other environments render
            themselves.
        extent: Largest distance of the character from its centre of mass, in metres.
        began: Whether an episode has just begun.
        state: Current observations of the environment.
        pinned: Weights that replace the gate's, by the number of the primitive, from 0.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        env: CharacterEnv | TransformedCharacterEnv,
        *,
        deterministic: bool = True,
        num_options: int = 0,
        aside: float = 1.0,
        before_step: Callable[[], object] | None = None,
    ) -> None:
        self.env: CharacterEnv = env.base_env if isinstance(env, TransformedCharacterEnv) else env
        self.simulated = hasattr(self.env, "simulation")
        self.extent = extent(self.env.simulation.model) if self.simulated else 1.0
        self.pinned: dict[int, float] = {}
        self._policy = policy
        self._transformed = env
        self._num_options = num_options
        self._exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        self._aside = aside * self.extent
        self._before_step = before_step
        self.reset()

    def reset(self) -> None:
        """Begin a new episode."""
        self.state = self._transformed.reset()
        self._decision = self.state.empty()
        self.began = True

    @torch.no_grad()
    def step(self) -> None:
        """Let the policy act once."""
        if self._before_step is not None:
            self._before_step()
        with set_exploration_type(self._exploration):
            self._decision = self._policy(self.state.select(*self._policy.in_keys))
            if self.pinned and self.has_gates:
                self._compose_pinned()
        step, self.state = self._transformed.step_and_maybe_reset(self.state.update(self._decision))
        self.began = bool(step["next", "done"][0])

    @property
    def has_gates(self) -> bool:
        """Whether the policy composes primitives by gates, which can be pinned."""
        return isinstance(self._policy, TensorDictSequential) and "gates" in self._policy[-1].in_keys

    def _compose_pinned(self) -> None:
        """Compose the primitives again, with the pinned gates."""
        for primitive, weight in self.pinned.items():
            self._decision["gates"][..., primitive] = weight
        self._decision = self._policy[-1](self._decision)

    @property
    def action(self) -> Tensor:
        """The last action, ``(N, A)``."""
        return self._decision["action"]

    @property
    def weights(self) -> Weights | None:
        """Gates of the last step, or 1 for the active option and 0 for the others; None without gates and options."""
        if "gates" in self._decision:
            return Weights("gates", self._decision["gates"][0].tolist())
        if self._num_options and "option" in self._decision:
            active = torch.nn.functional.one_hot(self._decision["option"][0], self._num_options)
            return Weights("option", active.tolist())
        return None

    @property
    def data(self) -> mujoco.MjData:
        """Current state of the first simulation, which the next step may overwrite."""
        return self.env.simulation.data(0)

    @property
    def shapes(self) -> list[Shape]:
        """Shapes to draw in addition to the simulation."""
        return scenery(self.env, aside=self._aside)
