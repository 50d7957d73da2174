import math
from contextlib import suppress

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.motions.capture import textfile
from torchrl_mcp.envs.motions.capture.amc import read_asf_amc
from torchrl_mcp.envs.motions.capture.asf import read_asf
from torchrl_mcp.envs.motions.errors import MotionFormatError

ASF = """\
# a comment
:version 1.10
:name test
:units
  mass 1.0
  length 0.45
  angle deg
:documentation
  begin and end mean nothing here
:root
  order TX TY TZ RX RY RZ
  axis XYZ
  position 7 8 9
  orientation 0 0 0
:bonedata
  begin
    id 1
    name upper
    direction 0.6 -0.8 0
    length 5
    axis 10 20 30 XYZ
    dof rx ry rz
    limits (-160.0 20.0)
           (-70.0 70.0)
           (-60.0 70.0)
  end
  begin
    id 2
    name lower
    direction 0 -1 0
    length 4
    axis 40 0 -20 ZYX
    dof rx
  end
  begin
    id 3
    name fixed
    direction 0 0 1
    length 1
    axis 0 0 0 XYZ
  end
:hierarchy
  begin
    root upper
    upper lower fixed
  end
"""

AMC = """\
#!OML:ASF test.asf
:FULLY-SPECIFIED
:DEGREES
1
root 1 2 3 10 20 30
upper 40 50 60
lower 70
2
root 4 5 6 0 0 90
upper 0 0 0
lower -15
"""


@pytest.fixture
def write(tmp_path):
    """Write a pair of files; return the motion's path."""

    def write(asf=ASF, amc=AMC):
        (tmp_path / "01.asf").write_bytes(asf.encode())
        path = tmp_path / "01_05.amc"
        path.write_bytes(amc.encode())
        return path

    return write


def turned(axes, angles):
    """C Rz Ry Rx C^-1 in matrices; small letters make SciPy turn about fixed axes."""
    return axes * Rotation.from_euler("xyz", angles, degrees=True) * axes.inv()


def test_bones_are_where_rotation_matrices_put_them(write):
    motion = read_asf_amc(write())
    root = Rotation.from_euler("xyz", [10, 20, 30], degrees=True)
    upper = root * turned(Rotation.from_euler("xyz", [10, 20, 30], degrees=True), [40, 50, 60])
    lower = upper * turned(Rotation.from_euler("zyx", [-20, 0, 40], degrees=True), [70, 0, 0])
    start = np.array([1, 2, 3])
    knee = start + upper.apply([3, -4, 0])
    expected = [start, start, knee, knee, knee + lower.apply([0, -4, 0]), knee + upper.apply([0, 0, 1])]
    np.testing.assert_allclose(motion.poses().positions[0], expected, atol=1e-12)
    assert motion.names == ["root", "upper", "lower", "fixed", "lower_end", "fixed_end"]


def test_the_rest_pose_shows_the_directions_and_lengths_of_the_skeleton(write):
    rest = read_asf_amc(write()).rest.positions
    expected = [[0, 0, 0], [0, 0, 0], [3, -4, 0], [3, -4, 0], [3, -8, 0], [3, -4, 1]]
    np.testing.assert_allclose(rest - rest[0], expected, atol=1e-12)


def test_the_unit_is_an_inch_divided_by_the_length_and_the_rate_is_120(write):
    motion = read_asf_amc(write())
    assert motion.unit == pytest.approx(0.056444, abs=1e-6)
    assert motion.fps == 120.0
    assert read_asf_amc(write(), fps=60.0).fps == 60.0
    assert list(motion.lines) == [4, 8]


def test_a_bone_that_is_absent_is_not_turned(write):
    motion = read_asf_amc(write(amc=AMC.replace("upper 40 50 60\n", "").replace("upper 0 0 0\n", "")))
    np.testing.assert_allclose(motion.rotations[:, 1], [[1, 0, 0, 0]] * 2, atol=1e-15)


def test_the_root_stays_where_the_skeleton_has_it_if_it_has_no_channel_to_move(write):
    text = ASF.replace("order TX TY TZ RX RY RZ", "order TX RY")
    motion = read_asf_amc(write(text, AMC.replace("1 2 3 10 20 30", "1 20").replace("4 5 6 0 0 90", "4 90")))
    assert motion.translations[:, 0].tolist() == [[1, 8, 9], [4, 8, 9]]


@pytest.mark.parametrize("where", ["skeleton", "motion"])
def test_angles_in_radians_are_understood(write, where):
    def in_radians(text, *angles):
        for angle in angles:
            text = text.replace(angle, " " + " ".join(str(math.radians(float(number))) for number in angle.split()))
        return text

    amc = in_radians(AMC, "10 20 30", "0 0 90", "40 50 60", " 70", "-15")
    if where == "skeleton":
        asf = in_radians(ASF, "10 20 30", "40 0 -20").replace("angle deg", "angle rad")
        amc = amc.replace(":DEGREES\n", "")
    else:
        asf, amc = ASF, amc.replace(":DEGREES", ":RADIANS")
    radians = read_asf_amc(write(asf, amc)).poses()
    torch.testing.assert_close(radians.positions, read_asf_amc(write()).poses().positions, rtol=0, atol=1e-12)


@pytest.mark.parametrize("newline", ["\r\n", "\r"])
def test_line_endings_and_tabs_do_not_matter(write, newline):
    plain = read_asf_amc(write()).poses()
    found = read_asf_amc(write(ASF.replace("\n", newline), AMC.replace(" ", "\t").replace("\n", newline))).poses()
    assert torch.equal(found.positions, plain.positions)


def test_the_skeleton_may_be_named_or_the_only_one_in_the_folder(write):
    path = write()
    named = read_asf_amc(path, asf=path.with_name("01.asf"))
    path.with_name("01.asf").rename(path.with_name("body.asf"))
    assert torch.equal(read_asf_amc(path).rotations, named.rotations)
    path.with_name("other.asf").write_text(ASF)
    with pytest.raises(MotionFormatError, match=r"01_05\.amc: its skeleton 01\.asf must be beside it"):
        read_asf_amc(path)


WRONG_SKELETON = {
    "not ASF": (ASF, "hello", None, "has no section :bonedata, :hierarchy, :root"),
    "no hierarchy": (":hierarchy", ":hierarchi", None, "has no section :hierarchy"),
    "no unit": ("length 0.45", "length", 6, "'length' has 0 words after it, but should have 1"),
    "zero unit": ("length 0.45", "length 0", 6, "is too small"),
    "unit of angles": ("angle deg", "angle grad", 7, "must be deg or rad"),
    "root channel": ("TX TY TZ RX", "TX TY TZ QX", 11, "channels other than tx ty tz rx ry rz"),
    "root axis": ("axis XYZ", "axis XXZ", 12, "order of the axes"),
    "root position": ("position 7 8 9", "position 7 8", 13, "should have 3"),
    "no name": ("    name lower\n", "", 33, "a bone has no name"),
    "no direction": ("    direction 0 -1 0\n", "", 33, "a bone has no direction"),
    "zero direction": ("direction 0 -1 0", "direction 0 0 0", 30, "the direction has length 0"),
    "NaN": ("direction 0 -1 0", "direction 0 nan 0", 30, "'nan' is not finite"),
    "length": ("length 4", "length four", 31, "'four' is not a number"),
    "axis without order": ("40 0 -20 ZYX", "40 0 -20", 32, "order of the axes"),
    "short axis": ("40 0 -20 ZYX", "40 0 ZYX", 32, "'ZYX' is not a number"),
    "channel twice": ("dof rx\n", "dof rx rx\n", 33, "each at most once"),
    "length channel": ("dof rx\n", "dof rx l\n", 33, "not supported"),
    "bone twice": ("name lower", "name upper", 34, "a second bone 'upper'"),
    "bone named root": ("name lower", "name root", 34, "a second bone 'root'"),
    "no end": ("  end\n:hierarchy", ":hierarchy", 40, "no 'end'"),
    "unknown child": ("upper lower fixed", "upper lower fixt", 45, "'fixt' is not a bone"),
    "child twice": ("upper lower fixed", "upper lower lower", 45, "'lower' is not a bone, or is attached to two"),
    "its own parent": ("root upper", "upper upper", 44, "'upper' is not attached to a bone yet"),
    "loose": ("upper lower fixed", "upper lower", None, "'fixed' is not attached to a bone"),
}

WRONG_MOTION = {
    "empty": (AMC, "", None, "holds fewer than two frames"),
    "one frame": (AMC[AMC.index("2\nroot 4") :], "", None, "holds fewer than two frames"),
    "no frame number": ("1\nroot", "root", 4, "'root' is before the first frame"),
    "frame left out": ("2\nroot", "3\nroot", 8, "this is frame 3, but should be 2"),
    "absurd frame": ("2\nroot", "99999999\nroot", 8, "is absurdly large"),
    "unknown bone": ("lower 70", "lowre 70", 7, r"'lowre' occurs twice, or is not a bone of 01\.asf"),
    "bone twice": ("lower 70", "upper 1 2 3", 7, "'upper' occurs twice"),
    "truncated row": ("upper 40 50 60", "upper 40 50", 6, "upper has 2 numbers, but 3 channels"),
    "long row": ("lower 70", "lower 70 80", 7, "lower has 2 numbers, but 1 channels"),
    "channels of a fixed bone": ("lower 70", "fixed 70", 7, "fixed has 1 numbers, but 0 channels"),
    "word": ("lower 70", "lower x", 7, "'x' is not a number"),
    "infinity": ("lower 70", "lower inf", 7, "'inf' is not finite"),
    "absurd number": ("lower 70", "lower -7e70", 7, "is absurdly large"),
    "no root": ("root 4 5 6 0 0 90\n", "", 8, "the frame lacks the root"),
    "truncated frame": ("lower -15\n", "", 8, "other bones than the first: the file is cut short"),
}


@pytest.mark.parametrize(("old", "new", "line", "message"), WRONG_SKELETON.values(), ids=WRONG_SKELETON)
def test_what_is_wrong_with_a_skeleton_is_said_with_file_and_line(write, old, new, line, message):
    assert old in ASF
    path = write(asf=ASF.replace(old, new, 1))
    with pytest.raises(MotionFormatError, match=message) as caught:
        read_asf_amc(path)
    place = path.with_name("01.asf") if line is None else f"{path.with_name('01.asf')}:{line}"
    assert str(caught.value).startswith(f"{place}: ")


@pytest.mark.parametrize(("old", "new", "line", "message"), WRONG_MOTION.values(), ids=WRONG_MOTION)
def test_what_is_wrong_with_a_motion_is_said_with_file_and_line(write, old, new, line, message):
    assert old in AMC
    path = write(amc=AMC.replace(old, new, 1))
    with pytest.raises(MotionFormatError, match=message) as caught:
        read_asf_amc(path)
    assert str(caught.value).startswith(f"{path}: " if line is None else f"{path}:{line}: ")


def test_frames_that_mention_few_bones_cannot_fill_the_memory(write, monkeypatch):
    monkeypatch.setattr(textfile, "LARGEST_MOTION", 6 * 1000)
    frames = "".join(f"{number}\nroot 0 0 0 0 0 0\n" for number in range(1, 1002))
    with pytest.raises(MotionFormatError, match="has 1001 frames of 6 joints, which is more than 6000"):
        read_asf_amc(write(amc=frames))


def test_a_skeleton_of_absurdly_many_bones_is_refused(write):
    bones = "".join(f"begin\nname b{i}\ndirection 0 1 0\nlength 1\nend\n" for i in range(1001))
    children = " ".join(f"b{i}" for i in range(1001))
    text = ASF.replace(":hierarchy\n", f"{bones}:hierarchy\n").replace("root upper", f"root upper {children}")
    with pytest.raises(MotionFormatError, match="more than 1000 joints"):
        read_asf(write(asf=text).with_name("01.asf"))


DAMAGE = st.lists(
    st.tuples(
        st.integers(0, 10**6),
        st.sampled_from(["begin", "end", ":root", "root", "dof", "0", "nan", "1e9", "upper", "", "\n"])
        | st.text(max_size=3),
    ),
    min_size=1,
    max_size=4,
)


@given(st.sampled_from(["01.asf", "01_05.amc"]), DAMAGE)
def test_no_damage_raises_another_error(tmp_path_factory, name, damages):
    folder = tmp_path_factory.getbasetemp()
    texts = {"01.asf": ASF, "01_05.amc": AMC}
    words = texts[name].replace("\n", " \n ").split(" ")
    for place, word in damages:
        words[place % len(words)] = word
    for file, text in {**texts, name: " ".join(words)}.items():
        (folder / file).write_text(text, encoding="utf-8", errors="replace")
    with suppress(MotionFormatError):
        read_asf_amc(folder / "01_05.amc").poses()
