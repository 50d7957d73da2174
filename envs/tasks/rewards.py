"""Rewards of the paper's tasks, as functions of tensors."""

import math
from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor

ARRIVAL_DISTANCE = 0.3
"""Distance in metres from a place at which a character has arrived, and should stand."""

SUCCESS_DISTANCE = 0.5
"""Distance in metres between ball and target for success, as in the same authors' public code."""

SUCCESS_REACH = 2.0
"""Largest distance in metres between character and ball for success."""


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


def velocity_reward(velocity: Tensor, target: Tensor) -> Tensor:
    r"""Reward of moving at a target velocity: the heading task's, which also counts motion across the direction.

    .. math:: r = \exp(-4 \|v_{com} - v^*\|^2)

    With a speed of 0, :func:`heading_reward` is as high for a character that walks across the direction as for one that
    stands.

    Args:
        velocity: Horizontal velocity of the centre of mass :math:`v_{com}`, shape ``(*B, 2)``, in m/s.
        target: Target velocity :math:`v^*`, shape ``(*B, 2)``, in m/s.

    Returns:
        Reward, shape ``(*B)``.
    """
    return (-4 * (velocity - target).square().sum(-1)).exp()


def location_reward(velocity: Tensor, offset: Tensor, speed: float, alignment: Tensor | float = 1.0) -> Tensor:
    r"""Reward of the location task: go to a place, and stand there.

    .. math::
        r = 0.4 \exp(-\|x\|^2) \frac{1 + c}{2} + 0.6 \exp(-4 \|v_{com} - v^*\|^2)

    :func:`location_velocity` is the target velocity :math:`v^*`. The second term guides the character from any
    distance, where the first is flat. In the last metre this term asks for a velocity that falls with the distance, and
    at the place for standing still. Motion across counts, because a character that circles never arrives. The direction
    to face is a factor of the first term, so that it matters only at the place.

    Args:
        velocity: Horizontal velocity of the centre of mass :math:`v_{com}`, shape ``(*B, 2)``, in m/s.
        offset: The place relative to the centre of mass :math:`x`, shape ``(*B, 2)``, in metres.
        speed: Speed far from the place :math:`\hat{v}`, in m/s.
        alignment: Cosine :math:`c` of the angle between the character's heading and the direction to face at the place,
            shape ``(*B)``; 1 if it may face any direction.

    Returns:
        Reward, shape ``(*B)``.
    """
    towards = velocity_reward(velocity, location_velocity(offset, speed))
    return 0.4 * (-offset.square().sum(-1)).exp() * (1 + alignment) / 2 + 0.6 * towards


def location_velocity(offset: Tensor, speed: float) -> Tensor:
    r"""Target velocity :math:`v^*` of the location task, shape ``(*B, 2)``, in m/s.

    .. math:: v^* = \frac{x}{\|x\|} \min(\hat{v}, \|x\| / 1 \text{ s}) \text{, and 0 for } \|x\| < 0.3 \text{ m}

    Args:
        offset: The place relative to the centre of mass :math:`x`, shape ``(*B, 2)``, in metres.
        speed: Speed far from the place :math:`\hat{v}`, in m/s.
    """
    distance = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
    wanted = distance.clamp(max=speed) * (distance >= ARRIVAL_DISTANCE)
    return torch.nn.functional.normalize(offset, dim=-1) * wanted


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
    squared_gaps = missing_speeds.square()
    squared_distances = ways.square().sum(-1)
    cv = -1.5 * squared_gaps[0]
    cp = -proximity_scale * squared_distances[0]
    bv = -squared_gaps[1]
    bp = -0.5 * squared_distances[1].pow(target_distance_power / 2)
    exponents = torch.stack([cv, cp, bv, bp], -1)
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


def training_reward(
    reward: Tensor,
    success: Tensor,
    *,
    weights: Sequence[float],
    speed: float,
    worth: float,
) -> Tensor:
    r"""Reward for training to carry and dribble: about zero for standing still, and greatest for a success.

    .. math::
        r' = \begin{cases}
            c \, (\sum_i w_i - r_{idle}) & \text{in success} \\
            r - r_{idle} & \text{else}
        \end{cases}

    With the printed reward, standing still earns a third of the best return, and policies learn to stand. A step in
    success earns :math:`c` times as much as a step in which all terms are 1, because an object at rest loses the
    reward for its speed. With :math:`c = 1`, a character that holds the box just beside the target earns nearly as
    much as a character that has put the box down, so that carrying needs a larger :math:`c`.

    Args:
        reward: :func:`transport_reward` with these weights, shape ``(*B)``.
        success: Whether the object is at its target, shape ``(*B)``, bool.
        weights: :math:`(w^{cv}, w^{cp}, w^{bv}, w^{bp})`.
        speed: Target speed :math:`\hat{v}`, in m/s, for the :func:`idle_reward`.
        worth: Worth of a step in success as a multiple of the best reward without it, :math:`c`.

    Returns:
        Reward, shape ``(*B)``.
    """
    idle = idle_reward(weights, speed)
    return (reward - idle).masked_fill(success, worth * (sum(weights) - idle))
