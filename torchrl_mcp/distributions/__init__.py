"""Action distributions composed of K Gaussian primitives. Importing them imports torch alone."""

from torchrl_mcp.distributions.additive import AdditiveGaussian
from torchrl_mcp.distributions.multiplicative import MultiplicativeGaussian
from torchrl_mcp.distributions.squashed import TanhMultiplicativeGaussian

__all__ = ["AdditiveGaussian", "MultiplicativeGaussian", "TanhMultiplicativeGaussian"]
