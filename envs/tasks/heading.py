"""The heading task: walk in a direction that keeps changing."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_mcp.envs.arguments import not_negative, positive
from torchrl_mcp.envs.characters.mirror import VECTOR_SIGNS, Mirror, mirror_signs
from torchrl_mcp.envs.ideal import Reach
from torchrl_mcp.envs.pd_character import PDCharacterEnv
from torchrl_mcp.envs.rendering.camera import Arrow
from torchrl_mcp.envs.tasks.initial_states import InitialStates
from torchrl_mcp.envs.tasks.ranges import Ranges
from torchrl_mcp.envs.tasks.rewards import heading_reward


class Heading(PDCharacterEnv):
    r"""A character walks at a given speed in a direction that wanders.

    .. math:: \hat{\theta}_t = \hat{\theta}_{t-1} + \mathrm{Uniform}(-\delta, \delta)

    ``goal`` (2) is the unit vector of the target direction in the character's heading frame. The reward of a step
    uses the direction that the action could see.

    Args:
        character: ``"biped"``, ``"humanoid"`` or ``"trex"``.
        num_envs: Number N of simulations.
        max_turn: Largest change :math:`\delta` of the direction per step, in radians. Paper: 0.15.
        speed: Target speed :math:`\hat{v}`, in m/s. Paper: 1.
        initial_directions: Range (lo, hi) of the first direction, in radians from the direction that the character
            faces. The paper does not say; its returns of 0.97 leave no time to turn round, hence the default.
        max_episode_steps: Actions of 1/30 s until an episode is ``truncated``; 600 are 20 s.
        **kwargs: Passed on to :class:`~torchrl_mcp.envs.pd_character.PDCharacterEnv`.

    Raises:
        ValueError: If an argument is out of range.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808

    Example:
        >>> env = Heading("biped", num_envs=2, seed=0)
        >>> env.rollout(3)["next", "observation"].shape
        torch.Size([2, 3, 105])
    """

    def __init__(
        self,
        character: str,
        num_envs: int,
        *,
        max_turn: float = 0.15,
        speed: float = 1.0,
        initial_directions: Sequence[float] = (0.0, 0.0),
        max_episode_steps: int = 600,
        **kwargs: Any,
    ) -> None:
        not_negative(max_turn=max_turn)
        positive(speed=speed)
        self.max_turn, self.speed = max_turn, speed
        super().__init__(
            character,
            num_envs,
            max_episode_steps=max_episode_steps,
            episode={"direction": torch.zeros((), dtype=torch.float64)},
            **kwargs,
        )
        self.initial_states = InitialStates(
            character, self.curriculum.initial_states, self.curriculum.motions, self.device
        )
        self.ranges = Ranges({"initial_directions": initial_directions}, self.curriculum.mixture).to(self.device)
        self.make_specs()

    def initial_state(self, num: int) -> dict[str, Tensor]:
        """The character, and a direction."""
        direction = self.ranges.draw(num, self.generator)["initial_directions"]
        return {**self.initial_states.fill(super().initial_state(num), self.generator), "direction": direction}

    def observe(self, ids: Tensor | slice) -> dict[str, Tensor]:
        """State of the character, and the target direction as it sees it."""
        goal = unit_vector(self.episode["direction"][ids] - self.heading(ids))
        return {"observation": self.see(ids)[0], "goal": goal}

    def reward(self) -> Tensor:
        """Reward of appendix D."""
        return heading_reward(self.velocity("com")[:, :2], unit_vector(self.episode["direction"]), self.speed)

    def update_goal(self) -> None:
        """Let the direction wander."""
        direction = self.episode["direction"]
        direction += torch.empty_like(direction).uniform_(-self.max_turn, self.max_turn, generator=self.generator)

    def reach(self) -> Reach:
        """See :meth:`CharacterEnv.reach`: the ideal player walks at the target speed from the first step on."""
        still = torch.zeros(self.num_envs, 2, dtype=torch.float64, device=self.device)
        standing = heading_reward(still, unit_vector(self.episode["direction"]), self.speed)
        return Reach(self.max_episode_steps * standing, torch.full_like(standing, self.max_episode_steps))

    def goal_mirror(self) -> Mirror:
        """See :meth:`PDCharacterEnv.goal_mirror`."""
        return mirror_signs(VECTOR_SIGNS)

    def arrows(self, index: int) -> list[Arrow]:
        """See :meth:`CharacterEnv.arrows`: an arrow in the target direction."""
        tail = self.com[index].cpu() + torch.tensor([0.0, 0.0, 0.8])
        tip = tail + torch.nn.functional.pad(unit_vector(self.episode["direction"][index].cpu()), (0, 1))
        return [(tail.double().numpy(), tip.numpy())]


def unit_vector(angle: Tensor) -> Tensor:
    """(cos, sin) of an angle in radians, shape ``(*B, 2)``."""
    return torch.stack([angle.cos(), angle.sin()], -1)
