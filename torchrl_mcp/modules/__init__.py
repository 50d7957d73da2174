"""Plain networks: nothing here knows a tensordict key."""

from torchrl_mcp.modules.gating import Gating, gate_diagnostics
from torchrl_mcp.modules.gaussian import GaussianPolicy
from torchrl_mcp.modules.normaliser import RunningNormaliser
from torchrl_mcp.modules.primitives import Primitives

__all__ = ["Gating", "GaussianPolicy", "Primitives", "RunningNormaliser", "gate_diagnostics"]
