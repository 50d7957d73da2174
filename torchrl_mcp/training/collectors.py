"""Trajectory sources: environments in this process, or in workers on one or several machines."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from typing import Any, Protocol

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import GlobalRNGState
from torchrl.collectors import Collector
from torchrl.weight_update import SharedMemWeightSyncScheme

from torchrl_mcp.adapters.contract import Environments
from torchrl_mcp.training import ray_workers
from torchrl_mcp.training.progress import Stopwatch
from torchrl_mcp.training.threads import threads, threads_kept
from torchrl_mcp.training.workers import attend, begun, end, end_with_parent, new_workers
from torchrl_mcp.values import Count, Whole

PATIENCE = 5.0
"""Seconds that workers have to end before they are killed."""


@dataclass(frozen=True)
class Batches:
    """How trajectories are collected.

    Args:
        frames: Environment steps per batch, ``N * T``.
        device: Device of the policy and of the trajectories.
        autocast: Whether the policy computes in bfloat16.
        stopwatch: Receives the time of each section, in seconds.
    """

    frames: int
    device: torch.device
    autocast: bool
    stopwatch: Stopwatch


class TrajectorySource(Protocol):
    """The interface of trajectory sources.

    Attributes:
        env: Environments of the same kind as the environments that collect, in any number.
        num_envs: Number of environments that collect, ``N``.
        resumes_episodes: Whether a resumed run continues its episodes; otherwise it begins new ones.
    """

    env: Environments
    num_envs: Count
    resumes_episodes: bool

    def start(self, policy: TensorDictModuleBase, batches: Batches) -> None:
        """Prepare collection with ``policy``."""
        ...

    def collect(self) -> TensorDictBase:
        """Return the next trajectories ``(N, T)`` on the ``device`` of :meth:`start`, and time their collection."""
        ...

    def metrics(self) -> dict[str, float]:
        """Return metrics of the environments themselves."""
        ...

    def stop(self) -> None:
        """Release the resources of :meth:`start`."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a resumed run."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of :meth:`state_dict`, before :meth:`start`."""
        ...


class LocalSource:
    """A trajectory source of environments in this process.

    The state of the source is the state of its environments. If that includes their episodes, a resumed run continues
    these episodes and gives the same numbers.

    Args:
        env: Environments, batch size ``[N]``, with or without transforms.
    """

    def __init__(self, env: Environments) -> None:
        self.env = env
        self.num_envs = env.batch_size[0]
        self.resumes_episodes = env.resumes_episodes

    def start(self, policy: TensorDictModuleBase, batches: Batches) -> None:
        """Set up TorchRL's collector."""
        device = batches.device
        self._stopwatch = batches.stopwatch
        self._precision = partial(torch.autocast, device.type, torch.bfloat16, enabled=batches.autocast)
        self._stopwatch.watch("forward", policy)
        random = GlobalRNGState().state_dict()
        self._collector = Collector(
            self.env,
            policy,
            frames_per_batch=batches.frames,
            total_frames=-1,
            env_device=self.env.device,
            policy_device=device,
            storing_device=device,
            auto_register_policy_transforms=False,
            track_traj_ids=False,
        )
        # Setting up a collector draws random numbers, which must not change the numbers of a resumed run.
        GlobalRNGState().load_state_dict(random)
        self._batches = iter(self._collector)

    def collect(self) -> TensorDictBase:
        """Return the next trajectories; the time goes to ``physics`` and ``forward``."""
        before = self.env.physics_seconds
        # OpenMP's threads spin for milliseconds after each parallel operation, often longer than a control step takes.
        # Torch therefore uses this thread only, and leaves the other cores to physics.
        with self._precision(), threads(1):
            batch = next(self._batches)
        self._stopwatch.add("physics", self.env.physics_seconds - before)
        return batch

    def metrics(self) -> dict[str, float]:
        """Return the number of simulations that have diverged so far."""
        return {"episode/diverged": self.env.num_diverged}

    def stop(self) -> None:
        """Shut down the collector and its environments."""
        self._collector.shutdown()

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the environments."""
        return self.env.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the state of the environments.

        Raises:
            ValueError: If the state was written by a :class:`RemoteSource`.
        """
        if "starts" in state:
            raise ValueError("the run used collector=processes or ray: resume with the same collector")
        self.env.load_state_dict(state)


def local(make_env: Callable[..., Environments], *, num_envs: Count, seed: int) -> LocalSource:
    """Return a source in this process with the environments of ``make_env(num_envs=, seed=)``."""
    return LocalSource(make_env(num_envs=num_envs, seed=seed))


class RemoteSource:
    """A trajectory source of worker processes, which act with the newest weights.

    A backend of TorchRL starts the workers. A resumed run begins new episodes, with other seeds than before.

    Args:
        make_env: Picklable function that makes the environments of one worker, called as
            ``make_env(num_envs=, seed=, num_threads=)``.
        num_envs: Number of environments of all workers together, ``N``.
        seed: Seed of environments and exploration, from which the workers' seeds are derived.
        num_workers: Number of workers.
        num_threads: Number of physics threads per worker.
        backend: Backend of ``torchrl.collectors.Collector``: ``process`` on this machine, ``ray``, ``distributed``,
            ``rpc`` or ``submitit``.
        backend_options: Options of the backend.

    Raises:
        ValueError: If ``num_envs`` is not a multiple of ``num_workers``, or Ray is not installed.
    """

    resumes_episodes = False

    def __init__(
        self,
        make_env: Callable[..., Environments],
        *,
        num_envs: Count,
        seed: int,
        num_workers: Count,
        num_threads: Whole,
        backend: str = "process",
        backend_options: Mapping[str, Any] | None = None,
    ) -> None:
        if num_envs % num_workers:
            raise ValueError(f"num_envs={num_envs} must be a multiple of num_workers={num_workers}")
        if backend == "ray" and find_spec("ray") is None:
            raise ValueError("collector=ray needs Ray: pip install 'torchrl-mcp[ray]'")
        self.env = make_env(num_envs=1, seed=seed)
        self.num_envs = num_envs
        self.num_workers = num_workers
        self.seed = seed
        self._make_env = partial(_begin_worker, make_env, num_envs=num_envs // num_workers, num_threads=num_threads)
        self._backend = {"backend": backend, "backend_options": dict(backend_options or {})}
        self._starts = 0

    def start(self, policy: TensorDictModuleBase, batches: Batches) -> None:
        """Start the workers."""
        self._stopwatch = batches.stopwatch
        self._device = batches.device
        self._steps = batches.frames // self.num_envs
        seeds = np.random.SeedSequence((self.seed, self._starts)).generate_state(self.num_workers)
        self._starts += 1
        random = GlobalRNGState().state_dict()
        make_collector = partial(
            Collector,
            [partial(self._make_env, seed=int(seed)) for seed in seeds],
            _Autocast(policy, batches.device) if batches.autocast else policy,
            num_collectors=self.num_workers,
            sync=True,
            frames_per_batch=batches.frames,
            total_frames=batches.frames * 10**9,  # not all backends support endless collection
            env_device="cpu",
            policy_device=batches.device,
            storing_device=batches.device,
            **self._backend,
        )
        # TorchRL takes one of torch's threads from the main process for every worker, but workers idle during updates.
        with threads_kept(), new_workers() as self._workers:
            self._collector = self._begin(make_collector)
        GlobalRNGState().load_state_dict(random)
        self._batches: Iterator[TensorDictBase] | None = None

    def collect(self) -> TensorDictBase:
        """Return the next trajectories, collected with the newest weights; the time goes to ``collection``.

        Raises:
            ChildProcessError: If a worker on this machine or of Ray has ended.
        """
        with self._stopwatch("collection"):
            return attend(self._next, self._workers).reshape(self.num_envs, self._steps).to(self._device)

    def metrics(self) -> dict[str, float]:
        """Return no metrics: ``episode/diverged`` is unknown, because the environments are in the workers."""
        return {}

    def stop(self) -> None:
        """Stop the workers, including those that hang."""
        try:
            with threads_kept():
                self._collector.shutdown(timeout=PATIENCE)
        finally:
            end(self._workers)

    def state_dict(self) -> dict[str, Any]:
        """Return how often the workers have been started."""
        return {"starts": self._starts}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore the number of starts, so that the workers begin with new seeds.

        Raises:
            ValueError: If the state was written by a :class:`LocalSource`.
        """
        if "starts" not in state:
            raise ValueError("the run used collector=local: resume with the same collector")
        self._starts = state["starts"]

    def _begin(self, make_collector: Callable[..., Collector]) -> Collector:
        """Return the collector, after its workers have started."""
        if self._backend["backend"] == "process":
            return _begin_processes(make_collector)
        if self._backend["backend"] == "ray":  # starts in the main thread
            with ray_workers.starting():
                return make_collector(collector_class=ray_workers.RayWorker)
        return make_collector()

    def _next(self) -> TensorDictBase:
        with ray_workers.working() if self._backend["backend"] == "ray" else nullcontext():
            self._collector.update_policy_weights_()
            self._batches = self._batches or iter(self._collector)
            return next(self._batches)


class _Autocast(TensorDictModuleBase):
    """A policy that computes in bfloat16 autocast."""

    def __init__(self, policy: TensorDictModuleBase, device: torch.device) -> None:
        super().__init__()
        self.policy = policy
        self.device_type = device.type
        self.in_keys = policy.in_keys
        self.out_keys = policy.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Act."""
        with torch.autocast(self.device_type, torch.bfloat16):
            return self.policy(tensordict)


def _begin_processes(make_collector: Callable[..., Collector]) -> Collector:
    weights = SharedMemWeightSyncScheme()
    try:
        return begun(partial(make_collector, weight_sync_schemes={"policy": weights}))
    except BaseException:
        weights.shutdown()  # otherwise the interpreter's exit would wait forever for a thread that cannot start
        raise


def _begin_worker(make_env: Callable[..., Environments], *, seed: int, **settings: int) -> Environments:
    """Return the environments of a worker, in its process, which is seeded here and ends with its parent."""
    end_with_parent()
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    return make_env(seed=seed, **settings)
