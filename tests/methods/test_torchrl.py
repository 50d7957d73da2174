"""The composite in TorchRL's own loops: its trainer, and a gate with memory."""

import warnings
from functools import partial

import pytest
import torch
from tensordict.nn import InteractionType, TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.envs import Compose, GymEnv, InitTracker, TransformedEnv
from torchrl.modules import MLP, GRUModule, ProbabilisticActor, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl.trainers.algorithms.ppo import PPOTrainer

from torchrl_mcp.distributions import MultiplicativeGaussian
from torchrl_mcp.methods.actor import Sizes
from torchrl_mcp.methods.critic import value_critic
from torchrl_mcp.methods.mcp import composite_actor, composite_parts
from torchrl_mcp.modules import Primitives
from torchrl_mcp.training.transfer import fingerprint

PENDULUM = Sizes(observation=3, goal=0, action=1)
HEADS = {"gate_activation": nn.Sigmoid(), "distribution_class": MultiplicativeGaussian}


@pytest.fixture
def env():
    torch.manual_seed(0)
    env = GymEnv("Pendulum-v1", device="cpu")
    env.set_seed(0)
    yield env
    env.close()


class StateGating(nn.Module):
    """A gate that sees the state alone."""

    def __init__(self, observation_dim, goal_dim, num_primitives):
        super().__init__()
        self.network = MLP(observation_dim, num_primitives, num_cells=[16])

    def forward(self, observation, goal):
        return self.network(observation)


@pytest.mark.parametrize("frozen", [[], ["primitives", "observation_normaliser"]], ids=["all", "the gate"])
def test_torchrls_trainer_trains_the_composite_in_an_environment_without_a_goal(env, frozen):
    primitives = partial(Primitives, trunk_cells=(16,), branch_cells=8)
    parts = composite_parts(
        PENDULUM, gating=StateGating, primitives=primitives, num_primitives=3, initial_std=0.5, **HEADS
    )
    for name in frozen:
        parts[name].requires_grad_(False)
    actor = composite_actor(parts, frozen=frozen, **HEADS)
    loss = ClipPPOLoss(actor.trained, value_critic(parts, PENDULUM, num_cells=(16,)))
    before = {name: fingerprint(part) for name, part in parts.items()}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=UserWarning)  # an experimental part of TorchRL
        warnings.filterwarnings("ignore", category=FutureWarning)
        trainer = PPOTrainer(
            collector=Collector(
                env, actor.policy, frames_per_batch=40, total_frames=80, auto_register_policy_transforms=False
            ),
            total_frames=80,
            frame_skip=1,
            loss_module=loss,
            optimizer=torch.optim.Adam([p for p in loss.parameters() if p.requires_grad], lr=1e-3),
            optim_steps_per_batch=2,
            replay_buffer=ReplayBuffer(
                storage=LazyTensorStorage(40), sampler=SamplerWithoutReplacement(), batch_size=20
            ),
            enable_logging=False,
            progress_bar=False,
        )
        trainer.train()
    changed = {name for name, part in parts.items() if fingerprint(part) != before[name]}
    assert changed == {"gating", "primitives", "critic"} - set(frozen)


@pytest.fixture
def remembering():
    """A gate with memory over frozen primitives, and the transform that keeps its memory."""
    torch.manual_seed(0)
    memory = GRUModule(
        input_size=3,
        hidden_size=8,
        in_keys=["observation", "recurrent_state", "is_init"],
        out_keys=["features", ("next", "recurrent_state")],
    )
    primitives = Primitives(3, 1, 4, trunk_cells=(16,), branch_cells=8).requires_grad_(False)
    actor = ProbabilisticActor(
        TensorDictSequential(
            memory,
            TensorDictModule(nn.Sequential(nn.Linear(8, 4), nn.Sigmoid()), in_keys=["features"], out_keys=["gates"]),
            TensorDictModule(primitives, in_keys=["observation"], out_keys=["loc", "scale"]),
        ),
        in_keys=["loc", "scale", "gates"],
        distribution_class=MultiplicativeGaussian,
        return_log_prob=True,
        default_interaction_type=InteractionType.RANDOM,
    )
    return actor, Compose(InitTracker(), memory.make_tensordict_primer())


def test_a_gate_with_memory_remembers_earlier_states_and_forgets_them_at_a_reset(env, remembering):
    actor, transforms = remembering
    env = TransformedEnv(env, transforms)
    with torch.no_grad():
        first = actor(env.reset())
        seen = first["observation"], first["gates"]
        _, later = env.step_and_maybe_reset(first)
        assert not torch.equal(actor(later.set("observation", seen[0]))["gates"], seen[1])
        begun = actor(env.reset().set("observation", seen[0]))
    torch.testing.assert_close(begun["gates"], seen[1])


def test_the_loss_of_trajectories_sees_what_a_gate_with_memory_did_and_trains_the_memory_alone(env, remembering):
    actor, transforms = remembering
    critic = ValueOperator(MLP(3, 1, num_cells=[16]))
    with torch.no_grad():
        batch = TransformedEnv(env, transforms).rollout(40, actor)
        GAE(gamma=0.95, lmbda=0.9, value_network=critic)(batch)
    with set_recurrent_mode(True):
        report = ClipPPOLoss(actor, critic)(batch)
    torch.testing.assert_close(report["max_ratio"], torch.tensor(1.0), atol=1e-5, rtol=0)
    report["loss_objective"].backward()
    gradients = {name: parameter.grad for name, parameter in actor.named_parameters() if parameter.requires_grad}
    assert any("gru" in name for name in gradients)
    assert all(gradient.abs().max() > 0 for gradient in gradients.values())
