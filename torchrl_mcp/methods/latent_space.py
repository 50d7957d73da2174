r"""The latent space model (Section E.7): an encoder turns goals into skills, a decoder turns skills into actions.

.. math:: w = \mu_q + \sigma_q \epsilon, \qquad \epsilon \sim \mathcal{N}(0, I), \qquad
    \pi(a|s, w) = \mathcal{N}(\mu(s, w), \mathrm{diag}(\sigma^2))

The noise :math:`\epsilon` is stored with each sample, as if it were part of the state. The loss compares the old and
the new policy at the same noise and differentiates through :math:`w`, which trains the encoder.

| key | content | shape |
|---|---|---|
| ``latent`` / ``noise`` | :math:`\epsilon` | ``(*B, L)`` |
| ``latent`` / ``loc``, ``scale`` | mean and standard deviation of the encoder | ``(*B, L)`` |
| ``latent`` / ``sample`` | latent variable :math:`w`, the decoder's view of the goal | ``(*B, L)`` |
| ``latents`` | the same, if the latent variable is what the policy gradient samples | ``(*B, L)`` |

Reference:
    Peng et al., *MCP*, NeurIPS 2019, Section E.7. https://arxiv.org/abs/1905.09808
    Merel et al., *Neural Probabilistic Motor Primitives for Humanoid Control*, ICLR 2019.
"""

from collections.abc import Callable, Collection

import torch
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from tensordict.nn.probabilistic import interaction_type
from torch import Tensor, nn
from torchrl.modules import IndependentNormal

from torchrl_mcp.methods.actor import (
    GOAL,
    STATE,
    Actor,
    Explorer,
    Sizes,
    input_normalisers,
    normalise_inputs,
    require_frozen,
    sampler,
)
from torchrl_mcp.methods.mcp import ConstantScale
from torchrl_mcp.values import Count, Positive, checked

NOISE = ("latent", "noise")
ENCODING = (("latent", "loc"), ("latent", "scale"))
LATENT = ("latent", "sample")


@checked
def latent_parts(
    sizes: Sizes, *, encoder: Callable[..., nn.Module], decoder: Callable[..., nn.Module], latent_dim: Count
) -> nn.ModuleDict:
    """Make the parts ``observation_normaliser``, ``goal_normaliser``, ``encoder`` and ``decoder``.

    Args:
        sizes: Sizes of state, goal and action.
        encoder: Makes the network for mean and standard deviation of the latent variable from ``(S, G, L)``.
        decoder: Makes the network for mean and standard deviation of the action from ``(S, L, A)``.
        latent_dim: Size of the latent variable, ``L``.

    Returns:
        The parts by name.

    Raises:
        ValueError: If ``latent_dim`` is not positive.
    """
    return nn.ModuleDict(
        {
            **input_normalisers(sizes),
            "encoder": encoder(sizes.observation, sizes.goal, latent_dim),
            "decoder": decoder(sizes.observation, latent_dim, sizes.action),
        }
    )


def latent_actor(parts: nn.ModuleDict, *, frozen: Collection[str] = ()) -> Actor:
    """Draw a latent variable and an action of its decoder; without exploration, take the means.

    Args:
        parts: Made by :func:`latent_parts`.
        frozen: Names of the parts that do not change in training; gradients still pass through a frozen decoder.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.latent_space import latent_actor, latent_parts
        >>> from torchrl_mcp.modules import GaussianPolicy, StateGoalEncoder
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = latent_parts(sizes, encoder=StateGoalEncoder, decoder=GaussianPolicy, latent_dim=16)
        >>> states = TensorDict({"observation": torch.randn(32, 105), "goal": torch.randn(32, 2)}, [32])
        >>> acted = latent_actor(parts).policy(states)
        >>> acted["action"].shape, acted["latent", "sample"].shape
        (torch.Size([32, 17]), torch.Size([32, 16]))
    """
    encoder = (
        normalise_inputs(parts),
        TensorDictModule(parts["encoder"], in_keys=[STATE, GOAL], out_keys=list(ENCODING)),
    )
    noise = TensorDictModule(latent_noise, in_keys=[ENCODING[0]], out_keys=[NOISE])
    decoder = (
        TensorDictModule(torch.addcmul, in_keys=[*ENCODING, NOISE], out_keys=[LATENT]),
        TensorDictModule(parts["decoder"], in_keys=[STATE, LATENT], out_keys=["loc", "scale"]),
        sampler("action", IndependentNormal, loc="loc", scale="scale"),
    )
    policy = ProbabilisticTensorDictSequential(*encoder, noise, *decoder)
    return Actor(policy, ProbabilisticTensorDictSequential(*encoder, *decoder), stored=(NOISE,), drawn=(NOISE,))


@checked
def latents_actor(parts: nn.ModuleDict, *, latent_std: Positive | None = None, frozen: Collection[str] = ()) -> Actor:
    r"""Explore over the latent variable: sample :math:`q(w|s, g)` and play the decoder's mean action.

    The policy gradient uses the density of the latent variable, as :func:`~torchrl_mcp.methods.mcp.weights_actor` uses
    the density of the weights. The decoder therefore gets no gradient and must be frozen.

    Args:
        parts: Made by :func:`latent_parts`.
        latent_std: Standard deviation of the latent variable, or None for the encoder's.
        frozen: Names of the parts that do not change in training.

    Raises:
        ValueError: If the decoder is not frozen.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.latent_space import latent_parts, latents_actor
        >>> from torchrl_mcp.modules import GaussianPolicy, StateGoalEncoder
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = latent_parts(sizes, encoder=StateGoalEncoder, decoder=GaussianPolicy, latent_dim=16)
        >>> states = TensorDict({"observation": torch.randn(32, 105), "goal": torch.randn(32, 2)}, [32])
        >>> acted = latents_actor(parts, frozen=["decoder"]).policy(states)
        >>> acted["action"].shape, acted["latents_log_prob"].shape
        (torch.Size([32, 17]), torch.Size([32]))
    """
    require_frozen("decoder", frozen, over="the latent variable")
    fixed = () if latent_std is None else (TensorDictModule(ConstantScale(latent_std), [ENCODING[0]], list(ENCODING)),)
    encoder = (
        normalise_inputs(parts),
        TensorDictModule(parts["encoder"], in_keys=[STATE, GOAL], out_keys=list(ENCODING)),
        *fixed,
        sampler("latents", IndependentNormal, loc=ENCODING[0], scale=ENCODING[1]),
    )
    decoder = TensorDictModule(parts["decoder"], in_keys=[STATE, "latents"], out_keys=["action", "_"])
    policy = TensorDictSequential(*encoder, decoder)
    trained = ProbabilisticTensorDictSequential(*encoder)
    return Actor(policy, trained, stored=("latents",), sampled="latents")


def latent_noise(loc: Tensor) -> Tensor:
    """Return standard normal noise in the shape of ``loc``, or zeros if TorchRL's exploration is off."""
    random = interaction_type() in (InteractionType.RANDOM, None)
    return torch.randn_like(loc) if random else torch.zeros_like(loc)


def random_latents(parts: nn.ModuleDict, num: int, generator: torch.Generator, *, latent_dim: Count) -> Explorer:
    """Return an explorer that decodes a random latent variable, one for each simulation, and plays the mean action.

    Args:
        parts: Made by :func:`latent_parts`.
        num: Number of simulations, ``N``.
        generator: Source of randomness.
        latent_dim: Size of the latent variable, ``L``.
    """
    latent = torch.randn(num, latent_dim, generator=generator, device=generator.device)
    return lambda state: parts["decoder"](state, latent)[0]
