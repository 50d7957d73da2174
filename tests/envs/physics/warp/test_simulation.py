"""What every engine promises, of Warp's: faults, partial resets, snapshots, room for contacts."""

import pytest
import torch
from refusals import refused
from tensordict import TensorDict

from torchrl_mcp.envs.physics.warp import WarpSimulation, constraint_room, contact_room

exact = pytest.mark.skipif(torch.cuda.is_available(), reason="on a GPU threads add up in any order")


@pytest.fixture
def env(make):
    return make("heading", physics="warp", terminate_on_fall=False)


def copied(simulation):
    return {name: field.clone() for name, field in {**simulation.state, **simulation.outputs}.items()}


def rows_equal(one, other, rows):
    for name, field in one.items():
        assert torch.equal(field[rows], other[name][rows]), name


def rows_agree(one, other, rows):
    """Require the same numbers; on a GPU, where threads add up in any order, nearly the same."""
    for name, field in one.items():
        tolerance = 1e-2 if field.is_cuda and field.is_floating_point() else 0.0
        torch.testing.assert_close(field[rows], other[name][rows], atol=tolerance, rtol=tolerance, msg=name)


def play(env, state, script):
    steps = []
    for action in script:
        step, state = env.step_and_maybe_reset(state.set("action", action))
        steps.append(step.select("observation", "goal", "action", "next").clone())
    return torch.stack(steps), state


def assert_identical(one, other):
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key in one.keys(True, True):
        assert torch.equal(one[key], other[key]), key


def test_state_and_outputs_are_views_of_warps_memory(env):
    simulation = env.simulation
    simulation.state["qpos"][1, 0] = 7.0
    assert simulation._data.qpos.numpy()[1, 0] == 7
    assert simulation.state["qpos"].data_ptr() == simulation._data.qpos.ptr
    assert simulation.outputs["xpos"].data_ptr() == simulation._data.xpos.ptr
    assert {field.dtype for field in simulation.state.values()} <= {torch.float32, torch.bool}


@pytest.mark.parametrize("number", [float("nan"), float("inf"), 1e20])
def test_a_control_without_meaning_is_a_fault_that_no_other_simulation_notices(make, env, actions, number):
    twin = make("heading", physics="warp", terminate_on_fall=False)
    env.reset(), twin.reset()
    script = actions(env, 4) * 0.5
    for action in script[:3]:
        env.simulation.step(action), twin.simulation.step(action)
    before, spoiled = copied(env.simulation), script[3].clone()
    spoiled[5, 2] = number
    assert env.simulation.step(spoiled).tolist() == [5]
    assert twin.simulation.step(script[3]).tolist() == []
    after, others = copied(env.simulation), [0, 1, 2, 3, 4, 6, 7]
    rows_agree(after, copied(twin.simulation), others)
    rows_equal(after, before, [5])


def test_a_diverging_simulation_ends_its_own_episode_only(env):
    env.reset()
    state = env.get_state()
    state["qvel"][2] = 1e9
    start = env.reset(state, set_state=True)
    before = start["observation"].clone()
    outcome = env.step(start.set("action", torch.zeros(env.action_spec.shape, device=env.device)))["next"]
    assert outcome["terminated"].flatten().tolist() == [index == 2 for index in range(8)]
    assert outcome["reward"][2] == 0
    assert torch.equal(outcome["observation"][2], before[2])
    assert env.num_diverged == 1
    assert all(value.isfinite().all() for value in outcome.select("observation", "goal", "reward").values())


def test_a_partial_reset_leaves_the_neighbours_alone(env, actions):
    _, carrier = play(env, env.reset(), actions(env, 3))
    before, outputs = env.get_state(), copied(env.simulation)
    mask = torch.zeros(8, 1, dtype=torch.bool, device=env.device)
    mask[3] = True
    env.reset(carrier.set("_reset", mask))
    others = [0, 1, 2, 4, 5, 6, 7]
    assert_identical(env.get_state()[others], before[others])
    rows_equal(copied(env.simulation), outputs, others)
    assert env.simulation.state["time"][3] == 0


@exact
def test_a_restored_environment_continues_bit_for_bit(make, actions):
    env = make("heading", physics="warp", max_episode_steps=15)
    script = actions(env, 40)
    _, carrier = play(env, env.reset(), script[:20])
    saved = env.state_dict()
    onward, _ = play(env, carrier.clone(), script[20:])
    assert onward["next", "done"].sum() > 6
    other = make("heading", physics="warp", max_episode_steps=15, seed=9)
    play(other, other.reset(), script[:7])
    other.load_state_dict(saved)
    again, _ = play(other, other.reset(), script[20:])
    assert torch.equal(onward["next", "observation"], again["next", "observation"])
    assert torch.equal(onward["next", "reward"], again["next", "reward"])


@exact
def test_the_same_seed_gives_the_same_trajectory_and_simulations_draw_their_own(make, actions):
    runs = []
    for seed in (3, 3, 4):
        env = make("heading", physics="warp", seed=seed, initial_directions=(-3.0, 3.0))
        runs.append(play(env, env.reset(), actions(env, 5))[0])
    assert_identical(runs[0], runs[1])
    assert not torch.equal(runs[0]["goal"], runs[2]["goal"])
    assert len(runs[0]["goal"][0, :, 0].unique()) == 8


def test_a_graph_does_what_its_launches_do(make, actions):
    recorded, plain = (make("heading", physics="warp") for _ in range(2))
    plain.simulation._step = plain.simulation._advance
    for action in actions(recorded, 3):
        for env in (recorded, plain):
            env.simulation.step(action)
    rows_agree(copied(recorded.simulation), copied(plain.simulation), slice(None))


def test_too_little_room_for_constraints_is_a_fault_and_for_contacts_an_error(make):
    warp = make("heading", physics="warp")
    model, device = warp.simulation.model, warp.device
    few = WarpSimulation(model, 2, device=device, substeps=1, contacts=24, constraints=4)
    sunk = few.state["qpos"].clone()
    sunk[1, 2] -= 0.005  # both feet in the ground: 8 contacts of 4 constraints each
    sunk[0, 2] += 1.0
    few.reset(torch.arange(2, device=device), {"qpos": sunk})
    assert few.step(torch.zeros(2, model.nu, device=device)).tolist() == [1]
    assert few.state["time"].tolist() == pytest.approx([model.opt.timestep, 0.0])
    crowded = WarpSimulation(model, 2, device=device, substeps=1, contacts=1, constraints=4)
    crowded.reset(torch.arange(2, device=device), {"qpos": sunk})
    with pytest.raises(RuntimeError, match="contacts"):
        crowded.step(torch.zeros(2, model.nu, device=device))


def test_room_grows_with_what_can_touch_the_ground(make):
    model = make("heading").simulation.model
    assert contact_room(model) == 24  # eight boxes of the biped, of which half lie flat, and eight more
    assert constraint_room(model, 24) == 4 * 24 + 7  # pyramids of four edges, and seven limits


def test_a_simulation_is_given_to_mujoco_to_draw_it(env, actions):
    play(env, env.reset(), actions(env, 3))
    data = env.simulation.data(2)
    torch.testing.assert_close(
        torch.from_numpy(data.xpos).float(), env.simulation.outputs["xpos"][2].cpu(), atol=1e-5, rtol=0
    )
    assert env.arrows(2)[0][0].shape == (3,)


def test_a_state_that_is_not_finite_is_refused(env):
    env.reset()
    state = TensorDict({"qpos": env.simulation.state["qpos"].cpu(), "qvel": torch.full((8, 23), torch.nan)}, [8]).to(
        env.device
    )
    refused(lambda: env.reset(state, set_state=True), "qvel")
