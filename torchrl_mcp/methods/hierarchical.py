"""The hierarchical baseline: a gate picks one of K primitives and keeps it for a walk cycle (Section E.4)."""

from collections.abc import Callable, Collection
from inspect import signature

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import IndependentNormal

from torchrl_mcp.methods.actor import GOAL, STATE, Actor, Explorer, Sizes, input_normalisers, normalise_inputs, sampler
from torchrl_mcp.methods.options import Choice, RandomSequence, WhereBeginning, keep_option
from torchrl_mcp.values import Count, checked


def primitive_parts(sizes: Sizes, *, primitives: Callable[..., nn.Module], num_options: Count) -> nn.ModuleDict:
    """Make the parts of pre-training: ``observation_normaliser``, ``goal_normaliser`` and ``primitives``.

    Args:
        sizes: Sizes of state, goal and action.
        primitives: Makes the primitives from ``(S, A, K)``.
        num_options: Number of options, ``K``, each of which is a primitive.

    Returns:
        The parts by name.

    Raises:
        ValueError: If the primitives are not called with a state and an option.
    """
    networks = primitives(sizes.observation, sizes.action, num_options)
    try:
        signature(networks.forward).bind("state", "option")
    except TypeError as error:
        raise ValueError(
            f"{type(networks).__name__} does not take a state and an option: pass primitives=separate"
        ) from error
    return nn.ModuleDict({**input_normalisers(sizes), "primitives": networks})


def gated_parts(
    sizes: Sizes, *, gating: Callable[..., nn.Module], primitives: Callable[..., nn.Module], num_options: Count
) -> nn.ModuleDict:
    """Make the parts of transfer: the parts of :func:`primitive_parts` and ``gating``.

    Args:
        sizes: Sizes of state, goal and action.
        gating: Makes the network for the logits of the choice from ``(S, G, K)``.
        primitives: Makes the primitives from ``(S, A, K)``.
        num_options: Number of options, ``K``, each of which is a primitive.

    Returns:
        The parts by name.
    """
    parts = primitive_parts(sizes, primitives=primitives, num_options=num_options)
    parts["gating"] = gating(sizes.observation, sizes.goal, num_options)
    return parts


def primitive_actor(parts: nn.ModuleDict, *, num_options: Count, frozen: Collection[str] = ()) -> Actor:
    """Let the primitive act whose index the environment sends as ``option``, so that all primitives train side by side.

    Args:
        parts: Made by :func:`primitive_parts`.
        num_options: Number of options, ``K``, each of which is a primitive.
        frozen: Names of the parts that do not change in training.
    """
    policy = ProbabilisticTensorDictSequential(normalise_inputs(parts), *_acting(parts))
    return Actor(policy, policy, stored=("option",), num_options=num_options)


@checked
def gated_actor(
    parts: nn.ModuleDict,
    *,
    num_options: Count,
    steps_per_choice: Count,
    action_noise: bool = True,
    frozen: Collection[str] = (),
) -> Actor:
    r"""Draw a primitive from the gate :math:`w(s, g)` every ``steps_per_choice`` steps, and let it act in between.

    Args:
        parts: Made by :func:`gated_parts`.
        num_options: Number of options, ``K``, each of which is a primitive.
        steps_per_choice: Control steps for which a primitive acts.
        action_noise: Whether a primitive samples its actions, which does not help the gate to learn, or plays means.
        frozen: Names of the parts that do not change in training.

    Raises:
        ValueError: If the primitives are not frozen, or ``steps_per_choice`` is not positive.

    Example:
        The environment must have the transform :class:`~torchrl_mcp.methods.transforms.OptionMemory`.

        >>> from functools import partial
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.hierarchical import gated_actor, gated_parts
        >>> from torchrl_mcp.methods.options import SeparateOptions
        >>> from torchrl_mcp.methods.transforms import OptionMemory, TransformedCharacterEnv
        >>> from torchrl_mcp.modules import GaussianPolicy, JointGating
        >>> primitives = partial(SeparateOptions, policy=GaussianPolicy)
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = gated_parts(sizes, gating=JointGating, primitives=primitives, num_options=7)
        >>> actor = gated_actor(parts, num_options=7, steps_per_choice=30, frozen=["primitives"])
        >>> env = TransformedCharacterEnv(Heading("biped", num_envs=2, seed=0), OptionMemory())
        >>> env.rollout(3, actor.policy)["begins"]  # the gate chooses in the first step
        tensor([[ True, False, False],
                [ True, False, False]])
    """
    if "primitives" not in frozen:
        raise ValueError("choosing a primitive trains only the gate: keep 'primitives' in transfer.freeze")
    gate = WhereBeginning(parts["gating"], num_options)
    choice = sampler("option", Choice, logits="gate_logits")
    trained = ProbabilisticTensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["gating"], in_keys=[STATE, GOAL], out_keys=["gate_logits"]),
        choice,
    )
    policy = TensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(Clock(steps_per_choice), in_keys=["held_steps"], out_keys=["begins"]),
        TensorDictModule(gate, in_keys=[STATE, GOAL, "begins"], out_keys=["gate_logits"]),
        choice,
        TensorDictModule(keep_option, in_keys=["begins", "option", "held_option"], out_keys=["option"]),
        *(_acting(parts) if action_noise else _playing_means(parts)),
    )
    return Actor(policy, trained, stored=("option", "begins"), sampled="option", num_options=num_options)


def random_sequence(
    parts: nn.ModuleDict, num: int, generator: torch.Generator, *, num_options: Count, steps: Count
) -> Explorer:
    """Return a :class:`.RandomSequence` of the primitives in the parts of :func:`primitive_parts`."""
    return RandomSequence(parts["primitives"], num, generator, num_options=num_options, steps=steps)


class Clock(nn.Module):
    """Decides when the gate chooses again."""

    def __init__(self, steps_per_choice: Count) -> None:
        """Set the number of control steps between choices."""
        super().__init__()
        self.steps_per_choice = steps_per_choice

    def forward(self, held_steps: Tensor) -> Tensor:
        """Return whether to choose, ``(*B)``, bool, from the steps since the last choice (0 if there was none)."""
        return held_steps.remainder(self.steps_per_choice) == 0


def _playing_means(parts: nn.ModuleDict) -> tuple[TensorDictModule]:
    return (TensorDictModule(parts["primitives"], in_keys=[STATE, "option"], out_keys=["action", "scale"]),)


def _acting(parts: nn.ModuleDict) -> tuple[TensorDictModule, TensorDictModule]:
    return (
        TensorDictModule(parts["primitives"], in_keys=[STATE, "option"], out_keys=["loc", "scale"]),
        sampler("action", IndependentNormal, loc="loc", scale="scale"),
    )
