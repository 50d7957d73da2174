"""Clips of this library as files to import: of the same character, and of another one."""

import pytest
import torch

from torchrl_mcp.envs.motions import turning_clips
from torchrl_mcp.envs.motions.capture.importer import import_motion
from torchrl_mcp.envs.motions.inspection.summary import summarised


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A humanoid's walk in a curve, which loops."""
    path = tmp_path_factory.mktemp("clips") / "left.npz"
    turning_clips("humanoid")["left_sharp"].save(path)
    return path


def test_a_clip_of_the_same_character_keeps_its_loop_and_has_the_frame_rate_asked_for(file):
    clip = turning_clips("humanoid")["left_sharp"]
    found = import_motion(file, "humanoid", rate=120.0)
    assert found.loop
    assert found.fps == pytest.approx(120, rel=0.01)
    times = torch.linspace(0, 3 * clip.duration, 20, dtype=torch.float64)
    torch.testing.assert_close(found.at(times), clip.at(times), atol=2e-3, rtol=0)


@pytest.mark.parametrize("rate", [0.0, -5.0, 0.01, 1e9])
def test_a_rate_that_leaves_no_frames_is_refused(file, rate):
    with pytest.raises(ValueError, match=rf"rate={rate} leaves less than two frames of"):
        import_motion(file, "humanoid", rate=rate)


def test_frames_are_left_out_at_its_beginning(file):
    clip = turning_clips("humanoid")["left_sharp"]
    found = import_motion(file, "humanoid", rate=clip.fps, skip=5)
    assert not found.loop
    torch.testing.assert_close(found.qpos, clip.qpos[5:], atol=1e-9, rtol=0)


def test_a_clip_of_which_no_two_frames_remain_is_refused(file):
    frames = len(turning_clips("humanoid")["left_sharp"].qpos)
    assert len(import_motion(file, "humanoid", rate=30.0, skip=frames - 2).qpos) >= 2
    with pytest.raises(ValueError, match=rf"skip={frames - 1} leaves less than two frames of {frames}"):
        import_motion(file, "humanoid", skip=frames - 1)


@pytest.mark.parametrize("options", [{"fps": 10.0}, {"joint_map": {"left_knee": "shin"}}])
def test_options_that_would_change_nothing_are_refused(file, options):
    with pytest.raises(ValueError, match=r"leave (it|the map) out"):
        import_motion(file, "humanoid", **options)


def test_a_loop_in_a_curve_stays_one_for_another_character(file):
    clip, found = turning_clips("humanoid")["left_sharp"], import_motion(file, "biped", rate=60.0)
    assert found.loop
    torch.testing.assert_close(found.qpos[-1, 7:].abs(), found.qpos[0, 7:].abs(), atol=1e-6, rtol=0)
    torch.testing.assert_close(found.qpos[-1, 2], found.qpos[0, 2], atol=1e-6, rtol=0)
    assert float(found.cycle.turn) == pytest.approx(float(clip.cycle.turn), abs=0.05)
    assert summarised(found).turn_rate == pytest.approx(summarised(clip).turn_rate, rel=0.2)
    assert not import_motion(file, "biped", skip=5).loop
