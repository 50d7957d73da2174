"""The actor that all methods build: networks as TensorDictModules.

A method first makes named *parts*, which are plain modules. Transfer keeps, freezes or makes anew each part by name.
Then the method makes an :class:`Actor` from the parts: ``policy`` acts, and the loss differentiates ``trained``. Both
are the same module unless the primitives are frozen, exploration acts on the gate, noise enters before the action, or a
policy over options acts.

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

``method.explorer`` makes it from the parts, the number N and a generator.
"""


class Sizes(NamedTuple):
    """Sizes of the inputs and outputs of a method's networks.

    Attributes:
        observation: Size of the state, ``S``.
        goal: Size of the goal, ``G``.
        action: Size of the action, ``A``.

    Example:
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> Sizes(observation=105, goal=2, action=17)
        Sizes(observation=105, goal=2, action=17)
    """

    observation: int
    goal: int
    action: int


@dataclass(frozen=True)
class Actor:
    """A policy, and all that collection, losses, diagnostics, films and exports need of it.

    Attributes:
        policy: Module that acts, in collection and evaluation: from ``observation`` and ``goal`` to ``action``.
        trained: Module that the loss differentiates: from a stored sample to the distribution of ``sampled``.
        stored: Keys of a sample, beside those of the environment, that the loss and the diagnostics need.
        drawn: Keys of ``stored`` with random values, which cannot be computed from ``observation`` and ``goal``.
        sampled: Key of the random variable whose log-probability the policy gradient uses.
        num_options: Number of options, one of which acts at a time; 0 for a policy without options. The samples of a
            policy with options contain the ``option`` that acted.

    Example:
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.scratch import gaussian_actor, gaussian_parts
        >>> from torchrl_mcp.modules import GaussianPolicy
        >>> actor = gaussian_actor(gaussian_parts(Sizes(observation=105, goal=2, action=17), policy=GaussianPolicy))
        >>> actor.sampled, actor.log_prob, actor.policy is actor.trained
        ('action', 'action_log_prob', True)
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
    """Make the two parts that :func:`normalise_inputs` needs, ``observation_normaliser`` and ``goal_normaliser``.

    Example:
        >>> from torchrl_mcp.methods.actor import Sizes, input_normalisers
        >>> parts = input_normalisers(Sizes(observation=105, goal=2, action=17))
        >>> {name: len(part.mean) for name, part in parts.items()}
        {'observation_normaliser': 105, 'goal_normaliser': 2}
    """
    return {
        "observation_normaliser": RunningNormaliser(sizes.observation),
        "goal_normaliser": RunningNormaliser(sizes.goal),
    }


def normalise_inputs(parts: nn.ModuleDict) -> TensorDictSequential:
    """Return the module that standardises ``observation`` and ``goal``.

    It writes the results, of the same shapes, as ``("normalised", "observation")`` and ``("normalised", "goal")``.
    Environments without a goal need no key ``goal``: if the normaliser has no features, the module makes an empty goal.

    Args:
        parts: Parts with ``observation_normaliser`` and ``goal_normaliser``, such as :func:`input_normalisers` makes.
    """
    goal = TensorDictModule(parts["goal_normaliser"], in_keys=["goal"], out_keys=[GOAL])
    if not parts["goal_normaliser"].get_buffer("mean").numel():
        goal = TensorDictModule(_no_goal, in_keys=["observation"], out_keys=[GOAL])
    observation = TensorDictModule(parts["observation_normaliser"], in_keys=["observation"], out_keys=[STATE])
    return TensorDictSequential(observation, goal)


def _no_goal(observation: Tensor) -> Tensor:
    """Return empty goals, ``(*B, 0)``, for observations ``(*B, S)``."""
    return observation[..., :0]


def require_frozen(part: str, frozen: Collection[str], *, over: str) -> None:
    """Check that a part is frozen, because exploration over its input gives the part no gradient.

    Args:
        part: Name of the part.
        frozen: Names of the parts that do not change in training.
        over: Name of the input that is sampled instead of the action.

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
