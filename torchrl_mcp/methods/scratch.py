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
    """
    policy = ProbabilisticTensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["policy"], in_keys=[STATE, GOAL], out_keys=["loc", "scale"]),
        sampler("action", IndependentNormal, loc="loc", scale="scale"),
    )
    return Actor(policy, policy)
