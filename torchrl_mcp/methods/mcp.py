"""MCP: a gate composes primitives into one action distribution, Eq. 4 and Algorithm 1.

The mixture of experts (Section E.6) has the same parts and actor, with another mixer, gate and primitives.
"""

import math
from collections.abc import Callable, Collection

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import IndependentNormal

from torchrl_mcp.methods.actor import (
    GOAL,
    PRIMITIVES,
    STATE,
    Actor,
    Composition,
    Explorer,
    Sizes,
    input_normalisers,
    normalise_inputs,
    require_frozen,
    sampler,
)
from torchrl_mcp.modules.gaussian import state_independent_scale
from torchrl_mcp.values import Count, Positive, checked


@checked
def composite_parts(
    sizes: Sizes,
    *,
    gating: Callable[..., nn.Module],
    gate_activation: Callable[[Tensor], Tensor],
    primitives: Callable[..., nn.Module],
    num_primitives: Count,
    distribution_class: Composition,
    initial_std: Positive,
    learned_logits_std: Positive | None = None,
) -> nn.ModuleDict:
    """Make the parts ``observation_normaliser``, ``goal_normaliser``, ``gating``, ``primitives`` and ``gate_noise``.

    Args:
        sizes: Sizes of state, goal and action.
        gating: Makes the network for gate logits from ``(S, G, K)``.
        gate_activation: From logits to weights: a sigmoid, or a softmax for mixtures.
        primitives: Makes the primitives from ``(S, A, K, initial_std=)``. Those without a method ``rescale``, such as
            those of :meth:`~torchrl_mcp.modules.Primitives.from_policies`, keep their standard deviations.
        num_primitives: Number of primitives, ``K``.
        distribution_class: The mixer, of ``(loc, scale, gates)``. It needs the properties ``stddev`` and
            ``deterministic_sample``.
        initial_std: Standard deviation of the *composite* before training, in action units, for any ``K``. It is a root
            mean square over normalised states and actions. For a mixture, it includes the variance between the means of
            the primitives. The mixer's standard deviation must be proportional to that of its primitives, which
            excludes squashed actions.
        learned_logits_std: Standard deviation of the logits before training, if :func:`weights_actor` is to learn it.
            If it is None, there is no part ``gate_noise``.

    Returns:
        The parts by name.

    Raises:
        ValueError: If ``num_primitives`` is not positive, if weights are negative, not finite or all zero, if
            primitives have another number of actions, or if the mixer lacks a property.

    Example:
        See :func:`composite_actor`.
    """
    # A composite's standard deviation is proportional to its primitives'. First compose K unit Gaussians at the gate's
    # initial weights and divide. Then do the same with the networks, whose primitives have different means.
    gates = _valid(gate_activation(torch.zeros(num_primitives)))
    unit_std = _unit_stddev(distribution_class, gates)
    gate = gating(sizes.observation, sizes.goal, num_primitives)
    networks = primitives(sizes.observation, sizes.action, num_primitives, initial_std=initial_std / unit_std)
    with torch.no_grad():
        states, goals = _normalised_inputs(sizes.observation, sizes.goal)
        loc, scale = networks(states)
        if loc.shape[-1] != sizes.action:
            raise ValueError(f"primitives have {loc.shape[-1]} actions, must have the task's {sizes.action}")
        weights = _valid(gate_activation(gate(states, goals)))
        composite = distribution_class(loc, scale, weights)
        if rescale := getattr(networks, "rescale", None):
            rescale(initial_std / composite.stddev.square().mean().sqrt().item())
    parts = nn.ModuleDict({**input_normalisers(sizes), "gating": gate, "primitives": networks})
    if learned_logits_std is not None:
        parts["gate_noise"] = state_independent_scale(learned_logits_std, num_primitives, learned=True)
    return parts


def _unit_stddev(mixer: Composition, gates: Tensor) -> float:
    """Return the standard deviation of unit Gaussians under gates ``(K,)``, after checking the mixer.

    Raises:
        ValueError: If the mixer lacks a property that training needs, or is not proportional to its primitives.
    """
    unit = torch.ones(len(gates), 1)
    composite = mixer(torch.zeros_like(unit), unit, gates)
    needs = {"stddev": "the noise before training", "deterministic_sample": "the action without exploration"}
    for name, use in needs.items():
        try:
            getattr(composite, name)
        except (AttributeError, NotImplementedError) as error:
            raise ValueError(f"the mixer {type(composite).__name__} lacks {name}, {use}: add the property") from error
    stddev = composite.stddev.item()
    half_stddev = mixer(torch.zeros_like(unit), unit / 2, gates).stddev.item()
    if not math.isclose(half_stddev, stddev / 2, rel_tol=1e-3):
        raise ValueError(
            f"the mixer {type(composite).__name__} has the standard deviation {stddev:.3g} over unit Gaussians, and "
            f"{half_stddev:.3g} over half as wide ones: it must be proportional to that of the primitives, which "
            "excludes squashed actions"
        )
    return stddev


def _valid(weights: Tensor) -> Tensor:
    """Return weights ``(*B, K)`` of a gate, if primitives can be composed with them."""
    if not (weights.isfinite().all() and (weights >= 0).all() and (weights.sum(-1) > 0).all()):
        raise ValueError(
            "gating.activation makes weights that are negative, not finite or all zero, which cannot compose "
            "primitives: end it in a sigmoid or a softmax"
        )
    return weights


def _normalised_inputs(observation_dim: int, goal_dim: int, num: int = 1024) -> tuple[Tensor, Tensor]:
    """Return states ``(num, S)`` and goals ``(num, G)`` of zero mean and unit variance, the same at every call."""
    generator = torch.Generator("cpu").manual_seed(0)
    states = torch.randn(num, observation_dim, generator=generator, device="cpu")
    goals = torch.randn(num, goal_dim, generator=generator, device="cpu")
    return states.to(torch.get_default_device()), goals.to(torch.get_default_device())


def composite_actor(
    parts: nn.ModuleDict,
    *,
    gate_activation: nn.Module,
    distribution_class: Composition,
    frozen: Collection[str] = (),
) -> Actor:
    r"""Gate K primitives and compose them into one action distribution, :math:`\pi(a|s, g)` of Eq. 4.

    If ``frozen`` contains ``primitives``, the outputs of the primitives are stored with each sample, and the loss
    evaluates the gate alone.

    Args:
        parts: Made by :func:`composite_parts`.
        gate_activation: From logits to weights.
        distribution_class: The mixer, of ``(loc, scale, gates)``.
        frozen: Names of the parts that do not change in training.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.distributions import MultiplicativeGaussian
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.mcp import composite_actor, composite_parts
        >>> from torchrl_mcp.modules import Gating, Primitives
        >>> mixer = {"gate_activation": torch.nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
        >>> networks = {"gating": Gating, "primitives": Primitives, "num_primitives": 8, "initial_std": 0.1}
        >>> parts = composite_parts(Sizes(observation=105, goal=2, action=17), **networks, **mixer)
        >>> actor = composite_actor(parts, **mixer)
        >>> states = TensorDict({"observation": torch.randn(16, 105), "goal": torch.randn(16, 2)}, [16])
        >>> acted = actor.policy(states)
        >>> acted["action"].shape, acted["gates"].shape, acted["primitives", "loc"].shape
        (torch.Size([16, 17]), torch.Size([16, 8]), torch.Size([16, 8, 17]))
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


@checked
def weights_actor(
    parts: nn.ModuleDict,
    *,
    gate_activation: nn.Module,
    distribution_class: Composition,
    logits_std: Positive,
    frozen: Collection[str] = (),
) -> Actor:
    r"""Explore over the weights: sample :math:`\omega(w|s, g)` and play the composite's deterministic action.

    The gate's logits are Gaussian, and the policy gradient uses the density of the logits. The primitives therefore get
    no gradient and must be frozen.

    Args:
        parts: Made by :func:`composite_parts`.
        gate_activation: From logits to weights.
        distribution_class: The mixer, of ``(loc, scale, gates)``.
        logits_std: Standard deviation of the logits, unless the part ``gate_noise`` learns it.
        frozen: Names of the parts that do not change in training.

    Raises:
        ValueError: If the primitives are not frozen.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.distributions import MultiplicativeGaussian
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.mcp import composite_parts, weights_actor
        >>> from torchrl_mcp.modules import Gating, Primitives
        >>> mixer = {"gate_activation": torch.nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}
        >>> networks = {"gating": Gating, "primitives": Primitives, "num_primitives": 8, "initial_std": 0.1}
        >>> parts = composite_parts(Sizes(observation=105, goal=2, action=17), **networks, **mixer)
        >>> actor = weights_actor(parts, logits_std=0.5, frozen=["primitives"], **mixer)
        >>> states = TensorDict({"observation": torch.randn(16, 105), "goal": torch.randn(16, 2)}, [16])
        >>> actor.policy(states)["action"].shape, actor.sampled
        (torch.Size([16, 17]), 'gate_logits')
    """
    require_frozen("primitives", frozen, over="weights")
    noise = parts["gate_noise"] if "gate_noise" in parts else ConstantScale(logits_std)
    gate = (
        normalise_inputs(parts),
        TensorDictModule(parts["gating"], in_keys=[STATE, GOAL], out_keys=["gate_loc"]),
        TensorDictModule(noise, in_keys=["gate_loc"], out_keys=["gate_loc", "gate_scale"]),
    )
    normal = {"loc": "gate_loc", "scale": "gate_scale"}
    trained = ProbabilisticTensorDictSequential(*gate, sampler("gate_logits", IndependentNormal, **normal))
    policy = TensorDictSequential(
        *gate,
        trained[-1],
        TensorDictModule(gate_activation, in_keys=["gate_logits"], out_keys=["gates"]),
        TensorDictModule(parts["primitives"], in_keys=[STATE], out_keys=list(PRIMITIVES)),
        TensorDictModule(DeterministicAction(distribution_class), in_keys=[*PRIMITIVES, "gates"], out_keys=["action"]),
    )
    return Actor(policy, trained, stored=("gates", "gate_logits"), sampled="gate_logits")


def random_weights(
    parts: nn.ModuleDict,
    num: int,
    generator: torch.Generator,
    *,
    num_primitives: Count,
    gate_activation: Callable[[Tensor], Tensor],
    distribution_class: Composition,
) -> Explorer:
    """Return an explorer that composes the primitives with random weights, one set for each simulation.

    The explorer plays the composite's deterministic action.

    Args:
        parts: Made by :func:`composite_parts`.
        num: Number of simulations, ``N``.
        generator: Source of randomness.
        num_primitives: Number of primitives, ``K``.
        gate_activation: From logits to weights.
        distribution_class: The mixer, of ``(loc, scale, gates)``.

    Returns:
        A function from normalised states ``(N, S)`` to actions ``(N, A)``.
    """
    # Paper: Gaussian weights. Here Gaussian logits, as with exploration=weights, so that weights are between 0 and 1.
    gates = gate_activation(torch.randn(num, num_primitives, generator=generator, device=generator.device))
    composite = DeterministicAction(distribution_class)

    def explore(state: Tensor) -> Tensor:
        loc, scale = parts["primitives"](state)
        return composite(loc, scale, gates)

    return explore


class ConstantScale(nn.Module):
    """A standard deviation that does not depend on the input."""

    def __init__(self, std: Positive) -> None:
        """Set the standard deviation."""
        super().__init__()
        self.std = std

    def forward(self, loc: Tensor) -> tuple[Tensor, Tensor]:
        """Return ``loc`` and the standard deviation in its shape."""
        return loc, torch.full_like(loc, self.std)


class DeterministicAction(nn.Module):
    """The deterministic action of a composite."""

    def __init__(self, distribution_class: Composition) -> None:
        """Set the mixer."""
        super().__init__()
        self.distribution_class = distribution_class

    def forward(self, loc: Tensor, scale: Tensor, gates: Tensor) -> Tensor:
        """Return the action ``(*B, A)`` of primitives ``(*B, K, A)`` under gates ``(*B, K)``."""
        action: Tensor = self.distribution_class(loc, scale, gates).deterministic_sample  # type: ignore[attr-defined]
        return action
