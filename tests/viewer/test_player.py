import pytest
import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torchrl.envs import Compose
from torchrl.modules import IndependentNormal

from torchrl_mcp.envs import Heading
from torchrl_mcp.methods.transforms import OptionMemory, TransformedCharacterEnv
from torchrl_mcp.viewer.player import Player

NOTHING = torch.zeros(2, 17)


def heading(**kwargs):
    return Heading("biped", 2, seed=0, num_threads=1, **kwargs)


def policy(**values):
    """A policy that does nothing and writes ``values`` beside."""
    return TensorDictModule(
        lambda goal: (NOTHING, *values.values()), in_keys=["goal"], out_keys=["action", *values.keys()]
    )


def test_the_weights_are_the_gates_of_the_first_simulation():
    player = Player(policy(gates=torch.tensor([[0.25, 0.75], [1.0, 0.0]])), heading())
    player.step()
    assert player.weights == ("gates", [0.25, 0.75])


def test_of_options_the_weight_is_1_for_the_one_that_acts():
    env = TransformedCharacterEnv(heading(), Compose(OptionMemory()))
    chosen = {"option": torch.tensor([2, 0]), "begins": torch.ones(2, dtype=torch.bool)}
    player = Player(policy(**chosen), env, num_options=4)
    player.step()
    assert player.weights == ("option", [0, 0, 1, 0])


def test_a_policy_without_primitives_has_no_weights():
    player = Player(policy(), heading())
    assert player.weights is None
    player.step()
    assert player.weights is None


def test_an_episode_that_ends_is_followed_by_another():
    player = Player(policy(), heading(max_episode_steps=3))
    assert player.began
    began, times = [], []
    for _ in range(7):
        player.step()
        began.append(player.began)
        times.append(player.data.time)
    assert began == [False, False, True, False, False, True, False]
    assert times[2] == times[5] == 0.0 < times[6]


@pytest.mark.parametrize("deterministic", [True, False])
def test_actions_are_sampled_only_if_asked_for(deterministic):
    network = TensorDictModule(lambda goal: (NOTHING, NOTHING + 0.1), in_keys=["goal"], out_keys=["loc", "scale"])
    head = ProbabilisticTensorDictModule(
        in_keys=["loc", "scale"], out_keys=["action"], distribution_class=IndependentNormal
    )
    player = Player(ProbabilisticTensorDictSequential(network, head), heading(), deterministic=deterministic)
    player.step()
    assert player.env.simulation.state["ctrl"].eq(0).all() == deterministic


def test_the_shapes_beside_the_simulation_are_those_of_its_task():
    player = Player(policy(), heading())
    player.step()
    [arrow] = player.shapes
    assert arrow.position[2] > player.data.subtree_com[1, 2]
