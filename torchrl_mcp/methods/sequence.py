"""Gates in a row: several policies over the same frozen primitives, one after another, in one simulation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_mcp.distributions import MultiplicativeGaussian
from torchrl_mcp.envs import CharacterEnv
from torchrl_mcp.methods.actor import Composition
from torchrl_mcp.methods.mcp import DeterministicAction


@dataclass(frozen=True)
class Act:
    """The turn of one gate in :class:`GatesInARow`.

    Attributes:
        parts: Parts of the policy, with ``observation_normaliser`` and ``primitives`` equal to those of the other acts.
        until: Returns from the environment whether the act is over, ``(N,)``, bool. If it is None, the act never ends.
        goal: Returns from the environment the goals that the gate sees, ``(N, G)``. If it is None, the gate sees the
            goals of the environment, which must be those of its own task.
    """

    parts: nn.ModuleDict
    until: Callable[[CharacterEnv], Tensor] | None = None
    goal: Callable[[CharacterEnv], Tensor] | None = None


class GatesInARow(TensorDictModuleBase):
    r"""A policy that plays acts one after another. The last act goes on until the end of the episode.

    Each simulation changes acts at its own time, and each episode begins with the first act. From one act to the next,
    the weights fade: :math:`w = \sum_a \lambda_a w_a`, where the shares :math:`\lambda_a \ge 0` sum to one and change
    linearly in time. The primitives are evaluated once for all gates.

    Args:
        env: The environment that the policy plays in.
        acts: The acts.
        crossfade: Duration of a change of acts in seconds.
        gate_activation: From logits to weights, as in the training of the gates.
        distribution_class: The mixer, of ``(loc, scale, gates)``.

    Raises:
        ValueError: If the acts differ in their primitives or the normalisation of the state, or ``crossfade`` is
            negative.

    Attributes:
        act: Number of the act of each simulation, ``(N,)``.

    Example:
        A biped walks in a direction for a second, and then to a place.

        >>> from torchrl_mcp.envs.tasks.waypoints import place_seen
        >>> from torchrl_mcp.methods.sequence import Act, GatesInARow
        >>> from torchrl_mcp.runs.builtin import builtin
        >>> from torchrl_mcp.runs.policies import restore
        >>> _, walk, env = restore(builtin("mcp", "biped", "heading"), num_envs=2, seed=0)
        >>> _, arrive, _ = restore(builtin("mcp", "biped", "location"), num_envs=2, seed=0)
        >>> place = torch.tensor([[2.0, 1.0]])  # metres
        >>> acts = [
        ...     Act(walk.parts, until=lambda env: env.episode["elapsed_steps"].squeeze(-1) >= 30),
        ...     Act(arrive.parts, goal=lambda env: place_seen(env, place)),
        ... ]
        >>> policy = GatesInARow(env, acts)
        >>> env.rollout(3, policy)["gates"].shape
        torch.Size([2, 3, 8])
    """

    in_keys = ["observation", "goal"]  # noqa: RUF012, the interface of TensorDictModule
    out_keys = ["gates", "action"]  # noqa: RUF012

    def __init__(
        self,
        env: CharacterEnv,
        acts: Sequence[Act],
        *,
        crossfade: float = 0.3,
        gate_activation: Callable[[Tensor], Tensor] = torch.sigmoid,
        distribution_class: Composition = MultiplicativeGaussian,
    ) -> None:
        super().__init__()
        _require_same(acts)
        if crossfade < 0:
            raise ValueError(f"crossfade={crossfade} is negative: pass seconds")
        self.env = env
        self.acts = tuple(acts)
        self.activation = gate_activation
        self.composite = DeterministicAction(distribution_class)
        self.rate = min(1.0, env.control_timestep / crossfade) if crossfade else 1.0
        self.act = torch.zeros(env.num_envs, dtype=torch.long, device=env.device)
        self.shares = torch.zeros(env.num_envs, len(acts), device=env.device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``gates`` ``(N, K)`` and the deterministic ``action`` ``(N, A)`` for ``observation`` and ``goal``."""
        self._advance()
        parts = self.acts[0].parts
        state = parts["observation_normaliser"](tensordict["observation"])
        gates = torch.stack([self._gates(act, state, tensordict["goal"]) for act in self.acts], -1)  # (N, K, acts)
        tensordict["gates"] = (gates @ self.shares.unsqueeze(-1)).squeeze(-1)
        tensordict["action"] = self.composite(*parts["primitives"](state), tensordict["gates"])
        return tensordict

    def _advance(self) -> None:
        """Begin episodes with the first act, go to the next act when an act is over, and fade."""
        began = self.env.episode["elapsed_steps"].flatten() == 0
        never = torch.zeros_like(began)
        over = torch.stack([act.until(self.env) if act.until else never for act in self.acts])
        over = over.gather(0, self.act.unsqueeze(0)).squeeze(0)
        self.act = torch.where(began, 0, (self.act + over.long()).clamp(max=len(self.acts) - 1))
        wanted = nn.functional.one_hot(self.act, len(self.acts)).float()
        faded = self.shares + (wanted - self.shares).clamp(-self.rate, self.rate)
        self.shares = torch.where(began.unsqueeze(-1), wanted, faded / faded.sum(-1, keepdim=True))

    def _gates(self, act: Act, state: Tensor, goal: Tensor) -> Tensor:
        seen = goal if act.goal is None else act.goal(self.env).to(state.dtype)
        return self.activation(act.parts["gating"](state, act.parts["goal_normaliser"](seen)))


def _require_same(acts: Sequence[Act]) -> None:
    """Check that there are acts, and that all acts have the same primitives.

    Raises:
        ValueError: If there are no acts, or their primitives or the normalisation of the state differ.
    """
    if not acts:
        raise ValueError("acts is empty: pass at least one act")
    for number, act in enumerate(acts[1:], 1):
        for name in ("observation_normaliser", "primitives"):
            first, other = acts[0].parts[name].state_dict(), act.parts[name].state_dict()
            if first.keys() != other.keys() or any(not torch.equal(first[key], other[key]) for key in first):
                raise ValueError(f"act {number} must have the {name} of act 0: pass gates over the same primitives")
