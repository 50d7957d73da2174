from dataclasses import replace

import pytest
import torch

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import body_states
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.generator import stride, walk
from torchrl_mcp.envs.motions.library import MotionLibrary
from torchrl_mcp.envs.motions.placement import Placement
from torchrl_mcp.envs.rotations import inverse, multiply, to_rotation_vector


@pytest.fixture(scope="module")
def clips():
    rates = torch.linspace(0, 1, 90)
    return {"curve": walk("humanoid", 0.5 + rates, rates), "turn": stride("humanoid", 0.9, -0.8)}


@pytest.fixture(scope="module")
def library(clips):
    return MotionLibrary(clips)


def test_moments_are_those_of_the_clips(clips, library):
    indices = torch.tensor([0, 1, 1, 0, 1])
    times = torch.tensor([0.333, 0.2, 4.321, 99.0, -2.5], dtype=torch.float64)
    moments = library.at(indices, times)
    for row, (index, time) in enumerate(zip(indices.tolist(), times, strict=True)):
        clip = list(clips.values())[index]
        expected = clip.at(time)
        quaternions = clip.layout.quaternions
        apart = multiply(inverse(expected[quaternions]), moments.qpos[row][quaternions])
        assert to_rotation_vector(apart).norm(dim=-1).max() < 1e-3
        torch.testing.assert_close(moments.qpos[row][:3], expected[:3])
        torch.testing.assert_close(moments.qpos[row][clip.layout.angles], expected[clip.layout.angles])
        torch.testing.assert_close(moments.qvel[row], clip.velocity(time))


def test_bodies_are_where_forward_kinematics_puts_them(library):
    indices, times = library.sample(64, torch.Generator().manual_seed(0))
    moments = library.at(indices, 3 * times)
    expected = body_states("humanoid", moments.qpos, moments.qvel)
    torch.testing.assert_close(moments.bodies.positions, expected.positions, atol=2e-3, rtol=0)
    apart = multiply(inverse(expected.orientations), moments.bodies.orientations)
    assert to_rotation_vector(apart).norm(dim=-1).max() < 2e-3
    torch.testing.assert_close(moments.bodies.linear_velocities, expected.linear_velocities, atol=0.05, rtol=0)
    torch.testing.assert_close(moments.bodies.angular_velocities, expected.angular_velocities, atol=0.1, rtol=0)


@pytest.mark.parametrize("character", CHARACTERS)
def test_at_frames_the_bodies_are_exactly_those_of_forward_kinematics(character):
    qpos = torch.from_numpy(character_model(character).qpos0).repeat(3, 1)
    qpos[:, 0] = torch.tensor([0.0, 0.1, 0.3])
    clip = MotionClip(character, qpos, 10.0)
    moments = MotionLibrary({"glide": clip}).at(torch.zeros(3, dtype=torch.int64), torch.tensor([0.0, 0.1, 0.2]))
    expected = body_states(character, clip.qpos, clip.qvel)
    torch.testing.assert_close(moments.qpos, clip.qpos, atol=1e-6, rtol=0)
    for name, field in expected._asdict().items():
        torch.testing.assert_close(getattr(moments.bodies, name), field, atol=1e-5, rtol=0)


def test_a_placed_moment_is_placed_with_all_its_bodies(library):
    indices, times = library.sample(16, torch.Generator().manual_seed(1))
    generator = torch.Generator().manual_seed(2)
    turn = torch.randn(16, generator=generator, dtype=torch.float64)
    moments = library.at(indices, times, Placement(turn, torch.randn(16, 2, generator=generator)))
    expected = body_states("humanoid", moments.qpos, moments.qvel)
    torch.testing.assert_close(moments.bodies.positions, expected.positions, atol=2e-3, rtol=0)
    torch.testing.assert_close(moments.bodies.linear_velocities, expected.linear_velocities, atol=0.05, rtol=0)


def test_rows_of_moments_are_replaced_with_their_places(library):
    (indices, times), turns = library.sample(6, torch.Generator().manual_seed(1)), torch.arange(6.0).double()
    placement = Placement(turns, torch.stack([turns, -turns], -1))
    moments, ids = library.at(indices, times, placement), torch.tensor([4, 1])
    changed = moments.replaced(ids, moments[:2])
    order = [0, 1, 2, 3, 0, 5]
    assert torch.equal(changed.qpos, moments.qpos[order])
    assert torch.equal(changed.bodies.linear_velocities, moments.bodies.linear_velocities[order])


def test_the_digest_changes_with_everything_that_is_read(clips, library):
    curve, turn = clips["curve"], clips["turn"]
    changed = curve.qpos.clone()
    changed[5, 7] += 1e-12
    cycle = replace(curve, qpos=torch.cat([curve.qpos, curve.qpos[:1]]))
    others = [
        MotionLibrary({"curve": curve}),
        MotionLibrary({"turn": turn, "curve": curve}),
        MotionLibrary({"curve": replace(curve, qpos=changed), "turn": turn}),
        MotionLibrary({"curve": replace(curve, fps=30.0), "turn": turn}),
        MotionLibrary({"curve": cycle, "turn": turn}),
        MotionLibrary({"curve": replace(cycle, loop=True), "turn": turn}),
        MotionLibrary(clips, {"curve": 1.0, "turn": 1.0}),
    ]
    assert len({library.digest, *(other.digest for other in others)}) == 1 + len(others)
    assert MotionLibrary(clips).digest == library.digest


def test_without_weights_every_moment_is_equally_likely(library):
    indices, times = library.sample(20_000, torch.Generator().manual_seed(0))
    share = library.durations[0] / library.durations.sum()
    assert float((indices == 0).double().mean()) == pytest.approx(float(share), abs=0.02)
    for index, duration in enumerate(library.durations):
        mine = times[indices == index] / duration
        assert mine.min() >= 0
        assert mine.max() < 1
        assert float(mine.mean()) == pytest.approx(0.5, abs=0.02)


def test_weights_say_how_often_a_clip_is_drawn(clips):
    library = MotionLibrary(clips, {"turn": 3.0, "curve": 1.0})
    indices, _ = library.sample(20_000, torch.Generator().manual_seed(0))
    assert float(indices.double().mean()) == pytest.approx(0.75, abs=0.02)


def test_the_same_generator_state_draws_the_same_moments(library):
    draws = [library.sample(10, torch.Generator().manual_seed(7)) for _ in range(2)]
    assert torch.equal(draws[0][0], draws[1][0])
    assert torch.equal(draws[0][1], draws[1][1])


def test_single_precision_is_emitted_where_asked_for(clips):
    library = MotionLibrary(clips, dtype=torch.float32)
    moments = library.at(torch.tensor([0, 1]), torch.tensor([0.1, 5.0]))
    moment = moments.moment
    assert {field.dtype for field in (moment.qpos, moment.qvel, *moment.bodies)} == {torch.float32}


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        ({"curve": 1.0}, r"weights are of \['curve'\]: pass one for each of the clips \['curve', 'turn'\]"),
        ({"curve": 1.0, "turn": -1.0}, "pass finite numbers of at least 0"),
        ({"curve": 0.0, "turn": 0.0}, "not all of them 0"),
        ({"curve": torch.inf, "turn": 0.0}, "pass finite numbers"),
    ],
)
def test_weights_that_do_not_fit_are_refused(clips, weights, message):
    with pytest.raises(ValueError, match=message):
        MotionLibrary(clips, weights)


def test_clips_of_several_characters_or_none_are_refused(clips):
    with pytest.raises(ValueError, match=r"clips are of \['biped', 'humanoid'\]"):
        MotionLibrary({**clips, "other": stride("biped", 1.0, 0.0)})
    with pytest.raises(ValueError, match="no character"):
        MotionLibrary({})
