"""Losses and estimators of advantages that TorchRL lacks.

An estimator takes trajectories ``(N, T)`` and adds its estimates. A loss takes samples ``(B,)`` and returns scalars.
"""

from torchrl_mcp.objectives.advantages import Advantages
from torchrl_mcp.objectives.latent import LatentPPOLoss
from torchrl_mcp.objectives.option_critic import OptionAdvantages, OptionCriticLoss, OptionValueLoss
from torchrl_mcp.objectives.ppo import ActorLoss, BoundedClipPPOLoss, ValueLoss
from torchrl_mcp.objectives.semi_markov import SemiMarkovAdvantages
from torchrl_mcp.objectives.symmetry import MirroredSamples, SymmetryLoss

__all__ = [
    "ActorLoss",
    "Advantages",
    "BoundedClipPPOLoss",
    "LatentPPOLoss",
    "MirroredSamples",
    "OptionAdvantages",
    "OptionCriticLoss",
    "OptionValueLoss",
    "SemiMarkovAdvantages",
    "SymmetryLoss",
    "ValueLoss",
]
