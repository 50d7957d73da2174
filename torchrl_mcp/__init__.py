"""Multiplicative Compositional Policies as TorchRL components.

Reference:
    Peng, Chang, Zhang, Abbeel and Levine, "MCP: Learning Composable Hierarchical Control with
    Multiplicative Compositional Policies", NeurIPS 2019, https://arxiv.org/abs/1905.09808
"""

__version__ = "0.1.0"
