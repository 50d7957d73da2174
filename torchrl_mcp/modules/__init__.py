"""The networks of all methods as plain ``torch.nn`` modules, which take and return tensors.

Shapes: ``B`` is any batch shape, ``S`` the size of the state, ``G`` of the goal, ``A`` of the action, and ``K`` is the
number of primitives. In numbers of hidden units such as ``(512, 256)``, each number is a layer.
"""

from torchrl_mcp.modules.gating import Gating, JointGating, gate_diagnostics
from torchrl_mcp.modules.gaussian import GaussianPolicy
from torchrl_mcp.modules.injection import InjectedPolicy, InputInjection
from torchrl_mcp.modules.latent import GoalEncoder, StateGoalEncoder
from torchrl_mcp.modules.normaliser import RunningNormaliser
from torchrl_mcp.modules.primitives import PolicyPrimitives, Primitives

__all__ = [
    "Gating",
    "GaussianPolicy",
    "GoalEncoder",
    "InjectedPolicy",
    "InputInjection",
    "JointGating",
    "PolicyPrimitives",
    "Primitives",
    "RunningNormaliser",
    "StateGoalEncoder",
    "gate_diagnostics",
]
