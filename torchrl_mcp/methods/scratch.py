"""The scratch model: one Gaussian policy over state and goal, Section E.2."""

from collections.abc import Callable, Collection

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal

from torchrl_mcp.methods.actor import GOAL, STATE, Actor, Sizes, input_normalisers, normalise_inputs, sampler


def gaussian_parts(sizes: Sizes, *, policy: Callable[..., nn.Module]) -> nn.ModuleDict:
    """Make the parts of the scratch model: ``observation_normaliser``, ``goal_normaliser`` and ``policy``.

    Args:
        sizes: Sizes of state, goal and action.
        policy: Makes the network for mean and standard deviation from ``(S, G, A)``.

    Returns:
        The parts by name.
    """
    return nn.ModuleDict(
        {
            **input_normalisers(sizes),
            "policy": policy(sizes.observation, sizes.goal, sizes.action),
        }
    )


def gaussian_actor(parts: nn.ModuleDict, *, frozen: Collection[str] = ()) -> Actor:
    """One Gaussian policy over state and goal: the scratch model (Section E.2).

    Args:
        parts: Made by :func:`gaussian_parts`.
        frozen: Names of the parts that do not change in training; the policy is still evaluated in full.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.scratch import gaussian_actor, gaussian_parts
        >>> from torchrl_mcp.modules import GaussianPolicy
        >>> actor = gaussian_actor(gaussian_parts(Sizes(observation=105, goal=2, action=17), policy=GaussianPolicy))
        >>> states = TensorDict({"observation": torch.randn(16, 105), "goal": torch.randn(16, 2)}, [16])
        >>> acted = actor.policy(states)
        >>> acted["action"].shape, acted["action_log_prob"].shape
        (torch.Size([16, 17]), torch.Size([16]))
    """
    policy = ProbabilisticTensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["policy"], in_keys=[STATE, GOAL], out_keys=["loc", "scale"]),
        sampler("action", IndependentNormal, loc="loc", scale="scale"),
    )
    return Actor(policy, policy)
