r"""Trains a new gate over frozen primitives by soft actor-critic (TorchRL's SACLoss) and by this library's PPO.

    python benchmarks/off_policy.py     # half an hour on one core; writes results/off_policy.csv and figures

The built-in primitives of the biped are frozen, and both learners train a gate for the heading task with 32 equal
environments. SAC uses no part of this library's training: an action is the eight gates, and ``PlayGates`` plays the
mean of the composite. PPO is ``torchrl-mcp-train``. Evaluations play one deterministic episode of the paper's task in
each of 64 environments. ``cpu_seconds`` are processor time without evaluations. ``--quick`` takes seconds and learns
nothing.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import groupby, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from report import about, table, write
from tensordict import TensorDictBase
from tensordict.nn import InteractionType, TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded, LazyTensorStorage, ReplayBuffer
from torchrl.data.tensor_specs import TensorSpec
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_mcp.analysis.curves import Curve, plot_curves
from torchrl_mcp.analysis.figures import new_figure, save_figure
from torchrl_mcp.distributions import MultiplicativeGaussian
from torchrl_mcp.envs import Heading
from torchrl_mcp.evaluation.rollout import episode_statistics, evaluate
from torchrl_mcp.runs import experiment, policies
from torchrl_mcp.runs.builtin import builtin
from torchrl_mcp.runs.configuration import compose_run
from torchrl_mcp.training import run_folder

RESULTS = Path(__file__).resolve().parent / "results" / "off_policy.csv"
K = 8
"""Number of built-in primitives."""
EVALUATION_SEED = 12345
GAMMA, LR, UPDATES = 0.97, 5e-4, 3
"""SAC's discount, step size, and updates after each step of all environments."""
PPO = (
    "method=mcp task=heading character=biped stage=transfer pretrained=builtin curriculum=mixed "
    "step_size.critic=3e-4 training.frames_per_batch=1024 training.minibatch_size=256 evaluation.episodes=0 "
    "num_threads=1 torch_threads=1 keep_checkpoints=100 checkpoint_interval=16 progress_bar=false logger=none"
)


class PlayGates(Transform):
    """Makes the gates the action: the environment receives the mean action of the frozen primitives with these gates.

    The transform also normalises the observation, which the primitives and all new networks read.
    """

    def __init__(self, normaliser: nn.Module, primitives: nn.Module) -> None:
        super().__init__(in_keys=["observation"], in_keys_inv=["action"])
        self.normaliser = normaliser.requires_grad_(False)
        self.primitives = primitives.requires_grad_(False)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set("observation", self.normaliser(next_tensordict["observation"]))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        loc, scale = self.primitives(tensordict["observation"])
        return tensordict.set("action", MultiplicativeGaussian(loc, scale, tensordict["action"]).mean)

    def transform_input_spec(self, input_spec: TensorSpec) -> TensorSpec:
        """Replace the action by K gates between 0 and 1."""
        input_spec["full_action_spec", "action"] = Bounded(0.0, 1.0, (*self.parent.batch_size, K))
        return input_spec


def make_env(num_envs: int, seed: int, **kwargs: Any) -> TransformedEnv:
    """Make the heading task whose actions are the gates of the built-in primitives."""
    _, agent, _ = policies.restore(builtin("mcp", "biped"), num_envs=1, seed=0)
    play = PlayGates(agent.parts["observation_normaliser"], agent.parts["primitives"])
    return TransformedEnv(Heading("biped", num_envs, seed=seed, num_threads=1, **kwargs), play)


def make_actor() -> ProbabilisticActor:
    """Make a gate that samples its weights: a squashed Gaussian over (0, 1)."""
    gate = MLP(out_features=2 * K, num_cells=[256, 256], activation_class=nn.ReLU)
    return ProbabilisticActor(
        TensorDictSequential(
            TensorDictModule(gate, in_keys=["observation", "goal"], out_keys=["parameters"]),
            TensorDictModule(NormalParamExtractor(), in_keys=["parameters"], out_keys=["loc", "scale"]),
        ),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": 0.0, "high": 1.0},
        default_interaction_type=InteractionType.RANDOM,
    )


def make_critic() -> ValueOperator:
    """Make a network for the value of gates in a state, with layer normalisation, without which it would diverge."""
    norm = {"norm_class": nn.LayerNorm, "norm_kwargs": {"normalized_shape": 256}}
    value = MLP(out_features=1, num_cells=[256, 256], activation_class=nn.ReLU, **norm)
    return ValueOperator(value, in_keys=["observation", "goal", "action"])


def train(env: TransformedEnv, actor: ProbabilisticActor, *, total_frames: int, random_frames: int) -> Iterator[int]:
    """Train the actor by soft actor-critic, and yield the number of environment steps after every batch."""
    critic = make_critic()
    for network in (actor, critic):
        network(env.fake_tensordict())  # determines the sizes of the first layers
    loss = SACLoss(actor, critic, num_qvalue_nets=2, action_spec=Bounded(0.0, 1.0, (K,)), alpha_init=0.1)
    loss.make_value_estimator(gamma=GAMMA)
    target = SoftUpdate(loss, tau=0.005)
    optimizer = torch.optim.Adam(loss.parameters(), lr=LR, fused=True)
    buffer = ReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=256)
    collector = Collector(
        env,
        actor,
        frames_per_batch=env.batch_size.numel(),
        total_frames=total_frames,
        init_random_frames=random_frames,
        auto_register_policy_transforms=False,
    )
    for iteration, batch in enumerate(collector, 1):
        buffer.extend(batch.reshape(-1))
        frames = iteration * batch.numel()
        if frames > random_frames:
            for _ in range(UPDATES):
                losses = loss(buffer.sample())
                (losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"]).backward()
                optimizer.step()
                optimizer.zero_grad()
                target.step()
        yield frames
    collector.shutdown()


@dataclass(frozen=True)
class Size:
    """Numbers of environment steps, environments and episodes.

    Attributes:
        sac: Environment steps of SAC.
        ppo: Environment steps of PPO.
        random: Environment steps of SAC with random actions, at the beginning.
        interval: Environment steps between evaluations of SAC.
        num_envs: Number of environments.
        episodes: Number of episodes of an evaluation.
        environment: Arguments of the environments of evaluations.
    """

    sac: int = 49_152
    ppo: int = 163_840
    random: int = 2048
    interval: int = 8192
    num_envs: int = 32
    episodes: int = 64
    environment: dict[str, Any] = field(default_factory=dict)


QUICK = Size(sac=96, ppo=1024, random=32, interval=64, episodes=2, environment={"max_episode_steps": 30})


def sac_rows(seed: int, size: Size) -> Iterator[dict[str, Any]]:
    """Train by SAC, and yield a row for every evaluation."""
    torch.manual_seed(seed)
    # The curriculum of PPO's training.
    curriculum = {"initial_states": {"rest": 1.0, "motions": 0.5}, "random_first_length": True}
    env = make_env(size.num_envs, seed, curriculum=curriculum)
    actor = make_actor()
    evaluated = 0
    began = time.process_time()
    for steps in train(env, actor, total_frames=size.sac, random_frames=size.random):
        if steps - evaluated >= size.interval or steps == size.sac:
            seconds = time.process_time() - began
            evaluated = steps
            evaluation = make_env(size.episodes, EVALUATION_SEED, **size.environment)
            yield {"learner": "SAC", "seed": seed, "steps": steps, **earned(actor, evaluation, seconds)}
            began = time.process_time() - seconds  # evaluations do not count


def ppo_rows(seed: int, size: Size) -> Iterator[dict[str, Any]]:
    """Train by this library's PPO, and yield a row for every checkpoint, with seconds in proportion to its steps."""
    with TemporaryDirectory() as folder:
        counts = (f"training.total_frames={size.ppo}", f"training.num_envs={size.num_envs}")
        cfg = compose_run(*PPO.split(), *counts, f"seed={seed}", f"run_dir={folder}/run")
        began = time.process_time()
        run = experiment.train(cfg)
        seconds = time.process_time() - began
        environment: Any = OmegaConf.to_container(cfg.evaluation.environment, resolve=True)
        for path in reversed(run_folder.find_all(run)):
            steps = run_folder.frames(path)
            _, agent, env = policies.restore(
                path, num_envs=size.episodes, seed=EVALUATION_SEED, **environment | size.environment
            )
            policy = agent.actor.policy
            yield {
                "learner": "PPO",
                "seed": seed,
                "steps": steps,
                **earned(policy, env, seconds * steps / size.ppo),
            }


def earned(policy: TensorDictModuleBase, env: EnvBase, seconds: float) -> dict[str, Any]:
    """Return the results of a policy in one episode per environment, with the seconds of its training."""
    numbers = episode_statistics(evaluate(policy, env), env.normalised_return)
    return {
        "cpu_seconds": round(seconds, 1),
        "normalised_return": round(numbers["normalised_return"], 4),
        "interval": " ".join(f"{end:.4f}" for end in numbers["interval"]),
        "fallen": round(numbers["terminated"], 4),
        "episodes": env.num_envs,
    }


def draw(rows: list[dict[str, Any]]) -> Figure:
    """Draw the returns of all seeds against steps, and against seconds."""
    figure = new_figure(8.0, 3.4)
    learners = dict.fromkeys(row["learner"] for row in rows)
    for axes, (key, label) in zip(
        figure.subplots(1, 2, sharey=True),
        [("steps", "environment steps"), ("cpu_seconds", "seconds of one core")],
        strict=True,
    ):
        plot_curves(axes, [curve(rows, learner, key) for learner in learners], xlabel=label)
    axes.set(ylabel="")
    axes.legend(frameon=False)
    return figure


def curve(rows: list[dict[str, Any]], learner: str, key: str) -> Curve:
    """Return the curve of a learner over its seeds, which are all evaluated at the same steps."""
    groups = groupby(sorted((row for row in rows if row["learner"] == learner), key=by_steps), by_steps)
    points = [[(float(row[key]), float(row["normalised_return"])) for row in group] for _, group in groups]
    x, y = np.array(points).transpose(2, 0, 1)
    return Curve(learner, x.mean(1), y.mean(1), y.min(1), y.max(1), y.shape[1])


def by_steps(row: dict[str, Any]) -> int:
    """Return the steps of a row."""
    return int(row["steps"])


LEARNERS = {"SAC": sac_rows, "PPO": ppo_rows}


def main() -> None:
    """Train, evaluate, print, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=list(LEARNERS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1])
    parser.add_argument("--quick", action="store_true", help="a few steps and two episodes of a second")
    parser.add_argument("--output", type=Path, help=f"CSV file; without --quick it is {RESULTS.name} by default")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    for learner, seed in product(arguments.learners, arguments.seeds):
        for row in LEARNERS[learner](seed, QUICK if arguments.quick else Size()):
            rows.append(row | about())
            print(table([row]), flush=True)
    if output := arguments.output or (None if arguments.quick else RESULTS):
        write(output, rows)
        save_figure(draw(rows), output.with_suffix(""))


if __name__ == "__main__":
    main()
