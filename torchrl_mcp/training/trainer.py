"""The training loop, which is the same for every method: collect, learn, record."""

import math
import time
from pathlib import Path
from typing import Any, cast

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torchrl.checkpoint import Checkpoint

from torchrl_mcp.evaluation.diagnostics import diagnostics
from torchrl_mcp.modules import RunningNormaliser
from torchrl_mcp.training.checkpoint import RunRandomness, load, rotation, run_checkpoint, save
from torchrl_mcp.training.collectors import Batches, TrajectorySource
from torchrl_mcp.training.metrics import EpisodeStatistics, MetricsWriter
from torchrl_mcp.training.progress import Progress, Stopwatch, TrainingBar
from torchrl_mcp.training.run_folder import NORMALISED_RETURN, frames
from torchrl_mcp.training.update import Agent, Objective, PPOSettings, Update


class RunFolder:
    """Receives the output of a training: metrics, and checkpoints with the configuration.

    Args:
        path: The run folder.
        config: The run's configuration, JSON-compatible, which every checkpoint stores.
        keep_checkpoints: Number of the newest checkpoints to keep.
    """

    def __init__(self, path: Path, config: dict[str, Any], *, keep_checkpoints: int) -> None:
        self.config = config
        self.metrics = MetricsWriter(path)
        self.checkpoints = rotation(path, keep_checkpoints)


class Trainer:
    """Optimises the policy of an agent.

    Args:
        source: Collects trajectories of ``N`` environments.
        agent: The networks.
        objective: Advantages, losses and optimisers.
        settings: Numbers of steps, batches and passes.
        folder: Receives metrics and checkpoints.
        progress_bar: Whether to show the progress on standard error.
    """

    def __init__(
        self,
        source: TrajectorySource,
        agent: Agent,
        objective: Objective,
        settings: PPOSettings,
        folder: RunFolder,
        *,
        progress_bar: bool = True,
    ) -> None:
        self.source = source
        self.agent = agent
        self.settings = settings
        self.folder = folder
        self.progress_bar = progress_bar
        self.update = Update(agent, objective, settings)
        self.progress = Progress()
        self.episodes = EpisodeStatistics(source.num_envs)
        self.stopwatch = Stopwatch()
        self.checkpoint: Checkpoint = run_checkpoint(
            agent.parts,
            **{f"{name}_optimizer": optimizer for name, optimizer in objective.optimizers.items()},
            environment=source,
            episodes=self.episodes,
            frozen=agent.frozen,
            progress=self.progress,
            random=RunRandomness(agent.device),
        )

    def run(self) -> None:
        """Train until ``total_frames``, and save checkpoints."""
        settings = self.settings
        batches = Batches(settings.frames_per_batch, self.agent.device, settings.autocast, self.stopwatch)
        self.source.start(self._behaviour(), batches)
        try:
            with TrainingBar(settings.total_frames, self.progress.frames, shown=self.progress_bar) as bar:
                while self.progress.frames < settings.total_frames:
                    metrics = self.iterate()
                    mean = metrics[NORMALISED_RETURN]
                    bar.advance(settings.frames_per_batch, f"return {mean:.3f}" if math.isfinite(mean) else "")
        finally:
            self.source.stop()

    def iterate(self) -> dict[str, float]:
        """Collect a batch, learn from it, and write and return the metrics.

        Raises:
            FloatingPointError: If the task or the update gives a number that is not finite.
        """
        start = time.perf_counter()
        self.stopwatch.seconds.clear()
        batch = self.source.collect()
        self._require_finite_task(batch)
        metrics = self._episode_metrics(batch) | diagnostics(self.agent.actor, batch)
        with self.stopwatch("update"):
            metrics |= self._learn(batch)
        self.agent.frozen.verify()
        self._advance(metrics, time.perf_counter() - start)
        return metrics

    def restore(self, path: Path) -> None:
        """Continue from the checkpoint file ``path``, bit for bit if the trajectory source resumes its episodes.

        In the checkpoint of a run that has not taken a step, the environments have no state yet. They begin anew, with
        the seed of the run.

        Raises:
            ValueError: If the file is damaged or belongs to another configuration, or if ``metrics.csv`` ends before
                the checkpoint. Nothing is written in these cases.
        """
        components = set(self.checkpoint.components)
        load(self.checkpoint, path, components if frames(path) else components - {"environment"})
        if not self.source.resumes_episodes:
            self.episodes.load_state_dict(EpisodeStatistics(self.source.num_envs).state_dict())
        self.folder.metrics.rewind(self.progress.iteration)

    def save(self) -> None:
        """Write a checkpoint."""
        self.folder.metrics.flush()  # resuming from a checkpoint needs all rows before it
        save(self.checkpoint, self.folder.checkpoints, step=self.progress.frames, config=self.folder.config)

    def _behaviour(self) -> TensorDictModuleBase:
        """Return the policy for collection, which writes only the keys that the losses and the diagnostics read."""
        actor = self.agent.actor
        needed = {"action", actor.log_prob, *actor.stored}
        keys = [key for key in dict.fromkeys(actor.policy.out_keys) if key in needed]
        return TensorDictSequential(actor.policy, selected_out_keys=keys)

    def _learn(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a batch, and update the normalisers last, so that source and losses use the same statistics.

        Raises:
            FloatingPointError: If a number of the update is not finite.
        """
        warming_up = self.progress.iteration < self.settings.warmup_batches
        if warming_up:
            self._update_normalisers(batch)
        try:
            metrics = self.update(batch, warming_up=warming_up)
        except FloatingPointError as error:
            raise FloatingPointError(
                f"{error} in iteration {self.progress.iteration + 1}; another run with a smaller step size or "
                "max_grad_norm may avoid this"
            ) from error
        if not warming_up:
            self._update_normalisers(batch)
        return metrics

    def _update_normalisers(self, batch: TensorDictBase) -> None:
        """Merge the batch into the statistics of the normalisers that are not frozen."""
        for key in ("observation", "goal"):
            if (name := f"{key}_normaliser") not in self.agent.frozen:
                cast("RunningNormaliser", self.agent.parts[name]).update(batch[key])

    def _require_finite_task(self, batch: TensorDictBase) -> None:
        """Check the outputs of the task, so that an error of the task does not look like an error of learning."""
        outputs = {key: batch[key] for key in ("observation", "goal")} | {"reward": batch["next", "reward"]}
        if wrong := [name for name, value in outputs.items() if not value.isfinite().all()]:
            raise FloatingPointError(
                f"{' and '.join(wrong)} of {type(self.source.env).__name__} became nan or infinite in iteration "
                f"{self.progress.iteration + 1}: correct the task"
            )

    def _episode_metrics(self, batch: TensorDictBase) -> dict[str, float]:
        returns, lengths = self.episodes.update(batch)
        if self.episodes.steps < self.source.env.max_episode_steps:  # so far, only shorter episodes have ended
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
        """Count the iteration, write its metrics, and save a checkpoint if one is due."""
        progress = self.progress
        progress.iteration += 1
        progress.frames += self.settings.frames_per_batch
        progress.seconds += seconds
        shares = {section: spent / seconds for section, spent in self.stopwatch.seconds.items()}
        shares["other"] = 1 - sum(shares.values())
        metrics |= {f"time/{section}": share for section, share in shares.items()}
        metrics["time/steps_per_second"] = self.settings.frames_per_batch / seconds
        self.folder.metrics.write(vars(progress) | metrics, step=progress.frames)
        if progress.iteration % self.settings.checkpoint_interval == 0 or progress.frames >= self.settings.total_frames:
            self.save()
