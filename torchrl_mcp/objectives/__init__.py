"""Losses and estimators that TorchRL does not have."""

from torchrl_mcp.objectives.advantages import Advantages
from torchrl_mcp.objectives.ppo import BoundedClipPPOLoss

__all__ = ["Advantages", "BoundedClipPPOLoss"]
