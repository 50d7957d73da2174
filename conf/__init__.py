"""Hydra configuration of torchrl-mcp, found by Hydra as ``pkg://torchrl_mcp.conf``."""

if __name__ != "torchrl_mcp.conf":
    raise ImportError(
        "import torchrl_mcp.conf, not conf: this folder is a part of the torchrl_mcp package "
        "(install it with `pip install -e .` and use the full name)"
    )
