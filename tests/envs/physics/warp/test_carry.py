"""Boxes held at another pose in every simulation: the joint, and whether it is closed, are each simulation's own."""

import pytest
import torch

OPENED, RESET, NUM_STEPS = 6, 12, 20
"""Control steps in the air before one joint opens, before another simulation begins anew, and in all."""
HEIGHT = 3.0
"""Metres above the ground: no contact in 0.67 s, so that no rounding decides when one begins."""
TOLERANCES = {
    "qpos": 2e-3,  # metres and parts of quaternions: 1e-4 in a control step with a box in hand, which add up
    "qvel": 2e-2,  # m/s and rad/s: 1e-2 in a control step, which the joint damps
    "eq_active": 0.0,
    "eq_data": 1e-6,  # metres and parts of quaternions, rounded once
}


@pytest.fixture(params=["biped", pytest.param("humanoid", marks=pytest.mark.slow)])
def engines(make, request):
    lasting = {"terminate_on_fall": False, "max_episode_steps": 1000}
    return [make("carry", request.param, physics=physics, **lasting) for physics in ("warp", "mujoco")]


@pytest.fixture
def states(make, held, engines):
    """Two states of all simulations, with boxes held at different poses."""
    env = make("carry", engines[0].character.name)
    return [held(env, HEIGHT, seed) for seed in (0, 1)]


def require_same(engines):
    for name, tolerance in TOLERANCES.items():
        ours, exact = (env.simulation.state[name].cpu().double() for env in engines)
        torch.testing.assert_close(ours, exact, atol=tolerance, rtol=0)


def gaps(env):
    """Metres between the carrier and the box."""
    bodies, places = env.simulation.model.body, env.simulation.outputs["xpos"]
    apart = places[:, bodies(env.character.carrier).id] - places[:, bodies("box").id]
    return torch.linalg.vector_norm(apart, dim=-1).cpu()


def test_each_simulation_holds_its_own_box_in_the_air_as_on_mujocos_threads(engines, states, actions):
    steps = [env.reset(states[0].clone().to(env.device), set_state=True) for env in engines]
    begun = gaps(engines[0])
    assert len(begun.round(decimals=3).unique()) == 8
    for index, action in enumerate(actions(engines[1], NUM_STEPS)):
        if index == OPENED:
            for env in engines:
                env.simulation.state["eq_active"][2] = 0
        if index == RESET:
            before, one = engines[0].get_state().cpu(), torch.arange(8).unsqueeze(-1) == 5
            steps = [env.reset(states[1].clone().set("_reset", one).to(env.device), set_state=True) for env in engines]
            after, others = engines[0].get_state().cpu(), ~one.flatten()
            assert all(torch.equal(value[others], before[key][others]) for key, value in after.items())
            assert not torch.equal(after["eq_data"][5], before["eq_data"][5])
            begun[5] = gaps(engines[0])[5]
        steps = [
            env.step(step.set("action", action.to(env.device)))["next"]
            for env, step in zip(engines, steps, strict=True)
        ]
        require_same(engines)
    moved = (gaps(engines[0]) - begun).abs()
    assert moved[2] > 0.03
    assert moved[torch.arange(8) != 2].max() < 0.01  # the joint gives way
