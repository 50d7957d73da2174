"""Motions of SMPL's bodies become clips: joints, axes, layouts, frame rates and proportions."""

from contextlib import suppress

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.importer import import_motion, imported
from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.gait.generator import stride

ORDER = ["root", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2", "left_ankle", "right_ankle"]
ORDER += ["chest", "left_foot", "right_foot", "neck", "left_collar", "right_collar", "head", "left_shoulder"]
ORDER += ["right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"]
"""SMPL's joints by the names of the character's, where it has them; the character's head turns at its neck."""

AXES = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])
"""From the character's axes, x forward and y left, to SMPL's, x left and y up."""

UPRIGHT = Rotation.from_rotvec([np.pi / 2, 0, 0])
"""From y up to z up."""

CHARACTER_LEG, MEAN_LEG = 0.421546 + 0.40987, (0.37679 + 0.38462 + 0.40062 + 0.40095) / 2


def smpl(clip, up):
    """``poses`` (T, 66) and ``trans`` of a clip: each joint turns as the character's, with the arms from a T-pose."""
    qpos, poses = clip.qpos.numpy(), np.zeros((len(clip.qpos), 22, 3))
    model = character_model(clip.character)
    for index in range(model.njnt):
        joint = model.joint(index)
        start = joint.qposadr[0] + (3 if index == 0 else 0)
        if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE:
            turn = Rotation.from_rotvec(qpos[:, start : start + 1] * joint.axis)
        else:
            turn = Rotation.from_quat(qpos[:, start : start + 4], scalar_first=True)
        turn = Rotation.from_matrix(AXES @ turn.as_matrix() @ AXES.T)
        name = {"torso": "chest"}.get(joint.name, joint.name) if index else "root"
        down = Rotation.from_rotvec([0, 0, -np.pi / 2 if name.startswith("left") else np.pi / 2])
        if name.endswith("shoulder"):
            turn = turn * down
        elif name.endswith("elbow"):
            turn = down.inv() * turn * down
        elif name == "root" and up == "z":
            turn = UPRIGHT * turn
        poses[:, ORDER.index(name)] = turn.as_rotvec()
    trans = qpos[:, :3] @ AXES.T * (MEAN_LEG / CHARACTER_LEG)
    return poses.reshape(len(poses), 66), UPRIGHT.apply(trans) if up == "z" else trans


def widened(poses, width):
    """Add turned hands and face, which no character has."""
    return np.concatenate([poses, np.full((len(poses), width - 66), 0.3)], axis=1)


def deviations(found, expected):
    """Greatest difference of each joint in degrees."""
    model = character_model(found.character)
    for index in range(model.njnt):
        joint = model.joint(index)
        start = joint.qposadr[0] + (3 if index == 0 else 0)
        if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE:
            yield np.degrees(float((found.qpos[:, start] - expected.qpos[:, start]).abs().max()))
        else:
            a, b = (
                Rotation.from_quat(clip.qpos[:, start : start + 4], scalar_first=True) for clip in (found, expected)
            )
            yield np.degrees((a.inv() * b).magnitude().max())


@pytest.fixture
def write(tmp_path):
    def write(**arrays):
        path = tmp_path / "motion.npz"
        np.savez(path, **arrays)
        return path

    return write


@pytest.fixture(scope="module")
def walk():
    return stride("humanoid", 1.1, 0.4, strides=2)


LAYOUTS = {
    "AMASS, SMPL-H": ("z", 156, "mocap_framerate"),
    "AMASS, SMPL-X": ("z", 165, "mocap_frame_rate"),
    "SMPL, y up": ("y", 72, "fps"),
    "SMPL, z up": ("z", 72, "fps"),
}


@pytest.mark.parametrize("character", ["humanoid", "biped"])
@pytest.mark.parametrize(("up", "width", "key"), LAYOUTS.values(), ids=LAYOUTS)
def test_a_walk_comes_back_within_a_degree(write, up, width, key, character):
    walk = stride(character, 1.1, 0.4, strides=2)
    poses, trans = smpl(walk, up)
    path = write(poses=widened(poses, width), trans=trans, betas=np.zeros(16), gender="neutral", **{key: walk.fps})
    found = imported(path, character, rate=walk.fps)
    assert max(deviations(found.clip, walk)) < 1.0
    path, expected = (clip.qpos[:, :3] - clip.qpos[0, :3] for clip in (found.clip, walk))
    np.testing.assert_allclose(path, expected, atol=0.02)  # the pelvis is 9 cm above the hips, whose middle is followed
    assert found.cut.max() < 1e-3
    assert bool(found.assumed) is (key == "fps" and up == "z")


def test_root_and_body_may_be_separate_arrays(write, walk):
    poses, trans = smpl(walk, "z")
    path = write(root_orient=poses[:, :3], pose_body=poses[:, 3:], trans=trans, mocap_frame_rate=walk.fps)
    assert max(deviations(import_motion(path, "humanoid", rate=walk.fps), walk)) < 1.0


@pytest.mark.parametrize("fps", [24.0, 60.0, 100.0, 120.0, 240.0])
def test_a_walk_at_any_frame_rate_comes_back(write, walk, fps):
    recorded = walk.resampled(fps)
    poses, trans = smpl(recorded, "z")
    path = write(poses=widened(poses, 156), trans=trans, mocap_framerate=recorded.fps)
    found = import_motion(path, "humanoid", rate=30.0)
    assert found.duration == pytest.approx(walk.duration)
    assert max(deviations(found, recorded.resampled(30.0))) < 1.0


def test_the_frame_rate_of_the_user_wins(write):
    path = write(poses=np.zeros((11, 72)), trans=np.zeros((11, 3)), fps=60.0)
    assert import_motion(path, "humanoid", fps=10.0).duration == pytest.approx(1.0)


@pytest.mark.parametrize("file", ["sfu/0005_Walking001.bvh", "cmu/02_01.amc", "deepmimic/humanoid3d_jog.txt"])
def test_real_motions_come_back_within_a_degree_but_for_the_level_of_the_feet(mocap, write, file):
    expected = import_motion(mocap / file, "humanoid", rate=60.0)
    poses, trans = smpl(expected, "z")
    path = write(poses=widened(poses, 156), trans=trans, mocap_framerate=expected.fps)
    found = import_motion(path, "humanoid", rate=expected.fps)
    names = [character_model("humanoid").joint(index).name for index in range(found.layout.nv) if index < 13]
    errors = dict(zip(names, deviations(found, expected), strict=True))
    assert max(error for name, error in errors.items() if not name.endswith("ankle")) < 1.0
    assert max(errors.values()) < 11  # by a constant rotation that makes the soles level


def test_the_zero_pose_stands_with_straight_limbs_and_the_arms_to_their_own_sides(write, kinematics):
    clip = import_motion(write(poses=np.zeros((3, 72)), trans=np.zeros((3, 3)), fps=30), "humanoid")
    places, _ = kinematics(clip)
    for side, sign in (("left", 1), ("right", -1)):
        np.testing.assert_allclose(
            places[f"{side}_wrist"] - places[f"{side}_shoulder"], [0, sign * 0.533, 0], atol=2e-2
        )
        np.testing.assert_allclose(places[f"{side}_ankle"] - places[f"{side}_hip"], [0, 0, -CHARACTER_LEG], atol=1e-6)
        assert places[f"{side}_ankle"][2] == pytest.approx(0.05, abs=1e-6)


def test_a_body_model_gives_the_joints_of_a_shape_their_positions(write, tmp_path):
    """A body whose one vertex for each joint lies on it, and whose shape makes the legs longer by half."""
    template = np.zeros((22, 3))
    template[[1, 4, 7]], template[[2, 5, 8]] = (
        [[0.1, y, 0] for y in (0, -0.4, -0.8)],
        [[-0.1, y, 0] for y in (0, -0.4, -0.8)],
    )
    template[[3, 6, 9, 12, 15], 1] = [0.1, 0.2, 0.3, 0.5, 0.6]
    for sign, joints in ((1, (13, 16, 18, 20)), (-1, (14, 17, 19, 21))):
        template[list(joints)] = [[sign * x, 0.45, 0] for x in (0.05, 0.2, 0.45, 0.7)]
    shapes = np.zeros((22, 3, 10))
    shapes[[4, 5, 7, 8], 1, 0] = [-0.1, -0.1, -0.2, -0.2]  # 25 % for a beta of 1
    np.savez(tmp_path / "model.npz", v_template=template, shapedirs=shapes, J_regressor=np.eye(22))
    trans = np.linspace([0, 0, 0], [0, 0, 1], 31)
    path = write(poses=np.zeros((31, 72)), trans=trans, fps=30, betas=np.array([0.5, 3.0]))
    clip = import_motion(path, "humanoid", body_model=tmp_path / "model.npz")
    assert clip.qpos[-1, 0] == pytest.approx(CHARACTER_LEG / 0.9, rel=1e-6)
    mean = import_motion(path, "humanoid")
    assert mean.qpos[-1, 0] == pytest.approx(CHARACTER_LEG / MEAN_LEG, rel=1e-3)


GOOD = {"poses": np.zeros((5, 72)), "trans": np.zeros((5, 3)), "fps": 30.0}

WRONG = {
    "width": ({"poses": np.zeros((5, 75))}, r"poses has shape \(5, 75\), but should have \(T, N\).*66, 72, 156, 165"),
    "one frame": ({"poses": np.zeros((1, 72)), "trans": np.zeros((1, 3))}, r"trans has shape \(1, 3\)|poses has shape"),
    "no frames": ({"poses": np.zeros((0, 72)), "trans": np.zeros((0, 3))}, "poses has shape|trans has shape"),
    "a number": ({"poses": np.float64(1.0)}, "poses has shape"),
    "other length": ({"trans": np.zeros((4, 3))}, "has 5 poses and 4 positions in trans: both numbers must be equal"),
    "flat trans": ({"trans": np.zeros((5, 2))}, r"its array trans has shape \(5, 2\), but should have \(T, 3\)"),
    "not finite": ({"poses": np.full((5, 72), np.nan)}, "its array poses holds a value that is not a finite number"),
    "words": ({"trans": np.full((5, 3), "a")}, "its array trans holds a value that is not a finite number"),
    "no rate": ({"fps": None}, r"has no frame rate .*: pass it \(--fps\)"),
    "rate zero": ({"fps": 0.0}, "its fps must be a positive number"),
    "no trans": ({"trans": None}, "its array trans cannot be read"),
    "pickled": ({"trans": np.array([{}] * 5, dtype=object)}, "its array trans cannot be read"),
    "lies": (
        {"poses": np.tile([[0, 0, np.pi / 2]], (5, 24)) * np.eye(24).repeat(3, 1)[:1]},
        "its body does not stand in any frame",
    ),
}


@pytest.mark.parametrize(("changes", "message"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_in_one_sentence(write, changes, message):
    path = write(**{name: value for name, value in (GOOD | changes).items() if value is not None})
    with pytest.raises(MotionFormatError, match=message) as caught:
        import_motion(path, "humanoid")
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_body_model_of_another_kind_is_refused(write, tmp_path):
    np.savez(tmp_path / "model.npz", v_template=np.zeros((7, 3)), shapedirs=np.zeros((6, 3, 10)), J_regressor=np.eye(7))
    with pytest.raises(MotionFormatError, match=r"model\.npz: v_template, shapedirs and J_regressor do not fit"):
        import_motion(write(**GOOD, betas=np.zeros(10)), "humanoid", body_model=tmp_path / "model.npz")
    with pytest.raises(MotionFormatError, match=r"nowhere\.npz: must be a NumPy archive"):
        import_motion(write(**GOOD, betas=np.zeros(10)), "humanoid", body_model=tmp_path / "nowhere.npz")


@pytest.mark.parametrize("names", [("poses",), ("root_orient", "pose_body")], ids=str)
def test_degrees_are_recognised_and_their_conversion_is_the_remedy(write, walk, names):
    poses, trans = smpl(walk, "y")
    rest = {"trans": trans, "fps": walk.fps}
    columns = {"poses": poses, "root_orient": poses[:, :3], "pose_body": poses[:, 3:]}
    for convert, refused in ((np.degrees, True), (np.copy, False)):
        path = write(**{name: convert(columns[name]) for name in names}, **rest)
        if refused:
            with pytest.raises(MotionFormatError, match=rf"{names[-1]} .* in degrees: convert .* numpy\.radians"):
                import_motion(path, "humanoid")
        else:
            assert max(deviations(import_motion(path, "humanoid", rate=walk.fps), walk)) < 1.0


def test_a_dancer_whose_turns_are_counted_is_not_in_degrees(write):
    spins = np.zeros((120, 66))
    spins[:, 1] = np.linspace(0, 6 * np.pi, 120)
    path = write(poses=spins, trans=np.zeros((120, 3)), fps=30.0)
    assert import_motion(path, "humanoid").duration == pytest.approx(119 / 30)


def test_rotations_of_root_and_body_are_equally_many(write):
    parts = {"root_orient": np.zeros((3, 3)), "pose_body": np.zeros((5, 63)), "trans": np.zeros((5, 3))}
    with pytest.raises(MotionFormatError, match="has 3 rotations in root_orient and 5 in pose_body"):
        import_motion(write(**parts, mocap_frame_rate=30), "humanoid")


def test_an_archive_of_something_else_is_refused_with_its_arrays(write):
    with pytest.raises(MotionFormatError, match="has the arrays images, labels: pass poses and trans of SMPL's bodies"):
        import_motion(write(images=np.zeros(3), labels=np.zeros(3)), "humanoid")


ARRAYS = st.sampled_from(
    [
        np.zeros(0),
        np.zeros((5, 72)),
        np.zeros((5, 3)),
        np.ones((5, 63)),
        np.full((5, 156), 1e30),
        np.array("x"),
        np.eye(3),
    ]
)


@settings(max_examples=50)
@given(
    st.dictionaries(st.sampled_from(["poses", "trans", "root_orient", "pose_body", "fps", "qpos"]), ARRAYS, min_size=1)
)
def test_no_arrays_raise_another_error(tmp_path_factory, arrays):
    path = tmp_path_factory.getbasetemp() / "any.npz"
    np.savez(path, **arrays)
    with suppress(MotionFormatError):
        import_motion(path, "humanoid")
