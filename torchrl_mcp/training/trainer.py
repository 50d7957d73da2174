"""The training loop: collect, estimate advantages, update, record. One loop for every method."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torch.distributions import Categorical, Distribution
from torch.optim import Optimizer
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.objectives import KLAdaptiveLR

from torchrl_mcp.evaluation.diagnostics import diagnostics
from torchrl_mcp.methods.actor import Actor
from torchrl_mcp.modules import RunningNormaliser
from torchrl_mcp.training.bar import TrainingBar
from torchrl_mcp.training.checkpoint import RunRandomness, load, run_checkpoint, save
from torchrl_mcp.training.collectors import Batches, TrajectorySource
from torchrl_mcp.training.dead_units import DeadUnits
from torchrl_mcp.training.episodes import EpisodeStatistics
from torchrl_mcp.training.metrics import MetricsWriter
from torchrl_mcp.training.progress import Progress, Stopwatch
from torchrl_mcp.training.run_folder import NORMALISED_RETURN
from torchrl_mcp.training.threads import side_by_side
from torchrl_mcp.training.transfer import FrozenParts


class Estimator(Protocol):
    """The interface of advantage estimators: from trajectories to samples for the loss."""

    out_keys: Sequence[NestedKey]

    def __call__(self, batch: TensorDictBase) -> TensorDictBase:
        """Return the samples to learn from, with ``out_keys``, for trajectories ``(N, T)``."""
        ...


class Trainer:
    """Policy optimisation of an actor and a critic.

    Args:
        source: Source of trajectories of ``N`` environments.
        parts: All parts of the agent by name.
        actor: The actor over those parts.
        critic: The value function over those parts.
        losses: Losses by the names of ``optimizers``: each minimises the sum of the outputs that begin with ``loss_``.
        advantages: From trajectories ``(N, T)`` to samples of any batch shape, with the keys ``advantages.out_keys``
            that the losses read in addition to the policy's stored keys.
        optimizers: Optimisers of the ``critic`` and, unless it is frozen, the ``actor``.
        frozen: Parts that must not change, checked in every iteration.
        metrics_writer: Writer of metrics.
        checkpoints: Rotation of checkpoints.
        config: The run's configuration, JSON-compatible, kept in every checkpoint.
        total_frames: Environment steps of the run.
        frames_per_batch: Environment steps per iteration, ``N * T``.
        minibatch_size: Samples per gradient step.
        num_epochs: Passes over each batch.
        warmup_batches: First batches, which train only normalisers and critic, so that the actor's first step has
            inputs of unit variance and meaningful advantages.
        max_grad_norm: Largest gradient norm, of actor and critic each, or None to leave gradients as they are.
        step_size_schedule: Adapts the actor's step size to the KL divergence of each update, or None.
        autocast: Run all networks in bfloat16 autocast, both in the source and in the losses.
        device: Device of the networks.
        checkpoint_interval: Iterations between checkpoints.
        progress_bar: Show the progress on standard error.

    Raises:
        ValueError: If the batch does not divide evenly.
    """

    def __init__(
        self,
        *,
        source: TrajectorySource,
        parts: nn.ModuleDict,
        actor: Actor,
        critic: TensorDictModuleBase,
        losses: Mapping[str, nn.Module],
        advantages: Estimator,
        optimizers: Mapping[str, Optimizer],
        frozen: FrozenParts,
        metrics_writer: MetricsWriter,
        checkpoints: CheckpointRotation,
        config: dict[str, Any],
        total_frames: int,
        frames_per_batch: int,
        minibatch_size: int,
        num_epochs: int,
        warmup_batches: int,
        max_grad_norm: float | None,
        step_size_schedule: Callable[[Optimizer], KLAdaptiveLR] | None,
        autocast: bool,
        device: torch.device | str,
        checkpoint_interval: int,
        progress_bar: bool = True,
    ) -> None:
        num_envs = source.num_envs
        if frames_per_batch % num_envs or frames_per_batch % minibatch_size:
            raise ValueError(
                f"frames_per_batch={frames_per_batch} must be a multiple of num_envs={num_envs} and of "
                f"minibatch_size={minibatch_size}"
            )
        self.source, self.parts, self.actor, self.critic = source, parts, actor, critic
        self.losses, self.advantages = losses, advantages
        self.optimizers = dict(optimizers)
        self.schedule = (
            step_size_schedule(optimizers["actor"]) if step_size_schedule and "actor" in optimizers else None
        )
        self.frozen, self.metrics_writer, self.checkpoints, self.config = frozen, metrics_writer, checkpoints, config
        self.total_frames, self.frames_per_batch = total_frames, frames_per_batch
        self.minibatch_size, self.num_epochs = minibatch_size, num_epochs
        self.warmup_batches = warmup_batches
        self.max_grad_norm = math.inf if max_grad_norm is None else max_grad_norm
        self.device, self.autocast = torch.device(device), autocast
        self.checkpoint_interval, self.progress_bar = checkpoint_interval, progress_bar
        self.progress, self.episodes, self.stopwatch = Progress(), EpisodeStatistics(num_envs), Stopwatch()
        self.dead_units = DeadUnits(parts)
        self.checkpoint: Checkpoint = run_checkpoint(
            parts,
            **{f"{name}_optimizer": optimizer for name, optimizer in optimizers.items()},
            environment=source,
            episodes=self.episodes,
            frozen=frozen,
            progress=self.progress,
            random=RunRandomness(self.device),
        )

    def run(self) -> None:
        """Train until ``total_frames``, with checkpoints."""
        batches = Batches(self.frames_per_batch, self.device, self.autocast, self.stopwatch)
        self.source.start(self._behaviour(), batches)
        try:
            self._loop()
        finally:
            self.source.stop()

    def restore(self, path: Path) -> None:
        """Continue from the checkpoint file ``path``, bit for bit if it holds the whole state of the trajectory source.

        Raises:
            ValueError: If the file is damaged or belongs to another configuration, or ``metrics.csv`` ends before it;
                nothing is written then.
        """
        load(self.checkpoint, path)
        if not self.source.resumes_episodes:
            self.episodes.load_state_dict(EpisodeStatistics(self.source.num_envs).state_dict())
        self.metrics_writer.rewind(self.progress.iteration)

    def save(self) -> None:
        """Write a checkpoint."""
        self.metrics_writer.flush()  # a run cannot resume from a checkpoint without the rows before it
        save(self.checkpoint, self.checkpoints, step=self.progress.frames, config=self.config)

    def _loop(self) -> None:
        with TrainingBar(self.total_frames, self.progress.frames, shown=self.progress_bar) as bar:
            while self.progress.frames < self.total_frames:
                start = time.perf_counter()
                self.stopwatch.seconds.clear()
                batch = self.source.collect()
                self._require_finite_task(batch)
                metrics = self._episode_metrics(batch) | diagnostics(self.actor, batch)
                with self.stopwatch("update"):
                    warming_up = self.progress.iteration < self.warmup_batches
                    if warming_up:
                        self._update_normalisers(batch)
                    with self._precision():
                        samples = self.advantages(batch)
                    metrics |= self._update(samples, warming_up)
                if not warming_up:
                    self._update_normalisers(batch)
                self.frozen.verify()
                self._advance(metrics, time.perf_counter() - start)
                ended = metrics["episode/count"] > 0
                bar.advance(batch.numel(), f"return {metrics[NORMALISED_RETURN]:.3f}" if ended else "")

    def _behaviour(self) -> TensorDictModuleBase:
        """Return the policy for collection, which writes only the keys that the loss reads."""
        kept = {"action", self.actor.log_prob, *self.actor.stored}
        keys = [key for key in dict.fromkeys(self.actor.policy.out_keys) if key in kept]
        return TensorDictSequential(self.actor.policy, selected_out_keys=keys)

    def _update(self, samples: TensorDictBase, warming_up: bool) -> dict[str, float]:
        """Take gradient steps in ``num_epochs`` passes over samples; return the means of the losses' outputs.

        While ``warming_up``, the actor does not learn and only reports its loss.
        """
        keys = ["observation", "goal", self.actor.sampled, self.actor.log_prob, *self.actor.stored]
        samples = samples.select(*keys, *self.advantages.out_keys).flatten()
        orders = [torch.randperm(samples.shape[0], device=samples.device) for _ in range(self.num_epochs)]
        minibatches = [index for order in orders for index in order.split(self.minibatch_size)]
        learning = {name: partial(self._learn, name, samples, minibatches) for name in self.optimizers}
        if warming_up and "actor" in learning:
            learning["actor"] = partial(self._report_without_learning, samples[minibatches[0]])
        # Actor and critic share only the samples: on a CPU they learn in parallel.
        reports = side_by_side(learning) if self.device.type == "cpu" else {name: f() for name, f in learning.items()}
        metrics = {f"loss/{key}": value for report in reports.values() for key, value in _mean(report).items()}
        if "actor" in reports:
            last = _mean(reports["actor"][-len(minibatches) // self.num_epochs :])
            # The low-variance estimate of Schulman, "Approximating KL divergence", 2020: E[(r - 1) - log r].
            metrics["loss/kl"] = last["mean_ratio"] - 1 + last["kl_approx"]
        self._require_finite(metrics)
        if self.schedule and not warming_up:
            self.schedule.step(metrics["loss/kl"])
        if "actor" in self.optimizers:
            metrics["loss/actor_step_size"] = self.optimizers["actor"].param_groups[0]["lr"]
        return metrics | self._network_metrics(samples)

    def _network_metrics(self, samples: TensorDictBase) -> dict[str, float]:
        """Return metrics of exploration and of dead units, from samples ``(B,)``."""
        metrics: dict[str, float] = {}

        def evaluate() -> None:
            metrics.update(_spread(self.actor.trained.get_dist(samples)))
            self.critic(samples.select("observation", "goal"))

        with self._precision():
            return self.dead_units(evaluate) | metrics

    def _learn(self, name: str, samples: TensorDictBase, minibatches: Sequence[Tensor]) -> list[TensorDictBase]:
        """Take a gradient step of the named optimiser on every minibatch; return the outputs of its loss."""
        reports: list[TensorDictBase] = []
        for index in minibatches:
            with self._precision():
                report = self.losses[name](samples[index])
            sum(value for key, value in report.items() if key.startswith("loss_")).backward()
            reports.append(report.detach().set(f"{name}_grad_norm", self._step(self.optimizers[name])))
        return reports

    @torch.no_grad()
    def _report_without_learning(self, samples: TensorDictBase) -> list[TensorDictBase]:
        """Return the outputs of the actor's loss with log-probabilities under the current normalisers."""
        with self._precision():
            distribution = self.actor.trained.get_dist(samples)
            samples[self.actor.log_prob] = distribution.log_prob(samples[self.actor.sampled])
            report = self.losses["actor"](samples)
        return [report.set("actor_grad_norm", torch.zeros((), device=self.device))]

    def _step(self, optimizer: Optimizer) -> Tensor:
        """Clip the gradient, take a step, and return the norm before clipping."""
        parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
        norm = nn.utils.clip_grad_norm_(parameters, self.max_grad_norm)
        optimizer.step()
        optimizer.zero_grad()
        return norm

    def _require_finite_task(self, batch: TensorDictBase) -> None:
        """Check what the task returned, so that its mistakes are not taken for those of learning."""
        returned = {key: batch[key] for key in ("observation", "goal")} | {"reward": batch["next", "reward"]}
        if wrong := [name for name, value in returned.items() if not value.isfinite().all()]:
            raise FloatingPointError(
                f"{' and '.join(wrong)} of {type(self.source.env).__name__} became nan or infinite in iteration "
                f"{self.progress.iteration + 1}: correct the task"
            )

    def _require_finite(self, metrics: dict[str, float]) -> None:
        for key, value in metrics.items():
            if not abs(value) < float("inf"):
                raise FloatingPointError(
                    f"{key} became {value} in iteration {self.progress.iteration + 1}. The last checkpoint, "
                    f"{self.checkpoints.latest()}, is from before; try a smaller step size or max_grad_norm"
                )

    def _update_normalisers(self, batch: TensorDictBase) -> None:
        """Merge the batch into the input statistics: after the update, so that source and loss use the same ones."""
        for key in ("observation", "goal"):
            if (name := f"{key}_normaliser") not in self.frozen:
                cast("RunningNormaliser", self.parts[name]).update(batch[key])

    def _episode_metrics(self, batch: TensorDictBase) -> dict[str, float]:
        returns, lengths = self.episodes.update(batch)
        if self.episodes.steps < self.source.env.max_episode_steps:  # only episodes that fell have ended
            returns = returns.new_empty(0)
        return {
            "episode/count": len(lengths),
            "episode/return": returns.mean().item(),
            NORMALISED_RETURN: self.source.env.normalised_return(returns).mean().item(),
            "episode/length": lengths.mean().item(),
            **self.source.metrics(),
            "reward": batch["next", "reward"].mean().item(),
            **self._task_metrics(batch),
        }

    def _task_metrics(self, batch: TensorDictBase) -> dict[str, float]:
        """Return the means of the task's metrics."""
        metrics: dict[str, float] = {}
        for key, names in self.source.env.metric_names.items():
            means = batch["next", key].float().flatten(0, -2).mean(0)
            metrics |= {f"task/{name}": mean for name, mean in zip(names, means.tolist(), strict=True)}
        return metrics

    def _advance(self, metrics: dict[str, float], seconds: float) -> None:
        """Count the iteration, write its metrics, and save a checkpoint if due."""
        progress = self.progress
        progress.iteration += 1
        progress.frames += self.frames_per_batch
        progress.seconds += seconds
        shares = {section: spent / seconds for section, spent in self.stopwatch.seconds.items()}
        shares["other"] = 1 - sum(shares.values())
        metrics |= {f"time/{section}": share for section, share in shares.items()}
        metrics["time/steps_per_second"] = self.frames_per_batch / seconds
        self.metrics_writer.write(vars(progress) | metrics, step=progress.frames)
        if progress.iteration % self.checkpoint_interval == 0 or progress.frames >= self.total_frames:
            self.save()

    def _precision(self) -> torch.autocast:
        # A new context for every use: within one, autocast reuses its outdated copies of the weights.
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.autocast)


def _spread(distribution: Distribution) -> dict[str, float]:
    """Return a measure of exploration."""
    if isinstance(distribution, Categorical):
        return {"policy/entropy": distribution.entropy().mean().item()}
    return {"policy/std": distribution.stddev.mean().item()}


def _mean(reports: list[TensorDictBase]) -> dict[str, float]:
    """Average scalars over reports with the same keys, with one transfer from the device."""
    keys = list(reports[0].keys())
    means = torch.stack([torch.stack([report[key] for report in reports]).mean() for key in keys])
    return dict(zip(keys, means.tolist(), strict=True))
