"""What the training loop requires of the loss of an actor."""

from torch import nn

REPORTS = ("kl_approx", "mean_ratio")
"""Outputs from which the loop estimates the KL divergence of an update, as TorchRL's PPO losses name them."""


class ActorLoss(nn.Module):
    r"""Base class for a loss of an actor that is not a subclass of TorchRL's ``ClipPPOLoss``.

    The forward pass takes samples ``(B,)`` and returns scalars: the terms to minimise, whose names begin with
    ``loss_``, and reports. Let :math:`r` be the probability of a sample under the present policy divided by its
    probability under the policy that collected it. Two reports are required:

    - ``mean_ratio`` is :math:`E[r]`.
    - ``kl_approx`` is :math:`-E[\log r]`, in nats.

    Attributes:
        out_keys: Names of all outputs.

    Example:
        The policy gradient without clipping:

        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.objectives import ActorLoss
        >>> class PolicyGradient(ActorLoss):
        ...     out_keys = ["loss_objective", "mean_ratio", "kl_approx"]
        ...
        ...     def __init__(self, actor):
        ...         super().__init__()
        ...         self.actor = actor
        ...
        ...     def forward(self, samples):
        ...         log_prob = self.actor.trained.get_dist(samples).log_prob(samples["action"])
        ...         log_ratio = log_prob - samples["action_log_prob"]
        ...         return TensorDict(
        ...             loss_objective=-(log_prob * samples["advantage"].squeeze(-1)).mean(),
        ...             mean_ratio=log_ratio.exp().mean(),
        ...             kl_approx=-log_ratio.mean(),
        ...         )
    """

    out_keys: list[str]


def require_reports(loss: nn.Module) -> None:
    """Check that a loss declares the outputs that the loop reads.

    Raises:
        ValueError: If the loss does not declare them.
    """
    if missing := [name for name in REPORTS if name not in getattr(loss, "out_keys", ())]:
        raise ValueError(
            f"{type(loss).__name__} does not report {' and '.join(missing)}: return these values with the loss, name "
            "them in its out_keys, and derive the loss from torchrl_mcp.objectives.ActorLoss"
        )
