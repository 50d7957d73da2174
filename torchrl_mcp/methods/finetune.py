r"""The finetuning model (Section E.3): a policy imitates one motion, and then gets the goal of a task as a new input.

.. math:: \pi(a|s) = \mathcal{N}(\mu(s, 0), \Sigma) \quad \longrightarrow \quad
    \pi(a|s, g) = \mathcal{N}(\mu(s, J g), \Sigma), \qquad J = 0

As in Berseth et al., the inputs of pre-training stay, and new inputs enter the first layer with weights of zero. The
task therefore begins with the means of the pre-trained policy, bit for bit, whatever the goal. The noise begins anew
(``restart_noise``). Then all weights are trained.

The paper injects "goal inputs g that are not present during training". Hence the policy imitates its motion blindly,
from the state alone. The critic sees the reference, and begins anew for the task. If pre-training has the task's own
goal, as in holdout, the policy sees the goal from the start and keeps the weights of the goal.

A policy that does see the reference (``parts.blind=false`` in pre-training) is transferred in the same way, without its
weights for the reference. This amounts to holding these inputs at their mean over pre-training, which is zero after
normalisation: the task begins, bit for bit, with the means of the pre-trained policy at this mean.

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
        blind: Whether the weights of the goal stay at zero.

    Returns:
        The parts by name.
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

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.finetune import injected_actor, injected_parts
        >>> from torchrl_mcp.modules import InjectedPolicy
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> actor = injected_actor(injected_parts(sizes, policy=InjectedPolicy, blind=False))
        >>> states = TensorDict({"observation": torch.randn(16, 105), "goal": torch.randn(16, 2)}, [16])
        >>> actor.policy(states)["action"].shape
        torch.Size([16, 17])
    """
    policy = ProbabilisticTensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["goal_input"], in_keys=[GOAL], out_keys=["injection"]),
        TensorDictModule(parts["policy"], in_keys=[STATE, "injection"], out_keys=["loc", "scale"]),
        sampler("action", IndependentNormal, loc="loc", scale="scale"),
    )
    return Actor(policy, policy)
