"""Multiplicative Compositional Policies as TorchRL components.

The distributions can be imported from here, everything else from the packages.

Reference:
    Peng, Chang, Zhang, Abbeel and Levine, "MCP: Learning Composable Hierarchical Control with
    Multiplicative Compositional Policies", NeurIPS 2019, https://arxiv.org/abs/1905.09808
"""

from importlib import import_module as _import_module
from pathlib import Path as _Path
from typing import TYPE_CHECKING as _TYPE_CHECKING
from typing import Any as _Any

if _TYPE_CHECKING:
    from torchrl_mcp.distributions import AdditiveGaussian, MultiplicativeGaussian, TanhMultiplicativeGaussian

__version__ = "0.1.0"

__all__ = ["AdditiveGaussian", "MultiplicativeGaussian", "TanhMultiplicativeGaussian", "__version__"]

_PACKAGES = ("distributions", "envs", "evaluation", "methods", "modules", "objectives", "runs", "training")

# Without them Python may find torchrl_mcp.envs and torchrl_mcp.conf in another clone that is installed.
for _folder in (_Path(__file__).with_name(name) for name in ("conf", "envs")):
    if not _folder.is_dir():
        raise ImportError(
            f"{_folder} must be a folder, in a clone a link to ../{_folder.name}: let Git write links by "
            f"`git config core.symlinks true`, then run `git checkout -- torchrl_mcp/conf torchrl_mcp/envs`"
        )
del _folder


def __getattr__(name: str) -> _Any:
    """Import what is asked for: the package itself imports nothing."""
    if name in _PACKAGES:
        return _import_module(f"torchrl_mcp.{name}")
    if name in __all__:
        return getattr(_import_module("torchrl_mcp.distributions"), name)
    raise AttributeError(f"module 'torchrl_mcp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*__all__, *_PACKAGES])
