"""Networks become TensorDictModules.

Here, in :mod:`~torchrl_mcp.latent`, :mod:`~torchrl_mcp.injection` and :mod:`~torchrl_mcp.critics`: the only places that
name tensordict keys.

A method first makes named *parts*, plain modules that transfer keeps, freezes or starts anew by their names, and then
an :class:`Actor` over them: the ``policy`` that acts, and what the loss differentiates, ``trained``. Both are one and
the same unless the primitives are frozen, the exploration acts on the gate, or noise enters before the action.

| key | content | shape |
|---|---|---|
| ``observation``, ``goal`` | state and goal as the environment gives them | ``(*B, S)``, ``(*B, G)`` |
| ``normalised`` / ``observation``, ``goal`` | the same, standardised and clipped | |
| ``gate_logits``, ``gates`` | before and after the gate's activation | ``(*B, K)`` |
| ``primitives`` / ``loc``, ``scale`` | means and standard deviations of the primitives | ``(*B, K, A)`` |
| ``action`` | what the environment plays | ``(*B, A)`` |
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass

import torch
from tensordict import NestedKey
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.modules import IndependentNormal

from torchrl_mcp.modules.normaliser import RunningNormaliser

STATE = ("normalised", "observation")
GOAL = ("normalised", "goal")
PRIMITIVES = (("primitives", "loc"), ("primitives", "scale"))

Composition = Callable[[Tensor, Tensor, Tensor], Distribution]


@dataclass(frozen=True)
class Actor:
    """A policy in parts.

    Attributes:
        policy: What collection and evaluation run: from ``observation`` and ``goal`` to ``action``.
        trained: What the loss differentiates: gives the distribution of ``sampled`` from a stored sample.
        stored: Keys, beside the environment's own, that a sample must hold for the loss and the diagnostics.
        sampled: Key of the random variable whose log-probability the policy gradient takes.
    """

    policy: TensorDictModuleBase
    trained: ProbabilisticTensorDictSequential
    stored: tuple[NestedKey, ...] = ()
    sampled: str = "action"

    @property
    def log_prob(self) -> str:
        """Key of the log-probability of ``sampled`` under the policy that drew it."""
        return f"{self.sampled}_log_prob"


def composite_parts(
    observation_dim: int,
    goal_dim: int,
    action_dim: int,
    *,
    gating: Callable[..., nn.Module],
    gate_activation: Callable[[Tensor], Tensor],
    primitives: Callable[..., nn.Module],
    num_primitives: int,
    distribution_class: Composition,
    initial_std: float,
    normaliser: Callable[[int], RunningNormaliser] = RunningNormaliser,
) -> nn.ModuleDict:
    """Make the parts ``observation_normaliser``, ``goal_normaliser``, ``gating`` and ``primitives``.

    Args:
        observation_dim: Size of the state, ``S``.
        goal_dim: Size of the goal, ``G``.
        action_dim: Size of the action, ``A``.
        gating: Makes the network for gate logits from ``(S, G, K)``.
        gate_activation: From logits to weights: a sigmoid, or a softmax for mixtures.
        primitives: Makes the primitives from ``(S, A, K, initial_std=)``.
        num_primitives: Number of primitives, ``K``.
        distribution_class: The mixer, of ``(loc, scale, gates)``.
        initial_std: Standard deviation of the *composite* before training, in action units, whatever ``K`` and mixer.
        normaliser: Makes an input normaliser from a size.

    Raises:
        ValueError: If ``num_primitives`` is not positive.
    """
    if num_primitives < 1:
        raise ValueError(f"num_primitives must be at least 1, got {num_primitives}")
    # Both mixers scale with their primitives: compose K unit Gaussians at the gate's initial weights and divide.
    gates = gate_activation(torch.zeros(num_primitives))
    unit = torch.ones(num_primitives, 1)
    composite = distribution_class(torch.zeros_like(unit), unit, gates)
    return nn.ModuleDict(
        {
            **input_normalisers(observation_dim, goal_dim, normaliser),
            "gating": gating(observation_dim, goal_dim, num_primitives),
            "primitives": primitives(
                observation_dim, action_dim, num_primitives, initial_std=initial_std / composite.stddev.item()
            ),
        }
    )


def gaussian_parts(
    observation_dim: int,
    goal_dim: int,
    action_dim: int,
    *,
    policy: Callable[..., nn.Module],
    normaliser: Callable[[int], RunningNormaliser] = RunningNormaliser,
) -> nn.ModuleDict:
    """Make the parts of the scratch model: ``observation_normaliser``, ``goal_normaliser`` and ``policy``.

    Args:
        observation_dim: Size of the state, ``S``.
        goal_dim: Size of the goal, ``G``.
        action_dim: Size of the action, ``A``.
        policy: Makes the network for mean and standard deviation from ``(S, G, A)``.
        normaliser: Makes an input normaliser from a size.
    """
    return nn.ModuleDict(
        {
            **input_normalisers(observation_dim, goal_dim, normaliser),
            "policy": policy(observation_dim, goal_dim, action_dim),
        }
    )


def composite_actor(
    parts: nn.ModuleDict,
    *,
    gate_activation: nn.Module,
    distribution_class: Composition,
    frozen: Collection[str] = (),
) -> Actor:
    r"""Gate K primitives and compose them into one action distribution, :math:`\pi(a|s, g)` of Eq. 4.

    With ``primitives`` among ``frozen``, their outputs are stored with each sample and the loss evaluates the gate
    alone.

    Args:
        parts: Made by :func:`composite_parts`.
        gate_activation: From logits to weights.
        distribution_class: The mixer, of ``(loc, scale, gates)``.
        frozen: Names of the parts that do not change in training.
    """
    primitives = TensorDictModule(parts["primitives"], in_keys=[STATE], out_keys=list(PRIMITIVES))
    gate = (
        TensorDictModule(parts["gating"], in_keys=[STATE, GOAL], out_keys=["gate_logits"]),
        TensorDictModule(gate_activation, in_keys=["gate_logits"], out_keys=["gates"]),
    )
    head = sampler("action", distribution_class, loc=PRIMITIVES[0], scale=PRIMITIVES[1], gates="gates")
    policy = ProbabilisticTensorDictSequential(normalise_inputs(parts), primitives, *gate, head)
    if "primitives" not in frozen:
        return Actor(policy, policy, stored=("gates",))
    trained = ProbabilisticTensorDictSequential(normalise_inputs(parts), *gate, head)
    return Actor(policy, trained, stored=("gates", *PRIMITIVES))


def weights_actor(
    parts: nn.ModuleDict,
    *,
    gate_activation: nn.Module,
    distribution_class: Composition,
    logits_std: float,
    frozen: Collection[str] = (),
) -> Actor:
    r"""Explore over the weights: sample :math:`\omega(w|s, g)` and play the composite's deterministic action.

    The gate's logits are Gaussian with a fixed standard deviation. They are what the policy gradient scores, so that
    the primitives appear in no gradient and must be frozen.

    Args:
        parts: Made by :func:`composite_parts`.
        gate_activation: From logits to weights.
        distribution_class: The mixer, of ``(loc, scale, gates)``.
        logits_std: Standard deviation of the logits.
        frozen: Names of the parts that do not change in training.

    Raises:
        ValueError: If the primitives are not frozen.
    """
    if "primitives" not in frozen:
        raise ValueError(
            "exploration over weights trains the gate alone: use it with stage=transfer and keep 'primitives' in "
            "transfer.freeze, or take exploration=action"
        )
    trained = ProbabilisticTensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["gating"], in_keys=[STATE, GOAL], out_keys=["gate_loc"]),
        TensorDictModule(ConstantScale(logits_std), in_keys=["gate_loc"], out_keys=["gate_scale"]),
        sampler("gate_logits", IndependentNormal, loc="gate_loc", scale="gate_scale"),
    )
    policy = TensorDictSequential(
        trained,
        TensorDictModule(gate_activation, in_keys=["gate_logits"], out_keys=["gates"]),
        TensorDictModule(parts["primitives"], in_keys=[STATE], out_keys=list(PRIMITIVES)),
        TensorDictModule(DeterministicAction(distribution_class), in_keys=[*PRIMITIVES, "gates"], out_keys=["action"]),
    )
    return Actor(policy, trained, stored=("gates", "gate_logits"), sampled="gate_logits")


def gaussian_actor(parts: nn.ModuleDict, *, frozen: Collection[str] = ()) -> Actor:
    """One Gaussian policy over state and goal: the scratch model (Section E.2).

    Args:
        parts: Made by :func:`gaussian_parts`.
        frozen: Names of the parts that do not change in training; the policy is evaluated in full all the same.
    """
    policy = ProbabilisticTensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["policy"], in_keys=[STATE, GOAL], out_keys=["loc", "scale"]),
        sampler("action", IndependentNormal, loc="loc", scale="scale"),
    )
    return Actor(policy, policy)


def input_normalisers(
    observation_dim: int, goal_dim: int, normaliser: Callable[[int], RunningNormaliser]
) -> dict[str, nn.Module]:
    """Make the parts that :func:`normalise_inputs` needs.

    Args:
        observation_dim: Size of the state, ``S``.
        goal_dim: Size of the goal, ``G``.
        normaliser: Makes an input normaliser from a size.
    """
    return {"observation_normaliser": normaliser(observation_dim), "goal_normaliser": normaliser(goal_dim)}


def normalise_inputs(parts: nn.ModuleDict) -> TensorDictSequential:
    """Return the module that standardises ``observation`` and ``goal`` by the parts of those names."""
    return TensorDictSequential(
        TensorDictModule(parts["observation_normaliser"], in_keys=["observation"], out_keys=[STATE]),
        TensorDictModule(parts["goal_normaliser"], in_keys=["goal"], out_keys=[GOAL]),
    )


def sampler(
    out_key: str, distribution_class: Callable[..., Distribution], **in_keys: NestedKey
) -> ProbabilisticTensorDictModule:
    """Return the module that draws ``out_key`` and stores its log-probability as ``<out_key>_log_prob``."""
    return ProbabilisticTensorDictModule(
        in_keys=in_keys,
        out_keys=[out_key],
        distribution_class=distribution_class,
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )


class ConstantScale(nn.Module):
    """A standard deviation that depends on nothing."""

    def __init__(self, std: float) -> None:
        """Take the standard deviation, positive."""
        super().__init__()
        if not std > 0:
            raise ValueError(f"logits_std must be positive, got {std}")
        self.std = std

    def forward(self, loc: Tensor) -> Tensor:
        """Return the standard deviation in the shape of ``loc``."""
        return torch.full_like(loc, self.std)


class DeterministicAction(nn.Module):
    """The deterministic action of a composite."""

    def __init__(self, distribution_class: Composition) -> None:
        """Take the mixer."""
        super().__init__()
        self.distribution_class = distribution_class

    def forward(self, loc: Tensor, scale: Tensor, gates: Tensor) -> Tensor:
        """Return the action ``(*B, A)`` of primitives ``(*B, K, A)`` under gates ``(*B, K)``."""
        action: Tensor = self.distribution_class(loc, scale, gates).deterministic_sample  # type: ignore[attr-defined]
        return action
