"""Mirror images: of a transition, simulated with left and right exchanged, the maps know state, action and goal."""

import math

import pytest
import torch
from refusals import refused
from tensordict import TensorDict

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Imitation, Location
from torchrl_mcp.envs.characters.joints import joint_layout
from torchrl_mcp.envs.characters.mirror import mirror_bodies
from torchrl_mcp.envs.motions import MotionLibrary, trex_corpus, turning_clips

CHARACTERS = ("biped", "humanoid", "trex")
TERMS = {
    "pose": {"weight": 0.2, "scale": 2.0},
    "velocity": {"weight": 0.2, "scale": 0.1},
    "bodies": {"weight": 0.2, "scale": 5.0},
    "orientations": {"weight": 0.2, "scale": 5.0},
    "com": {"weight": 0.2, "scale": 10.0},
}
PLACE, TURN = [1, -1, 1], [1, -1, 1, -1]
SPIN = [-1, 1, -1]


def imitation(character, **settings):
    clip = trex_corpus()[1] if character == "trex" else turning_clips(character)["left_sharp"]
    library = MotionLibrary({"left": clip, "right": clip.mirrored()})
    return Imitation(character, library, terms=TERMS, switch_interval=float("inf"), max_error=9.0, **settings)


TASKS = {
    "heading": lambda character, **settings: Heading(
        character, initial_directions=(-3.0, 3.0), max_turn=0.0, **settings
    ),
    "speeds": lambda character, **settings: Heading(
        character, initial_directions=(-3.0, 3.0), max_turn=0.0, speed=(0.0, 1.5), speed_interval=math.inf, **settings
    ),
    "location": lambda character, **settings: Location(
        character, target_intervals=(9.0, 9.0), final_directions=(-3.0, 3.0), **settings
    ),
    "dribble": lambda character, **settings: Dribble(character, object_distances=(0.5, 1.0), **settings),
    "carry": lambda character, **settings: Carry(character, object_distances=(0.5, 1.0), **settings),
    "imitation": imitation,
}
ABLE = [(task, character) for task in TASKS for character in CHARACTERS if (task, character) != ("carry", "trex")]


def reflected(state, character, nv):
    """The mirror image of a snapshot, worked out by hand from what each number of it is."""
    layout = joint_layout(character)
    joints = [name.replace("left_", "x").replace("right_", "left_").replace("x", "right_") for name in layout.names]
    own = dict(zip(layout.names, _velocities(layout), strict=True))
    image = {key: value.clone() for key, value in state.items()}
    qpos, qvel = state["qpos"], state["qvel"]
    image["qpos"][:, : layout.nq] = qpos[:, layout.mirror] * layout.mirror_sign
    for name, other in zip(layout.names, joints, strict=True):
        here, there = own[name], own[other]
        signs = {6: PLACE + SPIN, 3: SPIN, 1: [1]}[len(here)]
        image["qvel"][:, here] = qvel[:, there] * torch.tensor(signs)
    image["qpos"][:, layout.nq :] *= torch.tensor((PLACE + TURN)[: qpos.shape[1] - layout.nq])
    image["qvel"][:, layout.nv :] *= torch.tensor((PLACE + SPIN)[: nv - layout.nv])
    signs = {"mocap_pos": PLACE, "mocap_quat": TURN, "com": PLACE, "object": PLACE, "shift": [1, -1], "target": [1, -1]}
    for key in signs.keys() & image.keys():
        image[key] *= torch.tensor(signs[key])
    for key in {"direction", "final_direction", "turn"} & image.keys():
        image[key] *= -1
    if "clip" in image:
        image["clip"] = 1 - image["clip"]
    image["qacc_warmstart"] = torch.zeros_like(qvel)
    return {key: value for key, value in image.items() if key in state}


def _velocities(layout):
    """Which entries of ``qvel`` each joint has: the root six, a ball three, a hinge one."""
    spins = {int(row[0]): row.tolist() for row in layout.spins}
    starts, place = [], 0
    for index in range(len(layout.names)):
        size = 6 if index == 0 else 3 if place in spins else 1
        starts.append(list(range(place, place + size)))
        place += size
    return starts


@pytest.mark.parametrize(("task", "character"), ABLE)
def test_the_mirror_image_of_a_transition_is_one_with_the_same_reward(task, character):
    env, image = (TASKS[task](character, num_envs=16, seed=seed, num_threads=1) for seed in (0, 1))
    mirrors = env.mirrors()
    torch.manual_seed(0)
    for _ in range(3):
        env.rollout(4, auto_reset=True, break_when_any_done=False)
        state = env.get_state()
        here = env.reset(state.clone(), set_state=True)
        there = image.reset(TensorDict(reflected(dict(state), character, state["qvel"].shape[1]), 16), set_state=True)
        for key in ("observation", "goal"):
            torch.testing.assert_close(mirrors[key](here[key]), there[key], atol=2e-5, rtol=1e-4, msg=key)
            assert not torch.allclose(here[key], there[key], atol=1e-2)
        action = torch.rand(16, env.action_spec.shape[-1]) - 0.5
        after, then = env.step(here.set("action", action)), image.step(there.set("action", mirrors["action"](action)))
        for key in ("observation", "goal"):
            reflection = mirrors[key](after["next", key])
            torch.testing.assert_close(reflection, then["next", key], atol=5e-3, rtol=5e-3, msg=key)
        torch.testing.assert_close(after["next", "reward"], then["next", "reward"], atol=2e-3, rtol=1e-3)
        assert torch.equal(after["next", "terminated"], then["next", "terminated"])


@pytest.mark.parametrize(("task", "character"), ABLE)
def test_a_mirror_image_of_a_mirror_image_is_what_it_was(task, character):
    env = TASKS[task](character, num_envs=1, seed=0, num_threads=1)
    sizes = {**{key: env.observation_spec[key].shape[-1] for key in ("observation", "goal")}}
    for key, mirror in env.mirrors().items():
        numbers = torch.randn(3, sizes.get(key, env.action_spec.shape[-1]))
        assert torch.equal(mirror(mirror(numbers)), numbers)


def test_what_has_no_mirror_image_is_refused():
    refused(lambda: mirror_bodies(["root", "left_camera"]), "left_camera")
    refused(Holdout(num_envs=1, directions=(0.0, 3.0)).mirrors, "Holdout", "symmetry=none")
