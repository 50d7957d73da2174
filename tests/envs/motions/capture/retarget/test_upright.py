"""Who stands in the recording stands in the clip, whatever constant rotation lies between rest pose and motion."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.errors import MotionFormatError

pytestmark = pytest.mark.filterwarnings("ignore:Gimbal lock")

QUARTERS = Rotation.create_group("O").as_rotvec()
"""The 24 rotations that exchange axes."""

BUILT = 1.5
"""Degrees by which the body, as it is built, may seem to lean: its trunk does by 2.2, its legs do not."""


def oblique():
    """Rotations that take the vertical 15 degrees or more away from any axis."""
    random = Rotation.random(30, random_state=0)
    tilt = np.degrees(np.arccos(np.abs(random.inv().apply([0, 1, 0])).max(-1)))
    return random[tilt > 15].as_rotvec()


@pytest.fixture
def turned(bvh, skeleton, tmp_path):
    """Write poses of a body whose rest pose is turned by a constant rotation, which the motion undoes."""

    def turned(poses, rotation, **layout):
        path = tmp_path / "motion.bvh"
        path.write_text(bvh(poses, frames={name: rotation for name, _, _ in skeleton}, **layout))
        return path

    return turned


def joints_and_tilt(clip):
    """All but the heading: joints, and the direction of the vertical in the root's frame."""
    root = Rotation.from_quat(clip.qpos[:, 3:7], scalar_first=True)
    return clip.qpos[:, 7:].numpy(), root.inv().apply([0, 0, 1])


@pytest.mark.parametrize("rotation", QUARTERS, ids=str)
def test_a_constant_rotation_by_right_angles_changes_nothing_but_the_heading(
    turned, load, rotation, any_pose, arms_down
):
    poses = [arms_down(), any_pose, any_pose]
    expected = joints_and_tilt(load(poses, fps=5.0))
    found = imported(turned(poses, Rotation.from_rotvec(rotation), fps=5.0), "humanoid")
    for a, b in zip(joints_and_tilt(found.clip), expected, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-7)
    moved = not np.allclose(Rotation.from_rotvec(rotation).apply([0, 1, 0]), [0, 1, 0])
    assert ("y points up, and the rest pose is turned by" in found.assumed) is moved


@pytest.mark.parametrize("rotation", oblique(), ids=str)
def test_the_head_of_a_standing_body_is_above_its_feet_whatever_the_rotation(turned, rotation, arms_down, kinematics):
    found = imported(turned([arms_down()] * 3, Rotation.from_rotvec(rotation)), "humanoid")
    places, _ = kinematics(found.clip)
    standing = places["neck"] - (places["left_ankle"] + places["right_ankle"]) / 2
    height = (
        0.881416 - 0.05 + 0.236151 + 0.223894
    )  # the root above the ankles, the chest above the root, the neck above the chest
    assert standing[2] == pytest.approx(height, rel=0.01)
    assert np.degrees(np.arccos(standing[2] / np.linalg.norm(standing))) < BUILT
    np.testing.assert_allclose(found.clip.qpos[0, 7:], character_model("humanoid").qpos0[7:], atol=np.radians(BUILT))
    assert "y points up, and the rest pose is turned by" in found.assumed


def test_what_is_as_the_rest_pose_says_is_not_assumed(load, bvh, tmp_path, any_pose):
    (tmp_path / "motion.bvh").write_text(bvh([{}, any_pose], fps=2.0))
    assert imported(tmp_path / "motion.bvh", "humanoid").assumed == ""


LYING = "its body does not stand in any frame if y points up, and other axes are no better"


def test_a_body_that_lies_all_the_time_needs_to_be_told_which_axis_points_up(load, about, kinematics):
    poses = [{"Hips": about([1, 0, 0], -90)}] * 3
    path = [(0, 0.1, -2.0)] * 3
    with pytest.raises(MotionFormatError, match=rf"motion\.bvh: {LYING}: .* --up y"):
        load(poses, path=path)
    places, _ = kinematics(load(poses, path=path, options={"up": "y"}))
    assert abs(places["neck"][2] - places["left_ankle"][2]) < 0.02


def test_the_axis_that_the_user_says_wins(load, kinematics):
    places, _ = kinematics(load([{}] * 2, options={"up": "z"}))
    assert abs(places["neck"][2] - places["left_ankle"][2]) < 0.02  # stands along y, so it lies if z points up


def test_the_frame_that_the_user_says_stands_wins(load, about, kinematics):
    poses = [{"Hips": about([1, 0, 0], -90)}] * 3
    places, _ = kinematics(load(poses, path=[(0, 0.1, -2.0)] * 3, options={"rest_frame": 0}))
    assert places["neck"][2] - places["left_ankle"][2] > 1.2


def test_an_axis_that_is_none_is_named(load):
    with pytest.raises(ValueError, match="up='w' must be an axis: pass one of x, y, z, -x, -y, -z"):
        load([{}] * 2, options={"up": "w"})


def test_a_rest_pose_that_sits_is_refused_though_its_legs_point_along_an_axis(skeleton, load):
    def seated(name, offset):
        return (offset[0], offset[2], -offset[1]) if name.endswith(("Leg", "Foot", "Toe")) else offset

    body = [(name, parent, seated(name, offset)) for name, parent, offset in skeleton]
    with pytest.raises(MotionFormatError, match=r"motion\.bvh: its rest pose does not stand"):
        load([{}] * 2, body=body)


def test_a_body_that_stands_up_from_the_floor_stands_at_the_end(load, about, kinematics):
    """Most frames lie, but those that stand show which axis points up."""
    poses = [{"Hips": about([1, 0, 0], -90 + degrees)} for degrees in [0] * 20 + [15, 30, 45, 60, 75, 90]]
    clip = load(poses, path=[(0, 0.1, 0)] * 20 + [(0, 0.9, 0)] * 6, fps=5.0)
    places, _ = kinematics(clip, -1)
    assert places["neck"][2] - places["left_ankle"][2] > 1.2
