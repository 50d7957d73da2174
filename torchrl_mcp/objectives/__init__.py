"""Losses and estimators that TorchRL does not have."""

from torchrl_mcp.objectives.advantages import Advantages
from torchrl_mcp.objectives.latent import LatentPPOLoss
from torchrl_mcp.objectives.option_critic import OptionAdvantages, OptionCriticLoss
from torchrl_mcp.objectives.ppo import BoundedClipPPOLoss
from torchrl_mcp.objectives.semi_markov import SemiMarkovAdvantages

__all__ = [
    "Advantages",
    "BoundedClipPPOLoss",
    "LatentPPOLoss",
    "OptionAdvantages",
    "OptionCriticLoss",
    "SemiMarkovAdvantages",
]
