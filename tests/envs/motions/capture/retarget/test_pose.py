"""The character takes the pose of the body: bones point alike, trunk and head turn alike, feet that stand are flat."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.joints import character_model

X, Y, Z = np.eye(3)


@pytest.fixture
def source_positions(skeleton, forward):
    """Where the joints of a pose are, in the character's axes, by rotation matrices."""

    def source_positions(pose):
        places, turns = {}, {}
        for name, parent, offset in skeleton:
            own = pose.get(name, Rotation.identity())
            turns[name] = turns[parent] * own if parent else own
            places[name] = places[parent] + turns[parent].apply(offset) if parent else np.zeros(3)
        return {name: forward @ place for name, place in places.items()}

    return source_positions


def direction(places, start, end):
    bone = places[end] - places[start]
    return bone / np.linalg.norm(bone)


BONES = [
    ("hip", "knee", "UpLeg", "Leg"),
    ("knee", "ankle", "Leg", "Foot"),
    ("shoulder", "elbow", "Arm", "ForeArm"),
    ("elbow", "wrist", "ForeArm", "Hand"),
]


def test_standing_with_the_arms_down_is_the_rest_pose_of_the_character(load, arms_down):
    clip = load([arms_down()] * 2)
    expected = character_model("humanoid").qpos0
    np.testing.assert_allclose(clip.qpos[0], expected, atol=1e-7)


def test_a_t_pose_holds_the_arms_to_their_own_sides(load, kinematics):
    places, _ = kinematics(load([{}] * 2))
    assert direction(places, "left_shoulder", "left_wrist") == pytest.approx([0, 1, 0], abs=1e-7)
    assert direction(places, "right_shoulder", "right_wrist") == pytest.approx([0, -1, 0], abs=1e-7)


@pytest.mark.parametrize(
    ("bone", "axis", "degrees", "joint", "expected"),
    [
        ("LeftLeg", X, 40, "left_knee", -40),
        ("RightLeg", X, 70, "right_knee", -70),
        ("LeftForeArm", Y, -50, "left_elbow", 50),
        ("RightForeArm", Y, 35, "right_elbow", 35),
    ],
)
def test_a_hinge_flexes_by_the_angle_between_the_bones(
    load, bone, axis, degrees, joint, expected, hinge, arms_down, about
):
    clip = load([arms_down(**{bone: about(axis, degrees)})] * 2)
    assert hinge(clip, joint)[0] == pytest.approx(math.radians(expected), abs=1e-7)


def test_every_bone_of_the_limbs_points_where_the_source_has_it(load, kinematics, source_positions, any_pose):
    places, _ = kinematics(load([any_pose] * 2))
    source = source_positions(any_pose)
    for side in ("left", "right"):
        for start, end, *names in BONES:
            expected = direction(source, *(side.title() + name for name in names))
            found = direction(places, f"{side}_{start}", f"{side}_{end}")
            np.testing.assert_allclose(found, expected, atol=1e-7, err_msg=f"{side} {start}")


@pytest.mark.parametrize("body", ["root", "chest", "neck"])
def test_the_trunk_and_the_head_are_turned_as_in_the_source(load, body, kinematics, any_pose, forward):
    chain = {"root": ["Hips"], "chest": ["Hips", "Spine", "Chest"], "neck": ["Hips", "Spine", "Chest", "Head"]}[body]
    turn = Rotation.identity()
    for name in chain:
        turn = turn * any_pose[name]
    _, orientations = kinematics(load([any_pose] * 2))
    np.testing.assert_allclose(orientations[body], forward @ turn.as_matrix() @ forward.T, atol=1e-7)


def test_the_twist_of_a_limb_is_steady_while_it_is_too_straight_to_show(load, kinematics, about):
    """The plane of the leg stays turned out by 25 degrees while the knee straightens and bends again."""
    out = Rotation.from_euler("Y", 25, degrees=True)
    poses = [{"LeftLeg": out * about(X, flexion) * out.inv()} for flexion in (60, 30, 10, 5, 1, 12, 40, 60)]
    clip = load(poses)
    for index in range(len(poses)):
        _, orientations = kinematics(clip, index)
        expected = Rotation.from_euler("z", 25, degrees=True).as_matrix()
        np.testing.assert_allclose(orientations["left_hip"], expected, atol=1e-6)


def test_a_knee_bent_the_wrong_way_is_straight(load, hinge, arms_down, about):
    assert hinge(load([arms_down(LeftLeg=about(X, -4))] * 2), "left_knee").tolist() == [0, 0]


def test_a_foot_that_the_rest_pose_does_not_hold_level_is_set_flat(load, kinematics, about):
    """The file says that the toes point down by 30 degrees and the soles are rolled, all the time, and it stands."""
    _, orientations = kinematics(load([{"LeftFoot": about(X, 30) * about(Z, 10)}] * 3))
    np.testing.assert_allclose(orientations["left_ankle"][:, 2], [0, 0, 1], atol=1e-7)
    np.testing.assert_allclose(orientations["right_ankle"][:, 2], [0, 0, 1], atol=1e-7)


def test_a_foot_that_turns_in_the_air_is_not_held_flat(load, kinematics, about):
    """The foot stands for three quarters of the time; then it is lifted with its toes up."""
    lifted = {"LeftUpLeg": about(X, -30), "LeftLeg": about(X, 60), "LeftFoot": about(X, -50)}
    clip = load([{}] * 12 + [lifted] * 4, fps=15.0, options={"rate": 15.0})
    np.testing.assert_allclose(kinematics(clip, 0)[1]["left_ankle"][:, 2], [0, 0, 1], atol=1e-7)
    assert math.degrees(math.asin(kinematics(clip, 15)[1]["left_ankle"][2, 0])) == pytest.approx(20, abs=1e-5)


def test_the_biped_moves_its_legs_and_torso_as_the_humanoid_does(load, kinematics, any_pose):
    humanoid, biped = load([any_pose] * 2), load([any_pose] * 2, "biped")
    (places, turned), (own_places, own_turned) = kinematics(humanoid), kinematics(biped)
    np.testing.assert_allclose(own_turned["torso"], turned["chest"], atol=1e-9)
    for body in ("root", "left_knee", "right_ankle"):
        np.testing.assert_allclose(own_turned[body], turned[body], atol=1e-9)
        np.testing.assert_allclose(own_places[body], places[body], atol=1e-2)


def reflected(pose):
    """The mirror image of a pose: left and right change places, and rotations about y and z their sense."""

    def other(name):
        return name.replace("Left", "right").replace("Right", "Left").replace("right", "Right")

    return {other(name): Rotation.from_rotvec([1, -1, -1] * turn.as_rotvec()) for name, turn in pose.items()}


@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_the_mirror_image_of_a_motion_gives_the_mirror_image_of_the_clip(load, character, any_pose, arms_down):
    poses, path = [{}, any_pose, arms_down()], np.array([(0, 0.9, 0), (0.2, 0.8, 0.1), (-0.1, 0.9, 0.4)])
    clip = load(poses, character, fps=2.0, path=path)
    other = load([reflected(pose) for pose in poses], character, fps=2.0, path=path * [-1, 1, 1])
    torch.testing.assert_close(other.qpos, clip.mirrored().qpos, rtol=0, atol=1e-7)
