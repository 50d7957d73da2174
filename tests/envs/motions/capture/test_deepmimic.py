"""Files of DeepMimic become clips: axes, joints, times and loops."""

import json

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.importer import import_motion, imported
from torchrl_mcp.envs.motions.errors import MotionFormatError

BALLS = [1.0, 0.0, 0.0, 0.0]
HUMANOID = ["root", "chest", "neck", "right_hip", "right_knee", "right_ankle", "right_shoulder", "right_elbow"]
HUMANOID += ["left_hip", "left_knee", "left_ankle", "left_shoulder", "left_elbow"]
BIPED = ["root", "torso", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle"]


def frame(joints, *, duration=0.1, position=(0.0, 0.9, 0.0), **values):
    """One frame in DeepMimic's axes: x forward, y up, z right."""
    columns = [duration, *position]
    for joint in joints:
        hinge = joint.endswith(("knee", "elbow"))
        columns += [values.get(joint, 0.0)] if hinge else list(values.get(joint, BALLS))
    return columns


def quaternion(axis, degrees):
    return Rotation.from_rotvec(np.radians(degrees) * np.array(axis, float)).as_quat(scalar_first=True).tolist()


@pytest.fixture
def write(tmp_path):
    def write(frames, loop="none"):
        path = tmp_path / "motion.txt"
        path.write_text(json.dumps({"Loop": loop, "Frames": frames}))
        return path

    return write


def of_joint(clip, name, index=0):
    joint = character_model(clip.character).joint(name)
    return clip.qpos[index, joint.qposadr[0] :][: 4 if joint.type[0] == mujoco.mjtJoint.mjJNT_BALL else 1].tolist()


def test_standing_faces_forward_with_the_soles_on_the_ground(write, kinematics):
    clip = import_motion(write([frame(HUMANOID), frame(HUMANOID)]), "humanoid")
    found, _ = kinematics(clip)
    np.testing.assert_allclose(found["root"], [0, 0, 0.881416], atol=1e-6)
    assert found["right_hip"][1] < 0 < found["left_hip"][1]
    np.testing.assert_allclose(found["left_ankle"], [0, 0.084887, 0.05], atol=1e-6)


def test_the_root_moves_forward_up_and_to_the_right(write):
    start, end = (0.3, 0.9, 0.2), (1.3, 1.0, 0.4)
    clip = import_motion(write([frame(HUMANOID, position=start), frame(HUMANOID, position=end)]), "humanoid", rate=10)
    np.testing.assert_allclose(clip.qpos[1, :3] - clip.qpos[0, :3], [1.0, -0.2, 0.1], atol=1e-9)
    np.testing.assert_allclose(clip.qpos[0, :2], [0, 0], atol=1e-12)


@pytest.mark.parametrize(
    ("joint", "rotation", "body", "direction"),
    [
        ("right_hip", quaternion([0, 0, 1], 60), "right_knee", [np.sin(np.pi / 3), 0, -0.5]),  # forward
        ("left_hip", quaternion([1, 0, 0], 60), "left_knee", [0, np.sin(np.pi / 3), -0.5]),  # outward
        ("right_shoulder", quaternion([0, 0, 1], 90), "right_elbow", [1, 0, 0]),  # forward
        ("right_shoulder", quaternion([1, 0, 0], -60), "right_elbow", [0, -np.sin(np.pi / 3), -0.5]),  # outward
        ("left_knee", -np.pi / 2, "left_ankle", [-1, 0, 0]),  # backward
        ("right_elbow", np.pi / 2, "right_wrist", [1, 0, 0]),  # forward
    ],
)
def test_a_positive_rotation_about_an_axis_moves_the_limb_as_in_deepmimic(
    write, joint, rotation, body, direction, kinematics
):
    found, _ = kinematics(import_motion(write([frame(HUMANOID, **{joint: rotation})] * 2), "humanoid"))
    moved = found[body] - found[joint]
    np.testing.assert_allclose(moved / np.linalg.norm(moved), direction, atol=1e-9)


def test_a_turn_to_the_left_is_a_turn_to_the_left(write, kinematics):
    found, _ = kinematics(import_motion(write([frame(HUMANOID, root=quaternion([0, 1, 0], 90))] * 2), "humanoid"))
    np.testing.assert_allclose(found["left_hip"] - found["right_hip"], [-2 * 0.084887, 0, 0], atol=1e-9)


def test_joints_keep_their_angles(write):
    rotation = quaternion([0.6, 0.0, 0.8], 20)
    moved = frame(HUMANOID, chest=rotation, neck=rotation, left_ankle=rotation, left_elbow=0.3, right_knee=-0.4)
    clip = import_motion(write([moved, moved]), "humanoid")
    w, x, y, z = rotation
    for joint in ("chest", "neck", "left_ankle"):
        np.testing.assert_allclose(of_joint(clip, joint), [w, x, -z, y], atol=1e-12)
    assert of_joint(clip, "left_elbow") == [0.3]
    assert of_joint(clip, "right_knee") == [-0.4]


def test_joints_stay_within_the_limits_of_the_character(write):
    beyond = frame(HUMANOID, right_knee=0.2, left_knee=-3.5, chest=quaternion([0, 0, 1], 90))
    clip = import_motion(write([beyond, beyond]), "humanoid")
    assert of_joint(clip, "right_knee") == [0.0]
    assert of_joint(clip, "left_knee") == [-3.14]
    np.testing.assert_allclose(of_joint(clip, "chest"), [np.cos(0.6), 0, -np.sin(0.6), 0], atol=1e-12)


@pytest.mark.parametrize("length", [0.7, 0.85, 1.0, 1.3])
def test_the_length_of_quaternions_does_not_matter(write, length):
    rotation = quaternion([0.6, 0.0, 0.8], 20)
    scaled = [length * number for number in rotation]
    joints = ("root", "chest", "neck", "left_ankle", "right_shoulder")
    found = import_motion(write([frame(HUMANOID, **dict.fromkeys(joints, scaled))] * 2), "humanoid")
    expected = import_motion(write([frame(HUMANOID, **dict.fromkeys(joints, rotation))] * 2), "humanoid")
    torch.testing.assert_close(found.qpos, expected.qpos, rtol=0, atol=1e-12)


def reordered(columns, joints):
    """The frame with its quaternions as x, y, z, w."""
    columns, rest = columns[:4], columns[4:]
    for joint in joints:
        width = 1 if joint.endswith(("knee", "elbow")) else 4
        columns, rest = columns + rest[1:width] + rest[:1], rest[width:]
    return columns


def test_quaternions_in_another_order_are_refused_with_the_share_of_cut_frames_or_read_as_told(write):
    """Read as w, x, y, z, the identity 0, 0, 0, 1 is a half turn, and a chest turns by 1.2 rad at most."""
    rotation = quaternion([0.6, 0.0, 0.8], 20)
    frames = [frame(HUMANOID, chest=rotation, left_knee=-0.3)] * 4
    path = write([reordered(columns, HUMANOID) for columns in frames])
    with pytest.raises(MotionFormatError, match=r"motion\.txt: in 100 % of its frames .* --quaternion xyzw"):
        import_motion(path, "humanoid")
    found = import_motion(path, "humanoid", quaternion="xyzw")
    torch.testing.assert_close(found.qpos, import_motion(write(frames), "humanoid").qpos, rtol=0, atol=1e-12)


@pytest.mark.parametrize("beyond", [2, 5, 6])
def test_a_motion_is_refused_only_if_most_frames_are_misread(write, beyond):
    """The chest turns by 1.2 rad at most, and 45 degrees more are more than 30."""
    turned = frame(HUMANOID, chest=quaternion([0, 0, 1], np.degrees(1.2) + 45))
    path = write([turned] * beyond + [frame(HUMANOID)] * (10 - beyond))
    if beyond > 5:
        with pytest.raises(MotionFormatError, match=r"in 60 % of its frames .* by more than 30 degrees, .* up to 45"):
            import_motion(path, "humanoid")
    else:
        cut = imported(path, "humanoid").cut
        np.testing.assert_allclose(cut, [45] * beyond + [0] * (10 - beyond), atol=1e-6)


@pytest.mark.parametrize("joints", [HUMANOID, BIPED], ids=["humanoid's file", "biped's file"])
@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_either_character_reads_the_files_of_both(write, joints, character):
    lean, bend = quaternion([0, 0, 1], -10), {"left_knee": -0.5, "right_ankle": quaternion([0, 0, 1], 15)}
    moved = frame(joints, chest=lean, torso=lean, **bend)
    clip = import_motion(write([moved, moved]), character)
    assert clip.character == character
    assert of_joint(clip, "left_knee") == [-0.5]
    trunk = "torso" if character == "biped" else "chest"
    np.testing.assert_allclose(of_joint(clip, trunk), [lean[0], 0, -lean[3], 0], atol=1e-12)
    if character == "humanoid":
        assert of_joint(clip, "left_shoulder") == BALLS


@pytest.mark.parametrize(("loop", "expected"), [("wrap", True), ("none", False), (True, True), (False, False)])
def test_the_loop_may_be_a_word_or_a_boolean(write, loop, expected):
    assert import_motion(write([frame(HUMANOID)] * 3, loop), "humanoid").loop is expected


def test_the_clip_is_as_long_as_all_durations_but_the_last(write):
    frames = [frame(HUMANOID, duration=duration) for duration in (0.1, 0.2, 0.3, 7.0)]
    clip = import_motion(write(frames), "humanoid", rate=20)
    assert clip.duration == pytest.approx(0.6)
    assert clip.fps == pytest.approx(20)


def test_frames_of_unequal_duration_are_met_at_their_times(write):
    places = [(0.0, 0.1), (1.0, 0.3), (2.0, 0.1), (5.0, 0.0)]
    frames = [frame(HUMANOID, duration=duration, position=(x / 10, 0.9, 0.0)) for x, duration in places]
    clip = import_motion(write(frames), "humanoid", rate=10)
    np.testing.assert_allclose(10 * clip.qpos[:, 0], [0, 1, 4 / 3, 5 / 3, 2, 5], atol=1e-9)


def test_the_frame_rate_of_the_user_wins(write):
    assert import_motion(write([frame(HUMANOID)] * 7), "humanoid", fps=3).duration == pytest.approx(2.0)


def test_a_loop_ends_in_the_pose_and_the_heading_with_which_it_began(write):
    poses = [
        {"root": quaternion([0, 1, 0], 7 * k), "left_knee": -0.3 - 0.1 * k, "position": (k, 0.9 + 0.01 * k, 0.0)}
        for k in range(6)
    ]
    clip = import_motion(write([frame(HUMANOID, **pose) for pose in poses], "wrap"), "humanoid", rate=10)
    np.testing.assert_allclose(clip.qpos[-1, 2:], clip.qpos[0, 2:], atol=1e-12)
    np.testing.assert_allclose(clip.qpos[:, 0], range(6), atol=1e-9)
    np.testing.assert_allclose(clip.cycle.turn, 0.0, atol=1e-12)


def test_the_cycle_of_a_loop_keeps_its_duration(write):
    clip = import_motion(write([frame(HUMANOID, duration=0.0333)] * 39, "wrap"), "humanoid", rate=30)
    assert clip.duration == pytest.approx(38 * 0.0333)
    assert clip.fps == pytest.approx(30, rel=0.01)


def mirrored(columns, joints):
    """Mirror one frame as the files define it: z -> -z, quaternion (w, -x, -y, z), left and right exchanged."""
    duration, x, y, z, *rest = columns
    values = {}
    for joint in joints:
        width = 1 if joint.endswith(("knee", "elbow")) else 4
        value, rest = rest[:width], rest[width:]
        side = {"right": "left", "left": "right"}.get(joint.partition("_")[0])
        name = f"{side}_{joint.partition('_')[2]}" if side else joint
        values[name] = value[0] if width == 1 else [value[0], -value[1], -value[2], value[3]]
    return frame(joints, duration=duration, position=(x, y, -z), **values)


@pytest.mark.parametrize(("joints", "character"), [(HUMANOID, "humanoid"), (BIPED, "biped")])
def test_the_mirror_image_of_a_file_is_the_mirror_image_of_the_clip(write, joints, character):
    rng = np.random.default_rng(0)
    frames = [
        frame(
            joints,
            position=rng.uniform(0.5, 1.0, 3).tolist(),
            **{
                joint: -abs(rng.normal()) / 4
                if joint.endswith("knee")
                else quaternion(rng.normal(size=3), rng.uniform(5, 20))
                for joint in joints
                if not joint.endswith("elbow")
            },
        )
        for _ in range(4)
    ]
    clip = import_motion(write(frames), character)
    other = import_motion(write([mirrored(columns, joints) for columns in frames]), character)
    torch.testing.assert_close(other.qpos, clip.mirrored().qpos, rtol=0, atol=1e-12)
