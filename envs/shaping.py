"""Potential-based shaping: rewards for progress that do not change the optimal policy."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor


class Ramp(NamedTuple):
    r"""A part of a potential, :math:`k \max(0, D - d)` of a distance :math:`d`."""

    slope: float
    reach: float


def potential(distances: Mapping[str, Tensor], ramps: Mapping[str, Ramp]) -> Tensor:
    r"""Potential of states, which grows as distances shrink.

    .. math:: \Phi(s) = \sum_i k_i \max(0, D_i - d_i(s))

    It is never negative: a fall sets it to 0 and thus costs the potential gained, at most :math:`\sum_i k_i D_i`. With
    :math:`-k_i d_i` instead, falling far from everything would be rewarded.

    Args:
        distances: :math:`d_i`, each ``(*B)``, in metres, by name.
        ramps: Slopes :math:`k_i`, per metre, and reaches :math:`D_i`, in metres, by name, for some or all distances.

    Returns:
        Potential, shape ``(*B)``.
    """
    parts = [ramp.slope * (ramp.reach - distances[name]).clamp_min(0.0) for name, ramp in ramps.items()]
    return torch.stack(parts).sum(0)


def shaping_reward(before: Tensor, after: Tensor, discount: float) -> Tensor:
    r"""Shaping reward, which preserves the ranking of policies for any potential.

    .. math:: F(s, s') = \gamma \Phi(s') - \Phi(s)

    The discounted sum over an episode telescopes to :math:`-\Phi(s_0)` for any policy, if the potential after a
    terminal step is 0.

    Args:
        before: :math:`\Phi(s)`, shape ``(*B)``.
        after: :math:`\Phi(s')`, 0 if the step has ended the episode, shape ``(*B)``.
        discount: :math:`\gamma` of the learner.

    Returns:
        Reward, shape ``(*B)``.

    Reference:
        Ng, Harada and Russell, Policy Invariance Under Reward Transformations: Theory and Application to Reward
        Shaping, 1999.
    """
    return discount * after - before
