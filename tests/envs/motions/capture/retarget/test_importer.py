"""Importing a file: its rate and which frames, and what of files and options is refused."""

import math
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.importer import import_motion, imported
from torchrl_mcp.envs.motions.errors import MotionFormatError


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joint_map": {"left_knee": "Nowhere"}}, r"motion\.bvh: has no joint 'Nowhere': its joints are Hips"),
        ({"joint_map": {"tail": "Hips"}}, "joint_map has tail: the parts of the body are root, chest"),
        ({"joint_map": {"left_wrist": "LeftForeArm"}}, r"motion\.bvh:\d+: left_elbow and left_wrist come closer"),
        ({"scale": 0}, "scale=0 must be a unit"),
        ({"scale": float("nan")}, "scale=nan must be a unit"),
        ({"rate": -1}, "rate=-1 leaves less than two frames"),
        ({"skip": 3}, "skip=3 leaves less than two frames of 4"),
        ({"skip": -1}, "skip=-1 leaves"),
        ({"rest_frame": 4}, r"rest_frame=4 does not exist: pass one of 0\.\.3"),
        ({"bodies": {"chest": "chest"}}, "bodies do not apply to character=humanoid, whose parts are known"),
    ],
)
def test_arguments_out_of_range_are_named(load, options, message):
    options = dict(options)
    with pytest.raises(ValueError, match=message):
        load([{}] * 4, options.pop("character", "humanoid"), options=options)


def test_a_t_pose_before_the_motion_is_found_by_its_jump_and_can_be_left_out(load, arms_down, bvh):
    poses, path = [{}, arms_down(), arms_down()], [(0, 0, 0), (3, 0.9, 1), (3, 0.9, 1.01)]
    header = bvh(poses, path=path).splitlines().index("Frame Time: 0.03333333333333333") + 1
    with pytest.raises(
        MotionFormatError, match=rf"motion\.bvh:{header + 2}: root jumps between frames 1 and 2.*T-pose"
    ):
        load(poses, path=path)
    clip = load(poses, path=path, options={"skip": 1})
    assert clip.duration == pytest.approx(1 / 30)


def test_a_t_pose_in_place_is_found_by_the_arms(load, arms_down):
    with pytest.raises(MotionFormatError, match="right_elbow jumps between frames 1 and 2"):
        load([{}, arms_down(), arms_down()], fps=120.0)


def test_a_jump_later_on_is_named_by_its_line(load):
    path = [(0, 0.9, 0)] * 5 + [(4, 0.9, 0)] * 5
    with pytest.raises(MotionFormatError, match=r":\d+: root jumps between frames 5 and 6, .*: cut the file there"):
        load([{}] * 10, path=path)


def test_the_clip_has_the_rate_asked_for(load, hinge, about):
    poses = [{"LeftLeg": about([1, 0, 0], degrees)} for degrees in range(0, 61, 10)]
    clip = load(poses, fps=60.0, options={"rate": 40.0})
    assert (clip.fps, len(clip.qpos), clip.loop) == (40.0, 5, False)
    np.testing.assert_allclose(hinge(clip, "left_knee"), -np.radians([0, 15, 30, 45, 60]), atol=1e-7)


def test_the_frame_rate_of_the_user_wins(load):
    assert load([{}] * 11, fps=60.0, options={"fps": 10.0}).duration == pytest.approx(1.0)


@pytest.mark.parametrize("time", ["0", "33.3", "-1", "nan", "thirty"])
def test_the_frame_rate_of_the_user_wins_over_a_frame_time_that_is_none(bvh, tmp_path, time):
    path = tmp_path / "motion.bvh"
    path.write_text(bvh([{}] * 11).replace(f"Frame Time: {1 / 30!r}", f"Frame Time: {time}"))
    with pytest.raises(MotionFormatError, match=r"motion\.bvh:\d+: .*"):
        import_motion(path, "humanoid")
    assert import_motion(path, "humanoid", fps=10.0).duration == pytest.approx(1.0)


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0, 120.0, 240.0])
def test_a_motion_lasts_as_long_at_any_frame_rate(load, hinge, about, fps):
    poses = [{"LeftLeg": about([1, 0, 0], 60 * frame / fps)} for frame in range(round(fps) + 1)]
    clip = load(poses, fps=fps)
    np.testing.assert_allclose(hinge(clip, "left_knee"), -np.radians(np.linspace(0, 60, 31)), atol=1e-6)


NECK = math.degrees(character_model("humanoid").joint("neck").range[1])
"""Angle up to which the head can turn."""


def test_a_head_turned_too_far_in_most_frames_is_refused_with_their_share(load, about):
    poses = [{"Head": about([0, 1, 0], NECK + 50 if frame < 7 else 0)} for frame in range(10)]
    with pytest.raises(MotionFormatError, match=r"motion\.bvh: in 70 % of its frames .* 30 degrees, and by up to 50: "):
        load(poses, fps=1.0)


def test_what_limits_cut_is_measured_in_each_frame(bvh, tmp_path, about):
    path = tmp_path / "motion.bvh"
    beyond = [-20, 8, 0, 25, 40]
    path.write_text(bvh([{"Head": about([0, 1, 0], NECK + degrees)} for degrees in beyond], fps=2.0))
    np.testing.assert_allclose(imported(path, "humanoid").cut, [0, 8, 0, 25, 40], atol=1e-6)


@pytest.mark.parametrize("name", ["motion.fbx", "motion", "motion.asf"])
def test_a_file_of_another_kind_is_refused(tmp_path, name):
    (tmp_path / name).write_text("?")
    with pytest.raises(MotionFormatError, match=r"must end in \.bvh"):
        import_motion(tmp_path / name, "humanoid")


@pytest.mark.parametrize("option", [{"scale": 1.0}, {"skip": 1}, {"rest_frame": 0}, {"joint_map": {"neck": "x"}}])
def test_options_without_meaning_for_files_of_deepmimic_are_refused(tmp_path, option):
    with pytest.raises(ValueError, match=f"{next(iter(option))} does not apply to .*motion.txt"):
        import_motion(tmp_path / "motion.txt", "humanoid", **option)


VALUES = st.floats(-1e7, 1e7) | st.floats(-180, 180) | st.sampled_from([0.0, 90.0, 180.0])


@pytest.fixture(scope="module")
def some_motion(bvh, any_pose):
    return bvh([{}, any_pose, {}], fps=2.0)


@settings(max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 10**6), VALUES), max_size=8), st.sampled_from([None, 0, 1]))
def test_no_numbers_raise_another_error(tmp_path_factory, some_motion, changes, rest_frame):
    words = some_motion.replace("\n", " \n ").split(" ")
    numbers = [place for place, word in enumerate(words) if "." in word]
    for place, value in changes:
        words[numbers[place % len(numbers)]] = repr(value)
    path = tmp_path_factory.getbasetemp() / "any.bvh"
    path.write_text(" ".join(words))
    with suppress(MotionFormatError):
        import_motion(path, "humanoid", rest_frame=rest_frame)
