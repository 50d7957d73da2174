"""Rewards of the paper's tasks, as functions of tensors."""

import math
from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor


def heading_reward(velocity: Tensor, direction: Tensor, speed: float) -> Tensor:
    r"""Reward of the heading task: walk in a target direction at a target speed.

    .. math:: r = \exp(-4 (\hat{u} \cdot v_{com} - \hat{v})^2)

    Args:
        velocity: Horizontal velocity of the centre of mass :math:`v_{com}`, shape ``(*B, 2)``, in m/s.
        direction: Target direction :math:`\hat{u}`, a unit vector, shape ``(*B, 2)``. The paper writes
            :math:`(\cos\hat{\theta}, -\sin\hat{\theta})` for a world whose y axis points up; here the z axis does, and
            :math:`\hat{u} = (\cos\hat{\theta}, \sin\hat{\theta})`.
        speed: Target speed :math:`\hat{v}`, in m/s. Paper: 1.

    Returns:
        Reward, shape ``(*B)``.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808
    """
    return (-4 * ((direction * velocity).sum(-1) - speed).square()).exp()


def holdout_reward(
    velocity: Tensor,
    direction: Tensor,
    action: Tensor,
    healthy: Tensor,
    contact_forces: Tensor | None = None,
    *,
    forward_weight: float,
    healthy_weight: float,
    control_weight: float,
    contact_weight: float,
) -> Tensor:
    r"""Reward of the holdout task: Gymnasium's Ant, walking along a target direction.

    .. math::
        r = w^{forward} \hat{u} \cdot v_{com} + w^{healthy} 1[healthy] - w^{control} \|a\|^2 - w^{contact} \|c\|^2

    With :math:`\hat{u} = (1, 0)` this is the reward of Gymnasium's Ant-v5. The paper writes the two costs as (negative)
    reward terms and prints the name of the third weight twice; the fourth belongs to the contacts.

    Args:
        velocity: Horizontal velocity of the body :math:`v_{com}`, shape ``(*B, 2)``, in m/s.
        direction: Target direction :math:`\hat{u}`, a unit vector, shape ``(*B, 2)``.
        action: Action :math:`a`, shape ``(*B, A)``.
        healthy: Whether the character still walks, shape ``(*B)``, bool.
        contact_forces: Clipped external forces :math:`c`, shape ``(*B, F)``, or None to leave their cost out.
        forward_weight: Weight of the velocity. Paper: 1.
        healthy_weight: Reward for being healthy. Paper: 1.
        control_weight: Weight of the control cost. Paper: 0.5.
        contact_weight: Weight of the contact cost. Paper: 0.0005.

    Returns:
        Reward, shape ``(*B)``.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808
    """
    forward = (direction * velocity).sum(-1)
    control = action.square().sum(-1)
    reward = forward_weight * forward + healthy_weight * healthy - control_weight * control
    if contact_forces is None:
        return reward
    return reward - contact_weight * contact_forces.square().sum(-1)


def transport_reward(
    com: Tensor,
    com_velocity: Tensor,
    position: Tensor,
    velocity: Tensor,
    target: Tensor,
    *,
    weights: Sequence[float],
    proximity_scale: float,
    speed: float,
    target_distance_power: float,
) -> Tensor:
    r"""Reward of the carry and dribble tasks: go to an object, stay with it, and move it to its target.

    .. math::
        r &= w^{cv} r^{cv} + w^{cp} r^{cp} + w^{bv} r^{bv} + w^{bp} r^{bp} \\
        r^{cv} &= \exp(-1.5 \min(0, u_b \cdot v_{com} - \hat{v})^2) \\
        r^{cp} &= \exp(-c \, \|x_{com} - x_b\|^2) \\
        r^{bv} &= \exp(-\min(0, u_{tar} \cdot v_b - \hat{v})^2) \\
        r^{bp} &= \exp(-0.5 \, \|x_b - x_{tar}\|^p)

    where the minimum is squared, :math:`u_b` is the direction from the character to the object and :math:`u_{tar}` the
    direction from the object to the target. All quantities are horizontal.

    Args:
        com: Centre of mass of the character :math:`x_{com}`, shape ``(*B, 2)``, in metres.
        com_velocity: Velocity of the centre of mass :math:`v_{com}`, shape ``(*B, 2)``, in m/s.
        position: Position of the object :math:`x_b`, shape ``(*B, 2)``, in metres.
        velocity: Velocity of the object :math:`v_b`, shape ``(*B, 2)``, in m/s.
        target: Position of the target :math:`x_{tar}`, shape ``(*B, 2)``, in metres.
        weights: :math:`(w^{cv}, w^{cp}, w^{bv}, w^{bp})`.
        proximity_scale: :math:`c`, per square metre.
        speed: Target speed :math:`\hat{v}`, in m/s. Paper: 1.
        target_distance_power: :math:`p`. Paper: 2.

    Returns:
        Reward, shape ``(*B)``.

    Reference:
        Peng et al., MCP: Learning Composable Hierarchical Control with Multiplicative Compositional Policies, 2019,
        appendix D, https://arxiv.org/abs/1905.09808
    """
    ways = torch.stack([position - com, target - position])
    towards = torch.nn.functional.normalize(ways, dim=-1)  # 0 for a zero vector
    missing_speeds = ((towards * torch.stack([com_velocity, velocity])).sum(-1) - speed).clamp(max=0.0)
    (cv, bv), (cp, bp) = missing_speeds.square(), ways.square().sum(-1)
    exponents = torch.stack([-1.5 * cv, -proximity_scale * cp, -bv, -0.5 * bp.pow(target_distance_power / 2)], -1)
    return exponents.exp() @ _on(exponents.device, tuple(weights)).to(exponents.dtype)


@cache
def _on(device: torch.device, numbers: tuple[float, ...]) -> Tensor:
    """Numbers as a tensor on a device, float64, copied there once."""
    return torch.tensor(numbers, dtype=torch.float64, device=device)


def idle_reward(weights: Sequence[float], speed: float) -> float:
    r"""Reward of the speed terms in :func:`transport_reward` while nothing moves.

    .. math:: w^{cv} \exp(-1.5 \hat{v}^2) + w^{bv} \exp(-\hat{v}^2)

    Args:
        weights: :math:`(w^{cv}, w^{cp}, w^{bv}, w^{bp})`.
        speed: Target speed :math:`\hat{v}`, in m/s.
    """
    return weights[0] * math.exp(-1.5 * speed**2) + weights[2] * math.exp(-(speed**2))


def reward_until_success(
    reward: Tensor, success: Tensor, *, weights: Sequence[float], speed: float, discount: float
) -> Tensor:
    r"""Reward for training to carry and dribble: about zero for standing still, and greatest for a success.

    .. math::
        r' = \begin{cases}
            \frac{\sum_i w_i - r_{idle}}{1 - \gamma} & \text{after a success, which ends the episode} \\
            r - r_{idle} & \text{else}
        \end{cases}

    With the printed reward, standing still earns a third of the best return, and policies learn to stand. A success is
    worth the discounted return of all terms being 1 for ever: otherwise a character that walks on knocks the box off
    the target, and a success is worth little.

    Args:
        reward: :func:`transport_reward` with these weights, shape ``(*B)``.
        success: Whether the object is at its target, shape ``(*B)``, bool.
        weights: :math:`(w^{cv}, w^{cp}, w^{bv}, w^{bp})`.
        speed: Target speed :math:`\hat{v}`, in m/s, for the :func:`idle_reward`.
        discount: Discount factor :math:`\gamma` of the learner, below 1.

    Returns:
        Reward, shape ``(*B)``.
    """
    idle = idle_reward(weights, speed)
    return (reward - idle).masked_fill(success, (sum(weights) - idle) / (1 - discount))
