import math

import pytest
import torch
from refusals import refused

from torchrl_mcp.envs import Carry, Curriculum, Dribble, Heading, Location
from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.initial_states import InitialStates
from torchrl_mcp.envs.motions.single import single_motion
from torchrl_mcp.envs.rotations import heading

MIXED = {"rest": 1.0, "motions": 3.0}


def draw(initial_states, num=400, character="biped"):
    states = InitialStates(character, initial_states, single_motion(character))
    return states, *states.draw(num, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("character", CHARACTERS)
def test_states_in_motion_are_moments_of_the_library_over_the_origin_facing_along_x(character):
    _, qpos, qvel = draw("motions", 50, character)
    library = single_motion(character)
    times = torch.arange(0.0, library.durations[0].item(), 1e-3, dtype=torch.float64)
    moments = library.at(torch.zeros(len(times), dtype=torch.int64), times)
    angles = torch.cdist(qpos[:, 7:].double(), moments.qpos[:, 7:].double())
    nearest = angles.min(-1)
    assert nearest.values.max() < 0.05
    assert len(set(nearest.indices.tolist())) > 25
    assert qpos[:, :2].abs().max() < 1e-6
    assert heading(qpos[:, 3:7]).abs().max() < 1e-5
    assert (qvel[:, :3].norm(dim=-1) - moments.qvel[nearest.indices, :3].norm(dim=-1)).abs().max() < 0.05
    assert qvel[:, 0].mean() > 0.5  # they walk forward


def test_states_are_drawn_with_the_shares_of_their_weights():
    states, qpos, qvel = draw(MIXED)
    resting = (qvel == 0).all(-1)
    assert torch.equal(qpos[resting], states.rest.expand(int(resting.sum()), -1))
    assert resting.sum().item() == pytest.approx(100, abs=4 * math.sqrt(400 * 0.25 * 0.75))


@pytest.mark.parametrize("initial_states", ["rest", {"rest": 2.0}, {"rest": 1.0, "motions": 0.0}])
def test_rest_alone_needs_no_motions(initial_states):
    states, _, qvel = draw(initial_states, 5)
    assert states.library is None
    assert not qvel.any()


@pytest.mark.parametrize(
    "initial_states", ["walk", {"walk": 1.0}, {}, {"rest": -1.0, "motions": 2.0}, {"rest": 0.0}, {"rest": math.inf}]
)
def test_unknown_states_and_weights_that_are_none_are_refused(initial_states):
    refused(lambda: draw(initial_states), f"initial_states={initial_states!r}")


def test_motions_of_another_character_are_refused():
    refused(lambda: InitialStates("biped", "motions", single_motion("trex")), "motions", "trex", "character='biped'")


@pytest.mark.parametrize("task", [Carry, Dribble, Heading, Location])
def test_every_transfer_task_begins_in_motion_when_told_to(task):
    curriculum = Curriculum(initial_states=MIXED, motions=single_motion("biped"))
    env = task("biped", 200, seed=0, num_threads=1, curriculum=curriculum)
    env.reset()
    moving = env.get_state()["qvel"][:, :6].abs().sum(-1) > 0
    assert moving.sum().item() == pytest.approx(150, abs=4 * math.sqrt(200 * 0.25 * 0.75))


@pytest.mark.parametrize("task", [Carry, Dribble])
@pytest.mark.parametrize("character", CHARACTERS)
def test_no_object_begins_in_a_character_that_moves(task, character):
    curriculum = Curriculum(initial_states="motions", motions=single_motion(character))
    env = task(character, 64, seed=0, num_threads=1, object_distances=(0.0, 1.5), curriculum=curriculum)
    env.reset()
    model = env.simulation.model
    for index in range(64):
        pairs = [{model.geom(geom).bodyid[0] for geom in pair} for pair in env.simulation.data(index).contact.geom]
        thing = model.nbody - 1
        touching = {model.body(body).name for pair in pairs if thing in pair for body in pair - {thing}}
        assert touching <= {"world", "source"}, index
