"""The scratch model: one Gaussian policy over state and goal, Section E.2."""

from collections.abc import Callable, Collection

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal

from torchrl_mcp.methods.actor import GOAL, STATE, Actor, input_normalisers, normalise_inputs, sampler
from torchrl_mcp.modules.normaliser import RunningNormaliser


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
