r"""The option-critic baseline: options with learned terminations, and values that choose among them (Section E.5).

.. math::
    U(\omega, s') = (1 - \beta_\omega(s')) Q_\Omega(s', \omega) + \beta_\omega(s') V_\Omega(s')

is the value of arriving in s' with the option :math:`\omega`. To compute it, the critic returns the values of all
options and their termination probabilities.

| key | content | shape |
|---|---|---|
| ``held_option``, ``held_steps`` | option of the previous step, and number of steps for which it has acted | ``(*B)`` |
| ``begins``, ``option`` | whether an option begins, and which one acts | ``(*B)`` |
| ``option_values``, ``terminations`` | Q and beta of all options | ``(*B, K)`` |
| ``termination`` | beta of the option that acted, in the next state | ``(*B)`` |
"""

from collections.abc import Callable, Collection
from functools import partial

import torch
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.modules import IndependentNormal

from torchrl_mcp.methods.actor import (
    GOAL,
    PRIMITIVES,
    STATE,
    Actor,
    Explorer,
    Sizes,
    input_normalisers,
    normalise_inputs,
    sampler,
)
from torchrl_mcp.methods.critic import value_network
from torchrl_mcp.methods.options import (
    EpsilonGreedy,
    RandomSequence,
    WhereBeginning,
    keep_option,
    of_option,
)
from torchrl_mcp.values import Count, Positive, Share, Widths

ARRIVAL = ("next", "observation")


def option_critic_parts(
    sizes: Sizes,
    *,
    options: Callable[..., nn.Module],
    terminations: Callable[..., nn.Module],
    values_cells: Widths,
    num_options: Count,
    width: Positive = 1.0,
) -> nn.ModuleDict:
    """Make the parts ``observation_normaliser``, ``goal_normaliser``, ``options``, ``terminations`` and ``critic``.

    Args:
        sizes: Sizes of state, goal and action.
        options: Makes the network of all options, from a state to means and standard deviations, from ``(S, A, K)``.
        terminations: Makes the termination network of all options from ``(S, K)``.
        values_cells: Hidden units of the critic.
        width: Factor on ``values_cells``.
        num_options: Number of options, ``K``.

    Returns:
        The parts by name.
    """
    return nn.ModuleDict(
        {
            **input_normalisers(sizes),
            "options": options(sizes.observation, sizes.action, num_options),
            "terminations": terminations(sizes.observation, num_options),
            "critic": value_network(sizes, num_options, num_cells=values_cells, width=width),
        }
    )


def option_critic_actor(
    parts: nn.ModuleDict, *, num_options: Count, epsilon: Share, frozen: Collection[str] = ()
) -> Actor:
    r"""Choose the option of highest value at the beginning of an episode and when an option ends, and let it act.

    Without exploration, the choice of the option and its action become deterministic, but terminations remain random,
    because no threshold on :math:`\beta` would keep the rates at which options change.

    Args:
        parts: Made by :func:`option_critic_parts`.
        num_options: Number of options, ``K``.
        epsilon: Probability of a random choice.
        frozen: Names of the parts that do not change in training.

    Example:
        The environment must have the transform :class:`~torchrl_mcp.methods.transforms.OptionMemory`.

        >>> from functools import partial
        >>> from torchrl_mcp.envs import Heading
        >>> from torchrl_mcp.methods.actor import Sizes
        >>> from torchrl_mcp.methods.option_critic import option_critic_actor, option_critic_parts
        >>> from torchrl_mcp.methods.options import Terminations
        >>> from torchrl_mcp.methods.transforms import OptionMemory, TransformedCharacterEnv
        >>> from torchrl_mcp.modules import Primitives
        >>> networks = {"options": Primitives, "terminations": partial(Terminations, num_cells=[256], initial=0.1)}
        >>> sizes = Sizes(observation=105, goal=2, action=17)
        >>> parts = option_critic_parts(sizes, **networks, values_cells=[256], num_options=8)
        >>> actor = option_critic_actor(parts, num_options=8, epsilon=0.1)
        >>> env = TransformedCharacterEnv(Heading("biped", num_envs=2, seed=0), OptionMemory())
        >>> acted = env.rollout(3, actor.policy)
        >>> acted["option"].shape, acted["terminations"].shape
        (torch.Size([2, 3]), torch.Size([2, 3, 8]))
    """
    values = WhereBeginning(parts["critic"], num_options)
    drawn = sampler("option", partial(EpsilonGreedy, epsilon=epsilon), values="option_values")
    policy = TensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["terminations"], in_keys=[STATE], out_keys=["terminations"]),
        TensorDictModule(begins, in_keys=["terminations", "held_option", "held_steps"], out_keys=["begins"]),
        TensorDictModule(values, in_keys=[STATE, GOAL, "begins"], out_keys=["option_values"]),
        drawn,
        TensorDictModule(keep_option, in_keys=["begins", "option", "held_option"], out_keys=["option"]),
        *_acting(parts),
    )
    arriving: tuple[TensorDictModule, ...] = ()
    if "terminations" not in frozen:
        normaliser = parts["observation_normaliser"]
        state = ("normalised", "arrival")
        arriving = (
            TensorDictModule(normaliser, in_keys=[ARRIVAL], out_keys=[state]),
            TensorDictModule(parts["terminations"], in_keys=[state], out_keys=["terminations"]),
            TensorDictModule(termination, in_keys=["terminations", "option"], out_keys=["termination"]),
        )
    trained = ProbabilisticTensorDictSequential(normalise_inputs(parts), *arriving, *_acting(parts))
    return Actor(policy, trained, stored=("option", "begins"), num_options=num_options)


def option_values(parts: nn.ModuleDict, sizes: Sizes) -> TensorDictSequential:
    r"""Return the critic: from ``observation`` and ``goal`` to ``option_values`` and ``terminations``.

    Args:
        parts: Made by :func:`option_critic_parts`, whose ``critic`` is :math:`Q_\Omega(s, g, \omega)`.
        sizes: Sizes of state, goal and action.

    Returns:
        The module. ``option_values`` and ``terminations`` have the shape ``(*B, K)``.

    Raises:
        ValueError: If the parts lack ``critic`` or ``terminations``.
    """
    if missing := {"critic", "terminations"} - set(parts):
        raise ValueError(f"the method has no part {' or '.join(sorted(missing))}: use critic=mlp, as for policies")
    return TensorDictSequential(
        normalise_inputs(parts),
        TensorDictModule(parts["critic"], in_keys=[STATE, GOAL], out_keys=["option_values"]),
        TensorDictModule(parts["terminations"], in_keys=[STATE], out_keys=["terminations"]),
    )


def random_sequence(
    parts: nn.ModuleDict, num: int, generator: torch.Generator, *, num_options: Count, steps: Count
) -> Explorer:
    """Return a :class:`.RandomSequence` of the options in the parts of :func:`option_critic_parts`."""

    def options(state: Tensor, option: Tensor) -> tuple[Tensor, Tensor]:
        loc, scale = parts["options"](state)
        return acting_option(loc, scale, option)

    return RandomSequence(options, num, generator, num_options=num_options, steps=steps)


def begins(terminations: Tensor, held_option: Tensor, held_steps: Tensor) -> Tensor:
    """Draw whether an option begins, ``(*B)``, bool, which it does if there is no option yet or the option ends.

    Args:
        terminations: Probabilities with which options end, shape ``(*B, K)``.
        held_option: The option of the previous step, shape ``(*B)``.
        held_steps: Steps for which this option has acted, 0 if there is none, shape ``(*B)``.
    """
    ends = termination(terminations, held_option)
    return (held_steps == 0) | (torch.rand_like(ends) < ends)


def termination(terminations: Tensor, option: Tensor) -> Tensor:
    """Select the probabilities of the options ``(*B)`` from those of all options, ``(*B, K)``."""
    return of_option(terminations, option).squeeze(-1)


def acting_option(loc: Tensor, scale: Tensor, option: Tensor) -> tuple[Tensor, Tensor]:
    """Select mean and standard deviation, ``(*B, A)``, of the options ``(*B)`` from those of all, ``(*B, K, A)``."""
    index = option[..., None, None].expand(*option.shape, 1, loc.shape[-1])
    return loc.gather(-2, index).squeeze(-2), scale.gather(-2, index).squeeze(-2)


def _acting(parts: nn.ModuleDict) -> tuple[TensorDictModule, TensorDictModule, ProbabilisticTensorDictModule]:
    return (
        TensorDictModule(parts["options"], in_keys=[STATE], out_keys=list(PRIMITIVES)),
        TensorDictModule(acting_option, in_keys=[*PRIMITIVES, "option"], out_keys=["loc", "scale"]),
        sampler("action", IndependentNormal, loc="loc", scale="scale"),
    )
