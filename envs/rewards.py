"""Rewards of the paper's tasks, as functions of tensors."""

from torch import Tensor


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
    reward terms and prints the name of the third weight twice; the fourth is that of the contacts.

    Args:
        velocity: Horizontal velocity of the body :math:`v_{com}`, shape ``(*B, 2)``, in m/s.
        direction: Target direction :math:`\hat{u}`, a unit vector, shape ``(*B, 2)``.
        action: Action :math:`a`, shape ``(*B, A)``.
        healthy: Whether the character still walks, shape ``(*B)``, bool.
        contact_forces: Clipped external forces :math:`c`, shape ``(*B, F)``, or None to leave their cost out.
        forward_weight: Paper: 1.
        healthy_weight: Paper: 1.
        control_weight: Paper: 0.5.
        contact_weight: Paper: 0.0005.

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
