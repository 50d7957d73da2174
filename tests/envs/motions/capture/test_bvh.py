from contextlib import suppress
from itertools import permutations

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.motions.capture import textfile
from torchrl_mcp.envs.motions.capture.bvh import read_bvh
from torchrl_mcp.envs.motions.errors import MotionFormatError

ARM = """\
HIERARCHY
ROOT shoulder
{
  OFFSET 0 10 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT elbow
  {
    OFFSET 0 -3 0
    CHANNELS 3 Yrotation Zrotation Xrotation
    End Site
    {
      OFFSET 1 -2 0.5
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0083333
1 2 3 10 20 30 40 50 60
4 5 6 70 80 90 -10 -20 -30
"""


@pytest.fixture
def write(tmp_path):
    def write(text, name="arm.bvh"):
        path = tmp_path / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    return write


def test_joints_are_where_rotation_matrices_put_them(write):
    motion = read_bvh(write(ARM))
    first = Rotation.from_euler("ZXY", [10, 20, 30], degrees=True)
    second = first * Rotation.from_euler("YZX", [40, 50, 60], degrees=True)
    elbow = np.array([1, 2, 3]) + first.apply([0, -3, 0])
    expected = np.array([[1, 2, 3], elbow, elbow + second.apply([1, -2, 0.5])])
    np.testing.assert_allclose(motion.poses().positions[0], expected, atol=1e-12)
    assert motion.names == ["shoulder", "elbow", "elbow_end"]
    assert motion.fps == pytest.approx(120, rel=1e-5)
    assert motion.unit is None


@pytest.mark.parametrize("order", list(permutations("XYZ")))
def test_rotations_are_done_in_the_order_of_the_channels(write, order):
    names = " ".join(f"{axis}rotation" for axis in order)
    motion = read_bvh(write(ARM.replace("Yrotation Zrotation Xrotation", names)))
    expected = Rotation.from_euler("".join(order), [[40, 50, 60], [-10, -20, -30]], degrees=True)
    found = Rotation.from_quat(motion.rotations[:, 1], scalar_first=True)
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-12)


def test_a_joint_may_turn_about_some_axes_only(write):
    text = ARM.replace("3 Yrotation Zrotation Xrotation", "1 Zrotation").replace("40 50 60", "40")
    motion = read_bvh(write(text.replace("-10 -20 -30", "-10")))
    found = Rotation.from_quat(motion.rotations[:, 1], scalar_first=True).as_rotvec(degrees=True)
    np.testing.assert_allclose(found, [[0, 0, 40], [0, 0, -10]], atol=1e-12)


def test_position_channels_of_any_joint_take_the_place_of_its_offset(write):
    text = ARM.replace("3 Yrotation Zrotation Xrotation", "3 Yposition Zrotation Xposition")
    motion = read_bvh(write(text))
    assert motion.translations[:, 1].tolist() == [[60, 40, 0], [-30, -10, 0]]
    assert motion.translations[:, 0].tolist() == [[1, 2, 3], [4, 5, 6]]


def test_the_rest_pose_is_not_turned(write):
    still = ARM.replace("1 2 3 10", "0 10 0 10").replace("4 5 6 70", "0 10 0 70")
    rest = read_bvh(write(still)).rest
    assert rest.positions.tolist() == [[0, 10, 0], [0, 7, 0], [1, 5, 0.5]]
    assert rest.rotations.tolist() == [[1, 0, 0, 0]] * 3


@pytest.mark.parametrize(
    "edit",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "\r"),
        lambda text: text.replace("  ", "\t").replace("Frames: 2", "Frames:\t2"),
        lambda text: text.replace("\n{", " {"),
        lambda text: text.replace("\n", "\n\n"),
        lambda text: text.replace("Frames: 2", "FRAMES : 2").replace("0.0083333", ".0083333"),
        lambda text: text.lower().replace("root ", "Root "),
        lambda text: "\ufeff" + text,
        lambda text: text.rstrip("\n"),
        lambda text: text.replace("End Site\n    {\n      OFFSET 1 -2 0.5\n    }\n", ""),
    ],
    ids=[
        "CRLF",
        "CR",
        "tabs",
        "braces",
        "blank lines",
        "headers",
        "lower case",
        "BOM",
        "no last newline",
        "no end site",
    ],
)
def test_the_layout_of_the_text_does_not_matter(write, edit):
    plain, edited = read_bvh(write(ARM)), read_bvh(write(edit(ARM), "edited.bvh"))
    assert torch.equal(edited.translations[:, :2], plain.translations[:, :2])
    assert torch.equal(edited.rotations[:, :2], plain.rotations[:, :2])
    assert edited.fps == plain.fps


def test_names_may_have_blanks_and_the_line_of_every_frame_is_known(write):
    motion = read_bvh(write(ARM.replace("JOINT elbow", "JOINT Left Elbow")))
    assert motion.names[1] == "Left Elbow"
    assert list(motion.lines) == [19, 20]


def test_the_frame_rate_of_the_user_wins(write):
    assert read_bvh(write(ARM), fps=60.0).fps == 60.0
    with pytest.raises(ValueError, match="fps=0"):
        read_bvh(write(ARM), fps=0.0)


WRONG = {
    "empty": ("", "", 1, "does not begin with HIERARCHY"),
    "not BVH": ("HIERARCHY", "ROOT", 1, "does not begin with HIERARCHY"),
    "second root": ("JOINT elbow", "ROOT elbow", 6, "no other, is the ROOT"),
    "no root": ("ROOT shoulder", "JOINT shoulder", 2, "is the ROOT"),
    "no name": ("JOINT elbow", "JOINT", 6, "without a name"),
    "no brace": ("elbow\n  {", "elbow\n", 6, "no { follows the name 'elbow'"),
    "brace too many": ("  }\n}", "  }\n}\n}", 16, "does not belong here"),
    "brace too few": ("  }\n}", "  }", 2, "before its braces are closed"),
    "joint outside": ("  }\n}", "  }\n}\nEND Site\n{", 16, "outside of the root"),
    "no offset": ("    OFFSET 0 -3 0\n", "", 6, "'elbow' has no OFFSET"),
    "short offset": ("OFFSET 0 -3 0", "OFFSET 0 -3", 8, "2 words after it, but should have 3"),
    "wrong offset": ("OFFSET 0 -3 0", "OFFSET 0 -3 O", 8, "'O' is not a number"),
    "unknown keyword": ("OFFSET 0 -3 0", "SCALE 0 -3 0", 8, "'SCALE' does not belong here"),
    "unknown channel": ("Yrotation Z", "Yrotatoin Z", 9, "CHANNELS is not followed by"),
    "channel count": ("3 Yrotation", "4 Yrotation", 9, "CHANNELS is not followed by"),
    "absurd channel count": ("3 Yrotation", "1e9 Yrotation", 9, "CHANNELS is not followed by"),
    "channel twice": ("3 Yrotation Z", "3 Zrotation Z", 9, "a channel twice"),
    "no motion": (ARM[ARM.index("MOTION") :], "", 16, "has no 'Frames:'"),
    "no time": (ARM[ARM.index("Frame Time") :], "", 18, "has no 'Frame Time:'"),
    "wrong header": ("Frame Time:", "Frame Rate:", 18, "should be 'Frame Time:'"),
    "zero time": ("0.0083333", "0", 18, "Frame Time is 0 s"),
    "negative time": ("0.0083333", "-0.1", 18, "Frame Time is -0.1 s"),
    "rate for time": ("0.0083333", "120", 18, "Frame Time is 120 s"),
    "more frames than rows": ("Frames: 2", "Frames: 3", 17, "3 frames are declared, 2 follow"),
    "fewer frames than rows": ("Frames: 2", "Frames: 1", 17, "1 frames are declared, 2 follow"),
    "frames without end": ("Frames: 2", "Frames: 1000000000000", 17, "is absurdly large"),
    "many frames": ("Frames: 2", "Frames: 9999999", 17, "frames are declared, 2 follow"),
    "fraction of a frame": ("Frames: 2", "Frames: 2.5", 17, "2.5 frames are declared"),
    "one frame": ("Frames: 2", "Frames: 1", 17, "1 frames are declared"),
    "truncated row": ("70 80 90 -10 -20 -30\n", "70 80 9", 20, "has 6 numbers, but the skeleton has 9 channels"),
    "long row": ("40 50 60", "40 50 60 70", 19, "has 10 numbers"),
    "word in a row": ("40 50 60", "40 fifty 60", 19, "'fifty' is not a number"),
    "NaN": ("40 50 60", "40 nan 60", 19, "'nan' is not finite"),
    "infinity": ("40 50 60", "40 1e999 60", 19, "'1e999' is not finite"),
    "absurd number": ("40 50 60", "40 1e300 60", 19, "'1e300' is absurdly large"),
    "long word": ("40 50 60", f"40 {'9' * 5000} 60", 19, "'99999999999.*' is "),
}


@pytest.mark.parametrize(("old", "new", "line", "message"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_with_file_and_line(write, old, new, line, message):
    text = ARM.replace(old, new, 1) if old else new
    assert text != ARM
    path = write(text)
    with pytest.raises(MotionFormatError, match=message) as caught:
        read_bvh(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
    assert len(str(caught.value)) < 300 + len(str(path))


def test_a_file_that_cannot_be_opened_is_named(tmp_path):
    for path in (tmp_path, tmp_path / "nowhere.bvh"):
        with pytest.raises(MotionFormatError, match=f"{path.name}.*cannot be read"):
            read_bvh(path)


def test_a_file_too_large_to_be_a_motion_is_not_read_whole(write, monkeypatch):
    monkeypatch.setattr(textfile, "LARGEST_FILE", 2**20)
    with pytest.raises(MotionFormatError, match="larger than 1 MiB: split it"):
        read_bvh(write(b" " * (2**20 + 1)))


def test_joints_without_channels_cannot_fill_the_memory(write):
    joints = "JOINT j\n{\nOFFSET 0 0 0\n}\n" * 900
    text = ARM.replace("End Site", joints + "End Site").replace("Frames: 2", "Frames: 6000")
    rows = "1 2 3 4 5 6 7 8 9\n" * 6000
    with pytest.raises(MotionFormatError, match="has 6000 frames of 903 joints, which is more than"):
        read_bvh(write(text[: text.index("1 2 3 10")] + rows))
    with pytest.raises(MotionFormatError, match="has more than 1000 joints"):
        read_bvh(write(ARM.replace("End Site", joints * 2 + "End Site")))


@given(st.binary(max_size=200))
def test_no_bytes_raise_another_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "fuzz.bvh"
    path.write_bytes(b"HIERARCHY\n" + content)
    with pytest.raises(MotionFormatError):
        read_bvh(path)


WORDS = st.sampled_from([*"{}:", "ROOT", "JOINT", "End", "OFFSET", "CHANNELS", "MOTION", "0", "nan", "1e9", "", "\n"])


@given(st.lists(st.tuples(st.integers(0, 10**6), WORDS | st.text(max_size=3)), min_size=1, max_size=4))
def test_no_damage_raises_another_error(tmp_path_factory, damages):
    words = ARM.replace("\n", " \n ").split(" ")
    for place, word in damages:
        words[place % len(words)] = word
    path = tmp_path_factory.getbasetemp() / "damaged.bvh"
    path.write_text(" ".join(words), encoding="utf-8", errors="replace")
    with suppress(MotionFormatError):
        read_bvh(path).poses()
