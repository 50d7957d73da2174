r"""The finetuning model (Section E.3): one motion is imitated, then the goals of a task are injected.

.. math:: \pi(a|s) = \mathcal{N}(\mu(s, 0), \Sigma) \quad \longrightarrow \quad
    \pi(a|s, g) = \mathcal{N}(\mu(s, J g), \Sigma), \qquad J = 0

As in Berseth et al., the inputs of pre-training stay, and new ones enter the first layer with weights of zero. The
task begins with the means of the pre-trained policy bit for bit, for any goal, and with new noise (``restart_noise``);
then all weights train. The paper injects "goal inputs g that are not present during training", hence the policy
imitates its motion blindly, from the state alone. The critic sees the reference, and is re-initialised for the task. If
pre-training has the task's own goal, as in the holdout, the policy sees it from the start and keeps its weights.

A policy that does see the reference (``parts.blind=false`` in pre-training) is transferred in the same way. Its weights
for the reference are dropped. This amounts to holding these inputs at their mean over pre-training, zero after
normalisation: the task begins, bit for bit, with the means of the pre-trained policy at that mean.

Reference:
    Peng et al., *MCP*, NeurIPS 2019, Section E.3. https://arxiv.org/abs/1905.09808
    Berseth et al., *Progressive Reinforcement Learning with Distillation for Multi-Skilled Motion Control*, ICLR 2018.
    https://arxiv.org/abs/1802.04765
"""

from collections.abc import Callable, Collection

from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal

from torchrl_mcp.methods.actor import GOAL, STATE, Actor, Sizes, input_normalisers, normalise_inputs, sampler
from torchrl_mcp.modules.injection import InjectedPolicy, InputInjection


def injected_parts(sizes: Sizes, *, policy: Callable[[int, int], InjectedPolicy], blind: bool) -> nn.ModuleDict:
    """Make the parts ``observation_normaliser``, ``goal_normaliser``, ``policy`` and ``goal_input``.

    Args:
        sizes: Sizes of state, goal and action.
        policy: Makes the network from ``(S, A)``.
        blind: Leave the weights of the goal at zero.
    """
    network = policy(sizes.observation, sizes.action)
    return nn.ModuleDict(
        {
            **input_normalisers(sizes),
            "policy": network,
            "goal_input": InputInjection(sizes.goal, network.input.out_features).requires_grad_(not blind),
        }
    )


def injected_actor(parts: nn.ModuleDict, *, frozen: Collection[str] = ()) -> Actor:
    """One Gaussian policy over the state, with the goal injected.

    Args:
        parts: Made by :func:`injected_parts`.
        frozen: Names of the parts that do not change in training; the policy is still evaluated in full.
    """
    policy = ProbabilisticTensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["goal_input"], in_keys=[GOAL], out_keys=["injection"]),
        TensorDictModule(parts["policy"], in_keys=[STATE, "injection"], out_keys=["loc", "scale"]),
        sampler("action", IndependentNormal, loc="loc", scale="scale"),
    )
    return Actor(policy, policy)
