"""MuJoCo Warp computes what MuJoCo does, as far as float32 can tell, on Warp's CPU device."""

import mujoco
import pytest
import torch
from tensordict import TensorDict

NUM_STEPS = 100
"""Control steps, of four physics steps each, or of five with an integrator of four stages."""

# Largest difference after one control step from the same state, but for RARE. Resolution of float32: 6e-8 of a number.
TOLERANCES = {
    "time": 1e-6,  # seconds: sums of steps
    "qpos": 3e-6,  # metres and parts of quaternions: places are a few metres, rounded in each of 20 operations
    "qvel": 5e-4,  # m/s and rad/s: rounded accelerations of up to 1e4 in each physics step of 1/120 s
    "xpos": 3e-6,
    "xquat": 3e-6,
    "geom_xpos": 3e-6,
    "geom_xmat": 1e-5,
    "subtree_com": 3e-6,
    "cvel": 5e-4,
    "sensordata": 1e-5,  # metres between shapes
}
RARE = 0.05
"""Share of the simulations and steps with larger differences.

Whether a shape that hardly touches another is in contact is decided by the last bit, and so is the physics step in
which a contact begins: a foot that stands on the ground lies 2e-9 m below it in float32, and above it in float64.
"""
ON_CAPSULES = 0.6
"""The same share of ants and T-Rexes, with pyramids of friction.

They walk on the ends of capsules. MuJoCo turns the pyramids of steep capsules with them, and Warp does not.
"""
LIFT = 0.01
"""Metres by which characters begin above the ground, so that the first contacts are not decided by the last bit."""
SCENES = [
    *(("heading", character, {}, RARE) for character in ("biped", "humanoid")),
    ("heading", "trex", {"friction_cone": "elliptic"}, RARE),
    ("heading", "trex", {}, ON_CAPSULES),
    *((scene, "biped", {}, RARE) for scene in ("carry", "dribble", "imitation")),
    ("holdout", "ant", {}, ON_CAPSULES),
]


def lasting(scene):
    """Arguments with which episodes go on, whatever the character does."""
    if scene == "holdout":
        return {"terminate_when_unhealthy": False}
    return {"terminate_on_fall": False, "max_episode_steps": 10_000} | (
        {"max_error": 1e3} if scene == "imitation" else {}
    )


def differences(make, actions, scene, character, num_steps, **kwargs):
    """Largest differences of state and outputs in each simulation after steps from the same states, ``(T, N)``."""
    ours, exact = (
        make(scene, character, physics=physics, **lasting(scene), **kwargs) for physics in ("warp", "mujoco")
    )
    exact.reset()
    lifted, found = exact.get_state(), {}
    lifted["qpos"][:, 2] += LIFT
    state = exact.reset(lifted, set_state=True)
    for action in actions(exact, num_steps):
        generator = exact.generator.get_state()
        begun = ours.reset(exact.get_state(), set_state=True)
        ours.generator.set_state(generator)
        ours.step(begun.set("action", action))
        state = exact.step(state.set("action", action))["next"]
        fields = [{**env.simulation.state, **env.simulation.outputs} for env in (ours, exact)]
        for name in TOLERANCES.keys() & fields[0].keys():
            apart = (fields[0][name].double() - fields[1][name]).abs().reshape(ours.num_envs, -1).amax(-1)
            found.setdefault(name, []).append(apart)
    assert ours.num_diverged == exact.num_diverged == 0
    if "time" in ours.episode:  # that of the clip, which has the name of the simulation's
        del found["time"]
    return {name: torch.stack(parts) for name, parts in found.items()}


def require_parity(found, rare=RARE):
    for name, apart in found.items():
        assert (apart > TOLERANCES[name]).double().mean() <= rare, (name, apart.flatten().sort().values[-20:])


def test_a_control_step_from_the_same_state_is_mujocos(make, actions):
    require_parity(differences(make, actions, "heading", "biped", 10))


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "character", "kwargs", "rare"), SCENES)
def test_every_control_step_of_every_scene_is_mujocos(make, actions, scene, character, kwargs, rare):
    found = differences(make, actions, scene, character, NUM_STEPS, **kwargs)
    assert {"qpos", "qvel"} <= found.keys()
    require_parity(found, rare)


def test_observations_and_rewards_of_the_same_state_are_those_of_mujocos_threads(make, actions):
    ours, exact = (make("heading", physics=physics) for physics in ("warp", "mujoco"))
    for action in actions(exact, 5):
        state = exact.step(exact.reset().set("action", action))["next"]
        begun = ours.reset(exact.get_state(), set_state=True)
        torch.testing.assert_close(begun["observation"], state["observation"], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(begun["goal"], state["goal"], atol=1e-5, rtol=0)


def test_a_fall_from_above_stays_together_for_a_second(make, actions):
    """No resynchronisation: rounding grows along the way, and with the first contacts exponentially."""
    ours, exact = (make("heading", physics=physics, terminate_on_fall=False) for physics in ("warp", "mujoco"))
    exact.reset()
    start = exact.get_state().select("qpos", "qvel", "direction")
    start["qpos"][:, 2] += LIFT
    states = [env.reset(start.clone(), set_state=True) for env in (ours, exact)]
    for action in actions(exact, 30, scale=0.2):
        states = [
            env.step(state.set("action", action))["next"] for env, state in zip((ours, exact), states, strict=True)
        ]
    apart = (ours.simulation.state["qpos"] - exact.simulation.state["qpos"]).abs().amax(-1)
    assert apart.median() < 1e-4
    torch.testing.assert_close(states[0]["reward"], states[1]["reward"], atol=1e-2, rtol=0)


@pytest.mark.parametrize("character", ["biped", pytest.param("trex", marks=pytest.mark.slow)])
def test_who_stands_still_is_held_up_by_its_weight_and_loses_its_energy(make, character):
    env = make("heading", character, 2, physics="warp", terminate_on_fall=False)
    state, still = env.reset(), torch.zeros(env.action_spec.shape)
    for _ in range(15):
        state = env.step(state.set("action", still))["next"]
    data, model = env.simulation.data(0), env.simulation.model
    weight = model.body_mass.sum() * -model.opt.gravity[2]
    forces = env.simulation.contact_forces()[0].double()
    # Contact forces on all bodies but the world, and what accelerates the centre of mass.
    mujoco.mj_subtreeVel(model, data)
    assert float(forces[1:, 5].sum()) == pytest.approx(weight, rel=0.05)
    assert abs(data.subtree_linvel[1, 2]) < 0.02
    assert float(torch.from_numpy(data.qvel).abs().max()) < 0.2


def test_the_state_of_one_engine_is_one_of_the_other(make):
    ours, exact = (make("heading", physics=physics) for physics in ("warp", "mujoco"))
    exact.step(exact.reset().set("action", torch.zeros(exact.action_spec.shape)))
    state = exact.get_state()
    ours.reset(state.clone(), set_state=True)
    back = ours.get_state()
    assert set(back.keys()) == set(state.keys())
    assert isinstance(back, TensorDict)
    for key, value in back.items():
        assert value.shape == state[key].shape, key
        torch.testing.assert_close(value.to(state[key].dtype), state[key], atol=1e-6, rtol=1e-6, msg=key)
