import math
import zipfile

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model, joint_layout
from torchrl_mcp.envs.characters.kinematics import body_names, body_states
from torchrl_mcp.envs.characters.mirror import twin
from torchrl_mcp.envs.motions.clip import MotionClip, concatenated, differences
from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.gait.generator import stride
from torchrl_mcp.envs.rotations import about_z, heading


def random_clip(character="humanoid", *, frames=7, fps=10.0, loop=False, seed=0):
    """Small random motions about the rest pose, integrated by MuJoCo."""
    model = character_model(character)
    steps = np.random.default_rng(seed).normal(scale=0.15, size=(frames - 1, model.nv))
    qpos = [model.qpos0.copy()]
    for step in steps:
        qpos.append(qpos[-1].copy())
        mujoco.mj_integratePos(model, qpos[-1], step, 1.0)
    if loop:
        qpos[-1][7:] = qpos[0][7:]
    return MotionClip(character, torch.from_numpy(np.stack(qpos)), fps, loop), torch.from_numpy(steps)


def circling(fps=20.0):
    """A quarter of a circle of radius 2 m to the left within a second, as a loop."""
    angle = torch.linspace(0, math.pi / 2, round(fps) + 1, dtype=torch.float64)
    qpos = torch.from_numpy(character_model("biped").qpos0).repeat(len(angle), 1)
    qpos[:, 0], qpos[:, 1] = 2 * angle.sin(), 2 * (1 - angle.cos())
    qpos[:, 3:7] = about_z(angle)
    return MotionClip("biped", qpos, fps, loop=True)


@pytest.mark.parametrize("character", CHARACTERS)
def test_differences_are_those_of_mujoco(character):
    clip, steps = random_clip(character)
    torch.testing.assert_close(differences(clip.qpos, clip.layout), steps, atol=1e-9, rtol=0)


@pytest.mark.parametrize("character", CHARACTERS)
def test_halfway_between_frames_is_half_of_the_way_in_mujocos_sense(character):
    clip, steps = random_clip(character)
    halfway = clip.at(torch.tensor([0.05, 0.35], dtype=torch.float64))
    for frame, state in zip((0, 3), halfway, strict=True):
        expected = clip.qpos[frame].numpy().copy()
        mujoco.mj_integratePos(character_model(character), expected, steps[frame].numpy(), 0.5)
        np.testing.assert_allclose(state.abs().numpy(), np.abs(expected), atol=1e-9)


def test_a_clip_that_does_not_loop_is_held_at_its_ends():
    clip, _ = random_clip()
    states = clip.at(torch.tensor([-1.0, 0.0, clip.duration, clip.duration + 1]))
    torch.testing.assert_close(states, clip.qpos[[0, 0, -1, -1]])


def test_velocity_is_exact_where_it_is_constant_and_in_mujocos_convention():
    model = character_model("humanoid")
    velocity = np.random.default_rng(0).normal(size=model.nv)
    qpos = [model.qpos0.copy()]
    for _ in range(5):
        qpos.append(qpos[-1].copy())
        mujoco.mj_integratePos(model, qpos[-1], velocity, 0.1)
    clip = MotionClip("humanoid", torch.from_numpy(np.stack(qpos)), 10.0)
    velocities = clip.velocity(torch.linspace(0, clip.duration, 13))
    torch.testing.assert_close(velocities, torch.from_numpy(velocity).expand(13, -1))


def test_a_loop_walks_on_around_its_circle_forwards_and_backwards():
    times = torch.tensor([-1.5, 0.25, 1.0, 1.25, 2.5, 7.75], dtype=torch.float64)
    clip, angle = circling(), math.pi / 2 * times
    states = clip.at(times)
    torch.testing.assert_close(states[:, :2], 2 * torch.stack([angle.sin(), 1 - angle.cos()], -1), atol=2e-3, rtol=0)
    torch.testing.assert_close(about_z(heading(states[:, 3:7])).abs(), about_z(angle).abs())
    speed = 2 * math.pi / 2 * torch.stack([angle.cos(), angle.sin()], -1)
    torch.testing.assert_close(clip.velocity(times)[:, :2], speed, atol=1e-2, rtol=0)
    torch.testing.assert_close(clip.velocity(times)[:, 5], torch.full((6,), math.pi / 2, dtype=torch.float64))


def test_a_loop_accumulates_neither_height_nor_roll_and_pitch():
    clip = circling()
    tilted = clip.qpos.clone()
    tilted[-1, 2] += 0.1
    tilted[-1, 3:7] = torch.tensor([math.cos(0.1), math.sin(0.1), 0, 0])
    again = MotionClip("biped", tilted, clip.fps, loop=True).at(torch.tensor(10.0))
    torch.testing.assert_close(again[2:7], clip.qpos[0, 2:7], atol=1e-9, rtol=0)


@pytest.mark.parametrize("character", CHARACTERS)
def test_mirroring_twice_changes_no_bit(character):
    clip, _ = random_clip(character, loop=True)
    assert torch.equal(clip.mirrored().mirrored().qpos, clip.qpos)


@pytest.mark.parametrize("character", CHARACTERS)
def test_in_the_mirror_every_body_is_where_its_twin_was_with_y_reversed(character):
    clip, _ = random_clip(character)
    mirror, names = clip.mirrored(), body_names(character)
    positions = body_states(character, clip.qpos, clip.qvel).positions
    seen = body_states(character, mirror.qpos, mirror.qvel)
    twins = [names.index(twin(name)) for name in names]
    reverse = torch.tensor([1.0, -1.0, 1.0])
    torch.testing.assert_close(seen.positions, positions[:, twins] * reverse)
    velocities = body_states(character, clip.qpos, clip.qvel).linear_velocities
    torch.testing.assert_close(seen.linear_velocities, velocities[:, twins] * reverse)


def test_body_velocities_are_the_rates_of_change_of_positions():
    clip, _ = random_clip(frames=3, fps=1000.0)
    states = body_states("humanoid", clip.qpos[1:2], clip.qvel[1:2])
    shift = 1e-6
    model = character_model("humanoid")
    moved = clip.qpos[1].numpy().copy()
    mujoco.mj_integratePos(model, moved, clip.qvel[1].numpy(), shift)
    later = body_states("humanoid", torch.from_numpy(moved).unsqueeze(0), clip.qvel[1:2])
    rate = (later.positions - states.positions) / shift
    torch.testing.assert_close(states.linear_velocities, rate, atol=0.2, rtol=1e-3)


def test_resampling_keeps_the_frames_it_meets_and_the_duration():
    clip, _ = random_clip(fps=10.0)
    doubled = clip.resampled(20.0)
    torch.testing.assert_close(doubled.qpos[::2], clip.qpos)
    assert doubled.fps == 20.0
    assert clip.resampled(13.0).duration == pytest.approx(clip.duration)


def test_a_resampled_loop_still_repeats_after_its_cycle():
    clip = circling().resampled(33.0)
    assert clip.loop
    torch.testing.assert_close(clip.at(torch.tensor(4.0))[:2], torch.zeros(2, dtype=torch.float64), atol=1e-9, rtol=0)


def test_a_section_is_the_clip_between_two_times():
    clip, _ = random_clip()
    part = clip.section(0.15, 0.45)
    torch.testing.assert_close(part.qpos, clip.at(0.15 + 0.1 * torch.arange(4, dtype=torch.float64)))
    assert not part.loop


@pytest.mark.parametrize(("start", "stop"), [(-0.1, 0.3), (0.3, 0.3), (0.4, 0.2), (0.1, 9.0)])
def test_a_section_outside_of_the_clip_is_refused(start, stop):
    with pytest.raises(ValueError, match=r"must be a part of the clip: pass 0 <= start < stop <= 0\.6"):
        random_clip()[0].section(start, stop)


def test_clips_played_in_a_row_are_one_path():
    quarter = circling()
    whole = concatenated([quarter] * 4)
    assert whole.duration == pytest.approx(4.0)
    times = torch.linspace(0, 4, 37, dtype=torch.float64)
    torch.testing.assert_close(whole.at(times)[:, :3], quarter.at(times)[:, :3])
    assert not whole.loop


def test_only_clips_of_one_character_and_frame_rate_are_played_in_a_row():
    with pytest.raises(ValueError, match=r"biped at 20 fps.*humanoid at 10 fps"):
        concatenated([circling(), random_clip()[0]])
    with pytest.raises(ValueError, match="no kind"):
        concatenated([])


def test_signs_of_quaternions_do_not_matter_and_come_out_continuous():
    clip, _ = random_clip()
    flipped = clip.qpos.clone()
    flipped[1::2][:, clip.layout.quaternions] *= -1
    assert torch.equal(MotionClip("humanoid", flipped, clip.fps).qpos, clip.qpos)
    quaternions = clip.qpos[:, clip.layout.quaternions]
    assert (quaternions[0, :, 0] >= 0).all()
    assert ((quaternions[1:] * quaternions[:-1]).sum(-1) > 0).all()


def test_quaternions_are_normalised_and_the_given_tensor_stays_as_it_is():
    qpos = torch.from_numpy(character_model("biped").qpos0).repeat(2, 1)
    qpos[:, 3] = 1.7
    clip = MotionClip("biped", qpos, 30.0)
    assert clip.qpos[0, 3] == 1.0
    assert qpos[0, 3] == 1.7


@pytest.mark.parametrize("character", CHARACTERS)
def test_a_file_gives_back_every_bit(character, tmp_path):
    clip, _ = random_clip(character, fps=119.9, loop=True)
    clip.save(tmp_path / "clip.npz")
    loaded = MotionClip.load(tmp_path / "clip.npz")
    assert torch.equal(loaded.qpos, clip.qpos)
    assert (loaded.character, loaded.fps, loaded.loop) == (clip.character, clip.fps, clip.loop)


def edited(clip, folder, **changes):
    """The file of a clip with some of its arrays replaced, or left out where None."""
    file = folder / "clip.npz"
    clip.save(file)
    arrays = {**np.load(file), **changes}
    np.savez(file, **{name: array for name, array in arrays.items() if array is not None})
    return file


def test_a_file_with_other_joints_is_refused_by_name(tmp_path):
    clip, _ = random_clip()
    swapped = np.array(clip.layout.names)[::-1]
    with pytest.raises(ValueError, match=r"has the joints .'left_ankle'.*again"):
        MotionClip.load(edited(clip, tmp_path, joints=swapped))


def test_a_clip_of_a_character_that_is_not_known_asks_for_its_module(tmp_path):
    with pytest.raises(MotionFormatError, match=r"clip.npz: is a clip of character='lizard', .* --module") as caught:
        MotionClip.load(edited(random_clip()[0], tmp_path, character=np.array("lizard")))
    assert "no motion clip" not in str(caught.value)


def test_a_file_without_a_part_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"lacks \['fps'\]"):
        MotionClip.load(edited(random_clip()[0], tmp_path, fps=None))


def test_a_file_that_holds_pickled_objects_is_not_read(tmp_path):
    with pytest.raises(ValueError, match="allow_pickle"):
        MotionClip.load(edited(random_clip()[0], tmp_path, fps=np.array([print], dtype=object)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"qpos": torch.zeros(3, 5)}, r"qpos has shape \(3, 5\): pass \(T, 29\) with T >= 2"),
        ({"qpos": torch.zeros(1, 29)}, r"qpos has shape \(1, 29\)"),
        ({"qpos": torch.zeros(2, 29)}, "quaternion of length 0 in frame 0"),
        ({"qpos": torch.full((2, 29), torch.nan)}, "qpos is not finite in frame 0"),
        ({"fps": 0.0}, "fps=0.0"),
        ({"fps": math.nan}, "fps=nan"),
        ({"fps": math.inf}, "fps=inf"),
        ({"character": "dog"}, "character='dog' does not exist: pass one of"),
    ],
)
def test_what_is_no_clip_is_refused(change, message):
    arguments = {
        "character": "biped",
        "qpos": torch.from_numpy(character_model("biped").qpos0).repeat(2, 1),
        "fps": 30.0,
    }
    with pytest.raises(ValueError, match=message):
        MotionClip(**{**arguments, **change})


@pytest.mark.parametrize("character", CHARACTERS)
def test_the_layout_names_every_number_of_a_state_once(character):
    layout, model = joint_layout(character), character_model(character)
    known = torch.cat([torch.arange(3), layout.quaternions.flatten(), layout.angles]).sort().values
    assert known.tolist() == list(range(model.nq))
    rates = torch.cat([torch.arange(3), layout.spins.flatten(), layout.rates]).sort().values
    assert rates.tolist() == list(range(model.nv))


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_however_a_file_is_damaged_it_is_refused_by_name_with_the_remedy_or_read_as_it_was(tmp_path, save):
    clip, _ = random_clip()
    whole = edited(clip, tmp_path)
    save(whole, **np.load(whole))
    data, generator, refused = whole.read_bytes(), np.random.default_rng(0), []
    file = tmp_path / "damaged.npz"
    for kind in range(300):
        spoilt = bytearray(data)
        if kind % 3 == 0:
            del spoilt[generator.integers(len(data)) :]
        for position in generator.integers(0, len(spoilt) or 1, size=kind % 4 + 1 if spoilt else 0):
            spoilt[position] ^= 1 << generator.integers(8)
        file.write_bytes(spoilt)
        try:
            read = MotionClip.load(file)
        except MotionFormatError as error:
            refused.append(str(error))
        else:
            torch.testing.assert_close(read.qpos, clip.qpos, rtol=0, atol=0)
    assert len(refused) > 200
    assert all(str(file) in message and "torchrl-mcp-motions import" in message for message in refused)


def test_a_file_that_would_fill_the_memory_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    clip, _ = random_clip()
    bomb = edited(clip, tmp_path)
    with zipfile.ZipFile(bomb, "a", zipfile.ZIP_DEFLATED) as archive, archive.open("more.npy", "w") as member:
        for _ in range(300):
            member.write(bytes(2**20))
    monkeypatch.setattr(np, "load", lambda *arguments, **settings: pytest.fail("it was unpacked"))
    with pytest.raises(MotionFormatError, match="would unpack to"):
        MotionClip.load(bomb)


def test_a_loop_must_end_as_it_began():
    walk = stride("humanoid", 1.0, 0.0, strides=1)
    half = walk.qpos[: len(walk.qpos) // 2]
    assert not MotionClip("humanoid", half, walk.fps).loop
    with pytest.raises(ValueError, match=r"ends with a joint \d\.\d+ rad from where it began: pass loop=False"):
        MotionClip("humanoid", half, walk.fps, loop=True)
