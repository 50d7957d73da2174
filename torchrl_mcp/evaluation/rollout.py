"""Evaluates a policy by one episode in each of many environments."""

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_mcp.adapters.contract import Reach, task_reward
from torchrl_mcp.evaluation.bars import bar
from torchrl_mcp.evaluation.statistics import mean

SUCCESS = "success"
"""Name of the metric for a step in which the task is solved."""


@dataclass(frozen=True)
class Evaluation:
    """The outcome of one episode per environment.

    Attributes:
        returns: Undiscounted sum of the task's rewards in each episode, without shaping, ``(N,)``.
        lengths: Control steps of each episode, ``(N,)``.
        terminated: Whether the episode ended by a failure or by a success, and not by truncation, ``(N,)``.
        metrics: Other measurements of the task by name, ``(N,)``. For a flag such as ``success``, the value is whether
            the flag was ever raised in the episode; for a number such as ``tracking_error``, the mean over the steps.
        durations: Number of control steps of each episode in which a flag among the metrics was raised, ``(N,)``.
        success_returns: Returns with the reward 1 in every step with a success, except in a step that terminates the
            episode, ``(N,)``; None if the task has no metric ``success``. In carry and dribble, these are the returns
            that the same episodes have with ``success_reward``.
        decisions: Recorded outputs of the policy for all steps of all episodes, batch size ``(M,)``.
        reach: Returns of standing still and of an ideal player in the same episodes, or None if the task does not
            compute them.
        positions: Positions after every step, ``(T, N, D)``, NaN from the last step of an episode on; None if positions
            were not recorded.
    """

    returns: Tensor
    lengths: Tensor
    terminated: Tensor
    metrics: dict[str, Tensor] = field(default_factory=dict)
    durations: dict[str, Tensor] = field(default_factory=dict)
    success_returns: Tensor | None = None
    decisions: TensorDictBase = field(default_factory=TensorDict)
    reach: Reach | None = None
    positions: Tensor | None = None


@torch.no_grad()
def evaluate(
    policy: TensorDictModuleBase,
    env: EnvBase,
    *,
    deterministic: bool = True,
    start: TensorDictBase | None = None,
    record: Collection[NestedKey] = (),
    positions: Callable[[], Tensor] | None = None,
    max_steps: float = math.inf,
    device: torch.device | str = "cpu",
) -> Evaluation:
    """Play one episode in each environment of a batch, to its end.

    A number of episodes in the order of their ends would contain too many short episodes.

    Args:
        policy: From keys of the environments, such as ``observation`` and ``goal``, to ``action``.
        env: Environments with batch size ``[N]`` whose episodes all end; ``env.metric_names`` lists the ``metrics``.
        deterministic: Play the deterministic action instead of a sample.
        start: Initial state, as returned by ``env.get_state()``, or None for a random initial state.
        record: Keys of the policy's output that are recorded as ``decisions``.
        positions: Function that returns the positions of the environments, ``(N, D)``, which are then recorded.
        max_steps: Number of steps after which unfinished episodes are stopped.
        device: Device of the policy.
    """
    exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    state = env.reset() if start is None else env.reset(start, set_state=True)
    reach = env.reach() if hasattr(env, "reach") else None
    running = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    returns = torch.zeros(env.batch_size, device=env.device)
    lengths = torch.zeros(env.batch_size, dtype=torch.int64, device=env.device)
    terminated = torch.zeros_like(running)
    path: list[Tensor] = []
    decisions: list[TensorDictBase] = []
    names = getattr(env, "metric_names", {})
    zeros = {name: torch.zeros_like(value) for name, value in _by_name(state, names).items()}
    flags = {name: zero for name, zero in zeros.items() if zero.dtype is torch.bool}
    sums = {name: zero for name, zero in zeros.items() if zero.dtype is not torch.bool}
    durations = {name: torch.zeros_like(lengths) for name in flags}
    shortfall = torch.zeros_like(returns)
    steps = getattr(env, "max_episode_steps", None)
    with set_exploration_type(exploration), bar(steps, f"{len(running)} episodes") as shown:
        while running.any() and lengths.max() < max_steps:
            shown.update()
            decision = policy(state.select(*policy.in_keys).to(device))
            decisions.append(decision.select(*record)[running.to(device)])
            step, state = env.step_and_maybe_reset(state.update(decision.to(env.device)))
            outcome = step["next"]
            reward = task_reward(outcome).squeeze(-1)
            returns += reward * running
            lengths += running
            terminated |= running & outcome["terminated"].squeeze(-1)
            metrics_of_step = _by_name(outcome, names)
            for name, flag in flags.items():
                is_raised = running & metrics_of_step[name]
                flag |= is_raised
                durations[name] += is_raised
            for name, total in sums.items():
                total += metrics_of_step[name] * running
            if SUCCESS in flags:  # a fall earns nothing
                shortfall += (1 - reward) * (running & metrics_of_step[SUCCESS] & ~terminated)
            running &= ~outcome["done"].squeeze(-1)
            if positions is not None:
                path.append(torch.where(running.unsqueeze(-1), positions(), torch.nan))
    return Evaluation(
        returns=returns,
        lengths=lengths,
        terminated=terminated,
        metrics=flags | {name: total / lengths for name, total in sums.items()},
        durations=durations,
        success_returns=returns + shortfall if SUCCESS in flags else None,
        decisions=torch.cat(decisions),
        reach=reach,
        positions=torch.stack(path) if path else None,
    )


def _by_name(values: TensorDictBase, names: Mapping[str, Sequence[str]]) -> dict[str, Tensor]:
    """Return the columns of the metrics ``(N, E)`` among values by the names of their entries, ``(N,)`` each."""
    return {
        name: column
        for key, entries in names.items()
        for name, column in zip(entries, values[key].unbind(-1), strict=True)
    }


def episode_statistics(outcome: Evaluation, normalised_return: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Return means over episodes, and the uncertainty of the normalised return.

    Args:
        outcome: The episodes.
        normalised_return: The task's normalisation of returns.

    Returns:
        Means over episodes of ``normalised_return``, ``return``, ``length`` in control steps, ``terminated`` as a
        fraction, ``metrics``, and ``durations`` of flags in control steps. ``normalised_return_std`` is the standard
        deviation over episodes, and ``interval`` the 95 % percentile bootstrap interval of the mean of the normalised
        return; both are 0 wide for a single episode. ``reach``, which some tasks have, contains the returns of
        ``standing`` and of an ``ideal`` player, and ``skill``, which is 0 at the former and 1 at the latter.
        ``success_return``, which tasks with a metric ``success`` have, is the normalised return with the reward 1 in
        every step with a success.
        ``episodes`` is the number of episodes.
    """
    normalised = normalised_return(outcome.returns)
    estimate = mean(normalised.tolist())
    single = len(normalised) == 1
    reach = {}
    if outcome.reach is not None:
        ends = {name: normalised_return(returns).mean().item() for name, returns in outcome.reach._asdict().items()}
        reach = {"reach": {"skill": outcome.reach.skill(outcome.returns).item(), **ends}}
    success_return = {}
    if outcome.success_returns is not None:
        success_return = {"success_return": normalised_return(outcome.success_returns).mean().item()}
    return {
        "normalised_return": normalised.mean().item(),
        "normalised_return_std": 0.0 if single else normalised.std().item(),
        "interval": [estimate.value] * 2 if single else [estimate.low, estimate.high],
        **reach,
        **success_return,
        "return": outcome.returns.mean().item(),
        "length": outcome.lengths.float().mean().item(),
        "terminated": outcome.terminated.float().mean().item(),
        "episodes": len(normalised),
        "metrics": {key: value.float().mean().item() for key, value in outcome.metrics.items()},
        "durations": {key: value.float().mean().item() for key, value in outcome.durations.items()},
    }
