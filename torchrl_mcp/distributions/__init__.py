"""Action distributions composed of K Gaussian primitives. Importing this package imports only torch.

All of them take the means ``loc`` ``(*B, K, A)`` and standard deviations ``scale`` ``(*B, K, A)`` of K primitives over
A actions, and one weight for each primitive, ``gates`` ``(*B, K)``.
"""

from torchrl_mcp.distributions.additive import AdditiveGaussian
from torchrl_mcp.distributions.multiplicative import MultiplicativeGaussian
from torchrl_mcp.distributions.squashed import TanhMultiplicativeGaussian

__all__ = ["AdditiveGaussian", "MultiplicativeGaussian", "TanhMultiplicativeGaussian"]
