"""Records gates and primitives during a walk, and computes their specialisation, the numbers of Figure 7."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.analysis.gait import Feet, stride_phases
from torchrl_mcp.analysis.specialisation import (
    PHASE_BINS,
    between_primitives,
    bin_means,
    circular_correlation,
    explained_by_phase,
    principal_components,
    silhouettes,
    stance_correlation,
)
from torchrl_mcp.envs import Imitation
from torchrl_mcp.methods.actor import PRIMITIVES

Array = NDArray[np.float64]

STATES = 100
"""Number of states, spread evenly over the walk, whose actions are drawn and compared."""

GOLDEN = 0.6180339887498949
"""Fractional part of the golden ratio, any number of whose multiples are spread evenly over a cycle."""


@dataclass(frozen=True)
class Walk:
    """The samples of a policy in the complete strides of a walk.

    Attributes:
        phases: Phases of the stride in [0, 1), 0 when the right foot touches down, ``(M,)``.
        standing: Whether the right and the left foot stand, ``(M, 2)``.
        gates: Weights of the primitives, ``(M, K)``.
        actions: Mean actions of the primitives, ``(M, K, A)``.
        inputs: Inputs of the policy, ``observation`` and ``goal``, batch size ``(M,)``.
        strides: Number of strides.
        seconds: Mean duration of a stride in seconds.
    """

    phases: Array
    standing: NDArray[np.bool_]
    gates: Array
    actions: Array
    inputs: TensorDict
    strides: int
    seconds: float


def record_walk(policy: TensorDictModuleBase, env: Imitation, *, seconds: float = 10.0) -> Walk:
    """Record the complete strides of characters that follow the first reference motion.

    The characters begin at times that are spread evenly over the motion. Samples count until a character falls or loses
    its reference.

    Args:
        policy: From ``observation`` and ``goal`` to ``action``, ``gates`` and ``primitives``; its deterministic actions
            are played.
        env: Imitation, in which the reference does not change.
        seconds: Duration of the walk in seconds.

    Raises:
        ValueError: If there is no complete stride.
    """
    moments = env.library.durations[0] * (GOLDEN * torch.arange(env.num_envs, dtype=torch.float64) % 1)
    clips = torch.zeros(env.num_envs, dtype=torch.int64)
    env.reset()
    state = env.reset(env.get_state().update(TensorDict(env.beginning(clips, moments), env.batch_size)), set_state=True)
    feet = Feet(env)
    running = torch.ones(env.num_envs, dtype=torch.bool)
    steps = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(max(1, round(seconds / env.control_timestep))):
            decision = policy(state.select("observation", "goal"))
            steps.append(
                decision.select("observation", "goal", "gates", PRIMITIVES[0]).update(
                    {"standing": feet.standing(), "running": running.clone()}
                )
            )
            step, state = env.step_and_maybe_reset(state.update(decision))
            running &= ~step["next", "done"].squeeze(-1)
            if not running.any():
                break
    return complete_strides(TensorDict.stack(steps, 1), env.control_timestep)


def complete_strides(steps: TensorDictBase, timestep: float) -> Walk:
    """Find the complete strides of walkers, and concatenate their samples.

    Args:
        steps: Samples of N walkers, batch size ``(N, T)``, with ``observation``, ``goal``, ``gates``, ``primitives``,
            ``standing`` (whether each foot stands) and ``running`` (whether the sample counts).
        timestep: Seconds per step.

    Raises:
        ValueError: If there is no complete stride.
    """
    walkers = [walker[walker["running"]] for walker in steps.unbind(0)]
    phases = [stride_phases(walker["standing"].numpy()) for walker in walkers]
    whole = [np.isfinite(phase) for phase in phases]
    strides = sum(int((phase == 0).sum()) for phase in phases)
    if not strides:
        raise ValueError(
            "the walk has no complete stride, in which one foot touches down between two touch-downs of the other: "
            "use a policy that can walk"
        )
    kept = TensorDict.cat([walker[torch.from_numpy(inside)] for walker, inside in zip(walkers, whole, strict=True)], 0)
    return Walk(
        phases=np.concatenate([phase[inside] for phase, inside in zip(phases, whole, strict=True)]),
        standing=kept["standing"].numpy(),
        gates=kept["gates"].double().numpy(),
        actions=kept[PRIMITIVES[0]].double().numpy(),
        inputs=kept.select("observation", "goal"),
        strides=strides,
        seconds=len(kept) * timestep / strides,
    )


def specialisation(walk: Walk) -> dict[str, float]:
    """Return measures of the specialisation of a policy's primitives.

    ``phase`` is the share of the variance of all weights that the phase of the stride explains. ``swing`` is the mean
    difference between the greatest and the least weight of a primitive over the cycle. ``left`` and ``right`` are the
    strongest correlations with standing on the left and on the right foot. ``between`` is the share of the variance of
    mean actions that lies between primitives. ``silhouette`` is the mean of
    :func:`~torchrl_mcp.analysis.specialisation.silhouettes`.
    """
    stance = stance_correlation(walk.gates, walk.standing)
    return {
        "phase": explained_by_phase(walk.gates, walk.phases)[1],
        "swing": float(swings(walk).mean()),
        "left": float(stance.max()),
        "right": float(-stance.min()),
        "between": between_primitives(_few(walk.actions)),
        "silhouette": float(silhouettes(_few(walk.actions)).mean()),
    }


def swings(walk: Walk) -> Array:
    """Return the difference between the greatest and the least mean weight over the cycle, ``(K,)``."""
    means = bin_means(walk.gates, walk.phases)
    return np.nanmax(means, 0) - np.nanmin(means, 0)


def primitive_rows(walk: Walk) -> list[dict[str, float]]:
    """Return a row of measures for every primitive, counted from 1."""
    columns = {
        "weight": walk.gates.mean(0),
        "swing": swings(walk),
        "explained_by_phase": explained_by_phase(walk.gates, walk.phases)[0],
        "circular_r2": circular_correlation(walk.gates, walk.phases),
        "stance_correlation": stance_correlation(walk.gates, walk.standing),
        "silhouette": silhouettes(_few(walk.actions)),
    }
    return [
        {"primitive": number, **dict(zip(columns, map(float, row), strict=True))}
        for number, row in enumerate(zip(*columns.values(), strict=True), start=1)
    ]


def cycle_rows(walk: Walk) -> list[dict[str, float]]:
    """Return a row for every bin of the cycle and every primitive.

    A row contains the phase, the mean weight of the primitive, the bounds ``low`` and ``high`` of nine tenths of the
    samples, and the shares of time for which each foot stands.
    """
    bins = (walk.phases * PHASE_BINS).astype(int)
    feet = bin_means(walk.standing.astype(float), walk.phases)
    rows = []
    for index in np.unique(bins):
        gates = walk.gates[bins == index]
        right, left = feet[index]
        spread = zip(gates.mean(0), *np.quantile(gates, [0.05, 0.95], axis=0), strict=True)
        rows += [
            {
                "primitive": number,
                "phase": (index + 0.5) / PHASE_BINS,
                "mean": float(mean),
                "low": float(low),
                "high": float(high),
                "right_foot": float(right),
                "left_foot": float(left),
            }
            for number, (mean, low, high) in enumerate(spread, start=1)
        ]
    return rows


def action_rows(walk: Walk) -> list[dict[str, float]]:
    """Return the mean actions of all primitives in the same states, as principal components."""
    scores, _ = plane(walk)
    return [
        {"state": state, "primitive": number, "component_1": float(one), "component_2": float(two)}
        for state, points in enumerate(scores, start=1)
        for number, (one, two) in enumerate(points, start=1)
    ]


def plane(walk: Walk) -> tuple[Array, Array]:
    """Return the first two principal components of mean actions, and their shares of the variance.

    Returns:
        Components, ``(STATES, K, 2)``, and shares of the variance of the mean actions of all primitives, ``(2,)``.
    """
    actions = _few(walk.actions)
    scores, shares = principal_components(actions.reshape(-1, actions.shape[-1]))
    return scores.reshape(*actions.shape[:2], 2), shares


def _few(samples: Array) -> Array:
    """Return at most :data:`STATES` of the samples, spread evenly."""
    return samples[np.linspace(0, len(samples) - 1, min(STATES, len(samples))).round().astype(int)]
