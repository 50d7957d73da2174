"""Plain networks: nothing here knows a tensordict key."""

from torchrl_mcp.modules.gating import Gating, JointGating, gate_diagnostics
from torchrl_mcp.modules.gaussian import GaussianPolicy
from torchrl_mcp.modules.injection import InjectedPolicy, InputInjection
from torchrl_mcp.modules.latent import GoalEncoder, StateGoalEncoder
from torchrl_mcp.modules.normaliser import RunningNormaliser
from torchrl_mcp.modules.primitives import Primitives

__all__ = [
    "Gating",
    "GaussianPolicy",
    "GoalEncoder",
    "InjectedPolicy",
    "InputInjection",
    "JointGating",
    "Primitives",
    "RunningNormaliser",
    "StateGoalEncoder",
    "gate_diagnostics",
]
