"""PPO's update: gradient steps of actor and critic in several passes over a batch."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from torch.optim import Optimizer
from torchrl.objectives import KLAdaptiveLR

from torchrl_mcp.evaluation.diagnostics import DeadUnits
from torchrl_mcp.methods.actor import Actor
from torchrl_mcp.objectives.ppo import require_reports
from torchrl_mcp.training.threads import side_by_side
from torchrl_mcp.training.transfer import FrozenParts
from torchrl_mcp.values import Count, Positive, Whole


@dataclass(frozen=True)
class PPOSettings:
    """Numbers of steps, batches and passes of a training.

    Args:
        num_envs: Number of environments, ``N``.
        total_frames: Environment steps of the run.
        frames_per_batch: Environment steps per iteration, ``N * T``.
        minibatch_size: Samples per gradient step.
        num_epochs: Passes over each batch.
        warmup_batches: Number of first batches that train only normalisers and critic, so that the actor's first step
            has inputs of unit variance and meaningful advantages.
        max_grad_norm: Largest norm of the actor's gradient and of the critic's gradient; None disables clipping.
        checkpoint_interval: Iterations between checkpoints.
        autocast: Whether to compute all networks in bfloat16, in collection and in the losses.

    Raises:
        ValueError: If ``frames_per_batch`` is not a multiple of ``num_envs`` and of ``minibatch_size``.
    """

    num_envs: Count
    total_frames: Count
    frames_per_batch: Count
    minibatch_size: Count
    num_epochs: Count
    warmup_batches: Whole
    max_grad_norm: Positive | None
    checkpoint_interval: Count
    autocast: bool

    def __post_init__(self) -> None:
        """Check that batches divide evenly."""
        if self.frames_per_batch % self.num_envs or self.frames_per_batch % self.minibatch_size:
            raise ValueError(
                f"frames_per_batch={self.frames_per_batch} must be a multiple of num_envs={self.num_envs} and of "
                f"minibatch_size={self.minibatch_size}"
            )


@dataclass(frozen=True)
class Agent:
    """A method's networks for the sizes of an environment.

    Attributes:
        parts: All parts by name, as in checkpoints.
        actor: The actor over the parts.
        critic: The value function over the parts.
        frozen: The parts that must not change.
    """

    parts: nn.ModuleDict
    actor: Actor
    critic: TensorDictModuleBase
    frozen: FrozenParts

    @property
    def device(self) -> torch.device:
        """Device of the networks."""
        return next(self.parts.parameters()).device

    @property
    def spare_parts(self) -> set[str]:
        """Names of the parts that the policy does not need: the critic, unless its values choose the option."""
        acting = {id(parameter) for parameter in self.actor.policy.parameters()}
        return {"critic"} if acting.isdisjoint(map(id, self.parts["critic"].parameters())) else set()


class Estimator(Protocol):
    """The interface of advantage estimators: from trajectories to samples for the losses."""

    out_keys: Sequence[NestedKey]

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Return the samples to learn from, with ``out_keys``, for trajectories ``(N, T)``."""
        ...


@dataclass(frozen=True)
class Objective:
    """Advantages, losses and optimisers of actor and critic.

    Args:
        advantages: From trajectories ``(N, T)`` to samples of any batch shape, with the keys ``advantages.out_keys``
            that the losses read in addition to the policy's stored keys.
        losses: Losses by the names of ``optimizers``. Each optimiser minimises the sum of the outputs whose names begin
            with ``loss_``. The actor's loss reports the same outputs as
            :class:`~torchrl_mcp.objectives.ActorLoss`.
        optimizers: Optimisers of the ``critic`` and, unless the actor is frozen, of the ``actor``.
        schedule: Adapts the actor's step size to the KL divergence of each update; None keeps the step size.

    Raises:
        ValueError: If the actor's loss does not declare the outputs that it must report.
    """

    advantages: Estimator
    losses: Mapping[str, nn.Module]
    optimizers: Mapping[str, Optimizer]
    schedule: KLAdaptiveLR | None

    def __post_init__(self) -> None:
        """Check the actor's loss."""
        if "actor" in self.optimizers:
            require_reports(self.losses["actor"])


class Update:
    """Gradient steps of an agent in several passes over the samples of a batch.

    Args:
        agent: The networks.
        objective: Advantages, losses and optimisers.
        settings: Numbers of steps, batches and passes.
    """

    def __init__(self, agent: Agent, objective: Objective, settings: PPOSettings) -> None:
        self.agent = agent
        self.objective = objective
        self.settings = settings
        self.dead_units = DeadUnits(agent.parts)

    def precision(self) -> torch.autocast:
        """Return a context in which networks compute in the precision of the settings."""
        # Every use needs a new context: within one context, autocast reuses outdated copies of the weights.
        return torch.autocast(self.agent.device.type, torch.bfloat16, enabled=self.settings.autocast)

    def __call__(self, batch: TensorDictBase, *, warming_up: bool) -> dict[str, float]:
        """Learn from trajectories ``(N, T)``, and return the means of the losses' outputs and of exploration.

        While ``warming_up``, the actor does not learn and only reports its loss.

        Raises:
            FloatingPointError: If an output of a loss is not finite.
        """
        with self.precision():
            samples = self.objective.advantages(batch)
        return self.learn(samples, warming_up=warming_up)

    def learn(self, samples: TensorDictBase, *, warming_up: bool) -> dict[str, float]:
        """Learn from samples of any batch shape that already have advantages; else as ``__call__``."""
        actor = self.agent.actor
        keys = ["observation", "goal", actor.sampled, actor.log_prob, *actor.stored]
        samples = samples.select(*keys, *self.objective.advantages.out_keys).flatten()
        orders = [torch.randperm(samples.shape[0], device=samples.device) for _ in range(self.settings.num_epochs)]
        minibatches = [index for order in orders for index in order.split(self.settings.minibatch_size)]
        learning = {name: partial(self._learn, name, samples, minibatches) for name in self.objective.optimizers}
        if warming_up and "actor" in learning:
            learning["actor"] = partial(self._report_without_learning, samples[minibatches[0]])
        reports = self._run(learning)
        metrics = {f"loss/{key}": value for report in reports.values() for key, value in _mean(report).items()}
        if "actor" in reports:
            per_epoch = len(minibatches) // self.settings.num_epochs
            metrics["loss/kl"] = _divergence(reports["actor"][-per_epoch:])
        _require_finite(metrics)
        if self.objective.schedule and not warming_up:
            self.objective.schedule.step(metrics["loss/kl"])
        if "actor" in self.objective.optimizers:
            metrics["loss/actor_step_size"] = self.objective.optimizers["actor"].param_groups[0]["lr"]
        return metrics | self._network_metrics(samples)

    def _run(self, tasks: Mapping[str, Callable[[], list[TensorDictBase]]]) -> dict[str, list[TensorDictBase]]:
        """Return the reports of actor and critic, which learn in parallel on a CPU: they share only the samples."""
        if self.agent.device.type == "cpu":
            return side_by_side(tasks)
        return {name: task() for name, task in tasks.items()}

    def _learn(self, name: str, samples: TensorDictBase, minibatches: Sequence[Tensor]) -> list[TensorDictBase]:
        """Take a gradient step of the named optimiser on every minibatch; return the outputs of its loss."""
        reports: list[TensorDictBase] = []
        for index in minibatches:
            with self.precision():
                report = self.objective.losses[name](samples[index])
            sum(value for key, value in report.items() if key.startswith("loss_")).backward()
            norm = self._step(self.objective.optimizers[name])
            reports.append(report.detach().set(f"{name}_grad_norm", norm))
        return reports

    @torch.no_grad()
    def _report_without_learning(self, samples: TensorDictBase) -> list[TensorDictBase]:
        """Return the outputs of the actor's loss, with log-probabilities under the current normalisers."""
        actor = self.agent.actor
        with self.precision():
            distribution = actor.trained.get_dist(samples)
            samples[actor.log_prob] = distribution.log_prob(samples[actor.sampled])
            report = self.objective.losses["actor"](samples)
        return [report.set("actor_grad_norm", torch.zeros((), device=self.agent.device))]

    def _step(self, optimizer: Optimizer) -> Tensor:
        """Clip the gradient, take a step, and return the norm before clipping."""
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        limit = self.settings.max_grad_norm
        norm = nn.utils.clip_grad_norm_(parameters, torch.inf if limit is None else limit)
        optimizer.step()
        optimizer.zero_grad()
        return norm

    def _network_metrics(self, samples: TensorDictBase) -> dict[str, float]:
        """Return metrics of exploration and of dead units, from samples ``(B,)``."""
        metrics: dict[str, float] = {}

        def evaluate() -> None:
            metrics.update(_spread(self.agent.actor.trained.get_dist(samples)))
            self.agent.critic(samples.select("observation", "goal"))

        with self.precision():
            return self.dead_units(evaluate) | metrics


def _divergence(reports: list[TensorDictBase]) -> float:
    r"""Return the KL divergence of an update, by the low-variance estimate :math:`E[(r - 1) - \log r]`.

    Reference:
        Schulman, *Approximating KL Divergence*, 2020. http://joschu.net/blog/kl-approx.html
    """
    mean = _mean(reports)
    return mean["mean_ratio"] - 1 + mean["kl_approx"]


def _spread(distribution: Distribution) -> dict[str, float]:
    """Return the mean entropy of a choice among options, or the mean standard deviation of the sampled variable.

    The sampled variable is the action, the logits of the gate or the latent variable.
    """
    if isinstance(distribution, Categorical):
        return {"policy/entropy": distribution.entropy().mean().item()}
    return {"policy/std": distribution.stddev.mean().item()}


def _mean(reports: list[TensorDictBase]) -> dict[str, float]:
    """Average scalars over reports with the same keys, with one transfer from the device."""
    keys = list(reports[0].keys())
    means = torch.stack([torch.stack([report[key] for report in reports]).mean() for key in keys])
    return dict(zip(keys, means.tolist(), strict=True))


def _require_finite(metrics: Mapping[str, float]) -> None:
    for key, value in metrics.items():
        if not math.isfinite(value):
            raise FloatingPointError(f"{key} became {value}")
