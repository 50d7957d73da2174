"""What the training loop asks of the loss of an actor."""

from torch import nn

REPORTS = ("kl_approx", "mean_ratio")
"""Outputs from which the loop estimates the KL divergence of an update, as TorchRL's PPO losses name them."""


class ActorLoss(nn.Module):
    r"""Base class of own losses of actors; TorchRL's ``ClipPPOLoss`` and its subclasses need no other.

    The forward pass takes samples ``(B,)`` and returns scalars: terms to minimise, whose names begin with ``loss_``,
    and reports. Two reports are required, of the ratios :math:`r` of the probabilities of the samples after the steps
    so far to those at collection: ``mean_ratio``, :math:`E[r]`, and ``kl_approx``, :math:`-E[\log r]`.

    Attributes:
        out_keys: Names of all outputs.
    """

    out_keys: list[str]


def require_reports(loss: nn.Module) -> None:
    """Check that a loss declares the outputs that the loop reads.

    Raises:
        ValueError: If it does not.
    """
    if missing := [name for name in REPORTS if name not in getattr(loss, "out_keys", ())]:
        raise ValueError(
            f"{type(loss).__name__} does not report {' and '.join(missing)}: return them with the loss, name them in "
            "its out_keys, and derive it from torchrl_mcp.objectives.ActorLoss"
        )
