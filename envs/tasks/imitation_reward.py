"""The imitation reward, as functions of tensors."""

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchrl_mcp.envs.characters.kinematics import BodyStates
from torchrl_mcp.values import NotNegative, Positive, require, types_of

HORIZON = 0.25
"""Seconds by which velocities are multiplied, to compare them with positions."""

ERRORS = (
    "pose",
    "velocity",
    "root_pose",
    "root_velocity",
    "key_positions",
    "bodies",
    "orientations",
    "com",
)
"""Errors of a character against its reference, for the terms of the reward."""


class Term(NamedTuple):
    r"""A term of the imitation reward, :math:`w \exp(-c \, e)` of an error :math:`e`."""

    weight: Positive
    scale: NotNegative


def checked_terms(terms: Mapping[str, Mapping[str, float]]) -> dict[str, Term]:
    """Return terms by the names of errors, from their weights and scales by name.

    Raises:
        ValueError: If there is no term, a name is unknown, a weight is not positive or a scale is negative.
    """
    if not terms:
        raise ValueError(f"terms are empty: pass weight and scale of one or more of {', '.join(ERRORS)}")
    for name, term in terms.items():
        if name not in ERRORS:
            raise ValueError(f"terms names {name!r}, which is not an error: pass some of {', '.join(ERRORS)}")
        if set(term) != set(Term._fields):
            raise ValueError(f"the term {name} has {', '.join(term) or 'nothing'}: pass {' and '.join(Term._fields)}")
        for field, annotation in types_of(Term).items():
            require(f"terms.{name}.{field}", term[field], annotation)
    return {name: Term(**term) for name, term in terms.items()}


def imitation_rewards(errors: Mapping[str, Tensor], terms: Mapping[str, Term]) -> Tensor:
    r"""Terms of the imitation reward: similarity of character and reference by several errors.

    .. math:: r = \sum_i r_i, \quad r_i = w_i \exp(-c_i e_i)

    Args:
        errors: Errors :math:`e_i` by name, each of shape ``(*B)``.
        terms: Weights :math:`w_i` and scales :math:`c_i` by the names of errors.

    Returns:
        Terms :math:`r_i` in the order of ``terms``, shape ``(*B, I)``.

    Reference:
        Peng et al., *DeepMimic: Example-Guided Deep Reinforcement Learning of Physics-Based Character Skills*, 2018,
        section 5.2.
    """
    return torch.stack([term.weight * (-term.scale * errors[name]).exp() for name, term in terms.items()], -1)


def squared_angles(one: Tensor, other: Tensor) -> Tensor:
    r"""Squared angles between rotations, :math:`(2 \arccos |q \cdot \hat{q}|)^2`.

    Args:
        one: Unit quaternions, shape ``(*B, 4)``.
        other: Unit quaternions, shape ``(*B, 4)``.

    Returns:
        Shape ``(*B)``, in squared radians.
    """
    chord = torch.minimum((one - other).square().sum(-1), (one + other).square().sum(-1)).sqrt()
    return (4 * torch.asin((chord / 2).clamp(max=1.0))).square()  # accurate for small angles, unlike acos


def squared_distances(one: Tensor, other: Tensor) -> Tensor:
    """Squared distances between points, shape ``(*B, D)`` each, to ``(*B)``."""
    return (one - other).square().sum(-1)


def mismatch(one: BodyStates, other: BodyStates) -> Tensor:
    r"""Mismatch of two moments: the mean squared difference of the bodies' positions and, weighted, of velocities.

    .. math:: \frac{1}{L} \sum_l |x_l - \hat{x}_l|^2 + \tau^2 |v_l - \hat{v}_l|^2, \quad \tau = 0.25 \text{ s}

    Args:
        one: L bodies, each field ``(*B, L, ...)``.
        other: The same bodies at another moment.

    Returns:
        Shape ``(*B)``, in square metres.
    """
    places = squared_distances(one.positions, other.positions)
    velocities = squared_distances(one.linear_velocities, other.linear_velocities)
    return (places + HORIZON**2 * velocities).mean(-1)
