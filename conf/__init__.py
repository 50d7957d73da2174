"""Hydra configuration of torchrl-mcp, which Hydra finds as ``pkg://torchrl_mcp.conf``."""

if __name__ != "torchrl_mcp.conf":
    raise ImportError(
        "import torchrl_mcp.conf, not conf: this folder is a part of the torchrl_mcp package "
        "(install it with `pip install -e .` and use the full name). Your own folder `conf` needs an __init__.py"
    )

from omegaconf import OmegaConf

from torchrl_mcp.runs.identity import UNNAMED, folder_name

# Hydra imports this package to read its files, so the resolvers are always registered before they are needed.
OmegaConf.register_new_resolver("folder_name", folder_name, replace=True)
OmegaConf.register_new_resolver("unnamed", lambda: sorted(UNNAMED), replace=True)
