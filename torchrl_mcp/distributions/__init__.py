"""Action distributions composed of K Gaussian primitives.

They use torch alone; the package around them imports Gymnasium, to register its environments.
"""

from torchrl_mcp.distributions.additive import AdditiveGaussian
from torchrl_mcp.distributions.multiplicative import MultiplicativeGaussian
from torchrl_mcp.distributions.squashed import TanhMultiplicativeGaussian

__all__ = ["AdditiveGaussian", "MultiplicativeGaussian", "TanhMultiplicativeGaussian"]
