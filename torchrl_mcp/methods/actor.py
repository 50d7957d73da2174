"""The actor that all methods build: networks as TensorDictModules.

A method first makes named *parts*, plain modules that transfer keeps, freezes or re-initialises by name. Then it makes
an :class:`Actor` over them: ``policy`` acts, and the loss differentiates ``trained``. These are the same module unless
the primitives are frozen, the exploration acts on the gate, or noise enters before the action.

| key | content | shape |
|---|---|---|
| ``observation``, ``goal`` | state and goal from the environment | ``(*B, S)``, ``(*B, G)`` |
| ``normalised`` / ``observation``, ``goal`` | the same, standardised and clipped | |
| ``gate_logits``, ``gates`` | before and after the gate's activation | ``(*B, K)`` |
| ``primitives`` / ``loc``, ``scale`` | means and standard deviations of the primitives | ``(*B, K, A)`` |
| ``action`` | input of the environment | ``(*B, A)`` |
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import NamedTuple

from tensordict import NestedKey
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Distribution

from torchrl_mcp.modules.normaliser import RunningNormaliser

STATE = ("normalised", "observation")
GOAL = ("normalised", "goal")
PRIMITIVES = (("primitives", "loc"), ("primitives", "scale"))

Composition = Callable[[Tensor, Tensor, Tensor], Distribution]

Explorer = Callable[[Tensor], Tensor]
"""Random exploration of Section 5.3: from normalised states ``(N, S)`` to actions ``(N, A)``, without a goal.

``method.explorer`` makes one from the parts, the number N and a generator.
"""


class Sizes(NamedTuple):
    """Sizes of what a method's networks see and do.

    Attributes:
        observation: Size of the state, ``S``.
        goal: Size of the goal, ``G``.
        action: Size of the action, ``A``.
    """

    observation: int
    goal: int
    action: int


@dataclass(frozen=True)
class Actor:
    """A policy in parts: all that collection, losses, diagnostics, films and exports ask of a method.

    Attributes:
        policy: Module that collection and evaluation run: from ``observation`` and ``goal`` to ``action``.
        trained: Module that the loss differentiates: from a stored sample to the distribution of ``sampled``.
        stored: Keys, beside the environment's own, that a sample must hold for the loss and the diagnostics.
        drawn: Keys of ``stored`` with random values, rather than values computed from ``observation`` and ``goal``.
        sampled: Key of the random variable whose log-probability the policy gradient takes.
        num_options: Number of options of which one acts at a time, 0 for a policy without options. The samples of a
            policy with options hold the ``option`` that acted.
    """

    policy: TensorDictModuleBase
    trained: ProbabilisticTensorDictSequential
    stored: tuple[NestedKey, ...] = ()
    sampled: str = "action"
    drawn: tuple[NestedKey, ...] = ()
    num_options: int = 0

    @property
    def log_prob(self) -> str:
        """Key of the log-probability of ``sampled`` under the policy that drew it."""
        return f"{self.sampled}_log_prob"


def input_normalisers(sizes: Sizes) -> dict[str, nn.Module]:
    """Make the parts that :func:`normalise_inputs` needs: ``observation_normaliser`` and ``goal_normaliser``."""
    return {
        "observation_normaliser": RunningNormaliser(sizes.observation),
        "goal_normaliser": RunningNormaliser(sizes.goal),
    }


def normalise_inputs(parts: nn.ModuleDict) -> TensorDictSequential:
    """Return the module that standardises ``observation`` and ``goal`` by the parts of those names."""
    return TensorDictSequential(
        TensorDictModule(parts["observation_normaliser"], in_keys=["observation"], out_keys=[STATE]),
        TensorDictModule(parts["goal_normaliser"], in_keys=["goal"], out_keys=[GOAL]),
    )


def require_frozen(part: str, frozen: Collection[str], *, over: str) -> None:
    """Check that exploration over an input of a part, which gives the part no gradient, does not have to train it.

    Args:
        part: Name of the part.
        frozen: Names of the parts that do not change in training.
        over: What is sampled instead of the action.

    Raises:
        ValueError: If the part is not frozen.
    """
    if part not in frozen:
        raise ValueError(
            f"exploration over {over} does not train {part!r}: use it with stage=transfer and keep {part!r} in "
            "transfer.freeze, or take exploration=action"
        )


def sampler(
    out_key: str, distribution_class: Callable[..., Distribution], **in_keys: NestedKey
) -> ProbabilisticTensorDictModule:
    """Return the module that draws ``out_key`` and stores its log-probability as ``<out_key>_log_prob``."""
    return ProbabilisticTensorDictModule(
        in_keys=in_keys,
        out_keys=[out_key],
        distribution_class=distribution_class,
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )
