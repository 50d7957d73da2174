import math
import re
from contextlib import suppress

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.importer import import_motion
from torchrl_mcp.envs.motions.joints import character_model

# A body in a T-pose, y up, z forward, x left, in metres: joint, parent, offset. The soles are 5 cm below the ankles.
BODY = [
    ("Hips", None, (0, 0, 0)),
    ("Spine", "Hips", (0, 0.1, 0)),
    ("Chest", "Spine", (0, 0.14, 0)),
    ("Neck", "Chest", (0, 0.24, 0)),
    ("Head", "Neck", (0, 0.08, 0)),
]
for side, sign in (("Left", 1), ("Right", -1)):
    BODY += [
        (f"{side}UpLeg", "Hips", (sign * 0.09, -0.02, 0.01)),
        (f"{side}Leg", f"{side}UpLeg", (0, -0.43, 0)),
        (f"{side}Foot", f"{side}Leg", (0, -0.42, 0)),
        (f"{side}Toe", f"{side}Foot", (0, -0.05, 0.13)),
        (f"{side}Shoulder", "Chest", (sign * 0.04, 0.2, 0)),
        (f"{side}Arm", f"{side}Shoulder", (sign * 0.14, 0, 0)),
        (f"{side}ForeArm", f"{side}Arm", (sign * 0.27, 0, 0)),
        (f"{side}Hand", f"{side}ForeArm", (sign * 0.25, 0, 0)),
    ]
LEG = 0.85
CHARACTER_LEG = 0.421546 + 0.40987

FORWARD = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""From the axes of the body to the character's: x is what z was."""

X, Y, Z = np.eye(3)


def about(axis, degrees):
    return Rotation.from_rotvec(math.radians(degrees) * np.asarray(axis, float))


def arms_down(**turns):
    return {"LeftArm": about(Z, -90), "RightArm": about(Z, 90), **turns}


def bvh(
    poses,
    *,
    body=BODY,
    order="ZXY",
    unit=1.0,
    axes=None,
    rename=lambda name: name,
    path=None,
    fps=30.0,
    position=(0, 0.9, 0),
    frames=None,
):
    """A BVH file of poses, each a rotation by joint; joints not named are not turned.

    ``axes`` are those of the file, ``frames`` rotations of the frame in which each joint turns.
    """
    turn, own = Rotation.from_matrix(np.eye(3) if axes is None else axes), frames or {}
    own = {None: turn.inv(), **{name: own.get(name, Rotation.identity()) * turn.inv() for name, _, _ in body}}
    channels = " ".join(f"{axis}rotation" for axis in order)
    sequence = []

    def joint(index, keyword):
        name, parent, offset = body[index]
        sequence.append((name, parent))
        offset = " ".join(map(repr, (own[parent].inv().apply(offset) / unit).tolist()))
        extra = "6 Xposition Yposition Zposition" if keyword == "ROOT" else "3"
        children = [child for child, (_, above, _) in enumerate(body) if above == name]
        inner = "".join(joint(child, "JOINT") for child in children)
        return f"{keyword} {rename(name)}\n{{\nOFFSET {offset}\nCHANNELS {extra} {channels}\n{inner}}}\n"

    text = "HIERARCHY\n" + joint(0, "ROOT") + f"MOTION\nFrames: {len(poses)}\nFrame Time: {1 / fps!r}\n"
    for pose, place in zip(poses, [position] * len(poses) if path is None else path, strict=True):
        row = (turn.apply(place) / unit).tolist()
        for name, parent in sequence:
            rotation = own[parent].inv() * pose.get(name, Rotation.identity()) * own[name]
            row += rotation.as_euler(order, degrees=True).tolist()
        text += " ".join(map(repr, row)) + "\n"
    return text


def source_positions(pose, *, body=BODY, position=(0, 0.9, 0)):
    """Where the joints are, in the character's axes, by rotation matrices."""
    places, turns = {}, {}
    for name, parent, offset in body:
        own = pose.get(name, Rotation.identity())
        turns[name] = turns[parent] * own if parent else own
        places[name] = places[parent] + turns[parent].apply(offset) if parent else np.array(position, float)
    return {name: FORWARD @ place for name, place in places.items()}


@pytest.fixture
def load(tmp_path):
    """Write poses as BVH, and import them."""

    def load(poses, character="humanoid", *, options=None, **layout):
        path = tmp_path / "motion.bvh"
        path.write_text(bvh(poses, **layout))
        return import_motion(path, character, **(options or {}))

    return load


def hinge(clip, name):
    return clip.qpos[:, character_model(clip.character).joint(name).qposadr[0]]


def direction(places, start, end):
    bone = places[end] - places[start]
    return bone / np.linalg.norm(bone)


BONES = [
    ("hip", "knee", "UpLeg", "Leg"),
    ("knee", "ankle", "Leg", "Foot"),
    ("shoulder", "elbow", "Arm", "ForeArm"),
    ("elbow", "wrist", "ForeArm", "Hand"),
]


def test_standing_with_the_arms_down_is_the_rest_pose_of_the_character(load):
    clip = load([arms_down()] * 2)
    expected = character_model("humanoid").qpos0
    np.testing.assert_allclose(clip.qpos[0], expected, atol=1e-7)


def test_a_t_pose_holds_the_arms_to_their_own_sides(load, kinematics):
    places, _ = kinematics(load([{}] * 2))
    assert direction(places, "left_shoulder", "left_wrist") == pytest.approx([0, 1, 0], abs=1e-7)
    assert direction(places, "right_shoulder", "right_wrist") == pytest.approx([0, -1, 0], abs=1e-7)


@pytest.mark.parametrize(
    ("turns", "joint", "expected"),
    [
        ({"LeftLeg": about(X, 40)}, "left_knee", -40),
        ({"RightLeg": about(X, 70)}, "right_knee", -70),
        ({"LeftForeArm": about(Y, -50)}, "left_elbow", 50),
        ({"RightForeArm": about(Y, 35)}, "right_elbow", 35),
    ],
)
def test_a_hinge_flexes_by_the_angle_between_the_bones(load, turns, joint, expected):
    assert hinge(load([arms_down(**turns)] * 2), joint)[0] == pytest.approx(math.radians(expected), abs=1e-7)


ANY = {
    "Hips": about([1, 2, -1], 20),
    "Spine": about([0, 1, 1], 10),
    "Chest": about([1, -1, 0], 12),
    "Head": about([1, 1, 1], 20),
    "LeftUpLeg": about([-1, 0.3, 0.2], 30),
    "LeftLeg": about([1, 0, 0.4], 40),  # a knee that does not flex about its own axis alone
    "LeftFoot": about([1, 2, 0], -15),
    "RightUpLeg": about([1, 0.5, -0.2], 15),
    "RightLeg": about([1, 0, -0.3], 65),
    "LeftShoulder": about([1, 1, 1], 8),
    "LeftArm": about(Z, -70) * about(Y, -20),
    "LeftForeArm": about([0.5, -1, 0], 45),
    "RightArm": about(Z, 60) * about([0, 1, 0.5], 30),
    "RightForeArm": about([0, 1, 0.5], 30),
}


def test_every_bone_of_the_limbs_points_where_the_source_has_it(load, kinematics):
    places, _ = kinematics(load([ANY] * 2))
    source = source_positions(ANY)
    for side in ("left", "right"):
        for start, end, *names in BONES:
            expected = direction(source, *(side.title() + name for name in names))
            found = direction(places, f"{side}_{start}", f"{side}_{end}")
            np.testing.assert_allclose(found, expected, atol=1e-7, err_msg=f"{side} {start}")


@pytest.mark.parametrize("body", ["root", "chest", "neck"])
def test_the_trunk_and_the_head_are_turned_as_in_the_source(load, body, kinematics):
    chain = {"root": ["Hips"], "chest": ["Hips", "Spine", "Chest"], "neck": ["Hips", "Spine", "Chest", "Head"]}[body]
    turn = Rotation.identity()
    for name in chain:
        turn = turn * ANY[name]
    _, orientations = kinematics(load([ANY] * 2))
    np.testing.assert_allclose(orientations[body], FORWARD @ turn.as_matrix() @ FORWARD.T, atol=1e-7)


def test_the_twist_of_a_limb_is_steady_while_it_is_too_straight_to_show(load, kinematics):
    """The plane of the leg stays turned out by 25 degrees while the knee straightens and bends again."""
    out = Rotation.from_euler("Y", 25, degrees=True)
    poses = [{"LeftLeg": out * about(X, flexion) * out.inv()} for flexion in (60, 30, 10, 5, 1, 12, 40, 60)]
    clip = load(poses)
    for index in range(len(poses)):
        _, orientations = kinematics(clip, index)
        expected = Rotation.from_euler("z", 25, degrees=True).as_matrix()
        np.testing.assert_allclose(orientations["left_hip"], expected, atol=1e-6)


def test_a_knee_bent_the_wrong_way_is_straight(load):
    assert hinge(load([arms_down(LeftLeg=about(X, -4))] * 2), "left_knee").tolist() == [0, 0]


def test_a_foot_that_the_rest_pose_does_not_hold_level_is_set_flat(load, kinematics):
    """The file says that the toes point down by 30 degrees and the soles are rolled, all the time, and it stands."""
    _, orientations = kinematics(load([{"LeftFoot": about(X, 30) * about(Z, 10)}] * 3))
    np.testing.assert_allclose(orientations["left_ankle"][:, 2], [0, 0, 1], atol=1e-7)
    np.testing.assert_allclose(orientations["right_ankle"][:, 2], [0, 0, 1], atol=1e-7)


def test_a_foot_that_turns_in_the_air_is_not_held_flat(load, kinematics):
    """The foot stands for three quarters of the time; then it is lifted with its toes up."""
    lifted = {"LeftUpLeg": about(X, -30), "LeftLeg": about(X, 60), "LeftFoot": about(X, -50)}
    clip = load([{}] * 12 + [lifted] * 4, fps=15.0, options={"rate": 15.0})
    np.testing.assert_allclose(kinematics(clip, 0)[1]["left_ankle"][:, 2], [0, 0, 1], atol=1e-7)
    assert math.degrees(math.asin(kinematics(clip, 15)[1]["left_ankle"][2, 0])) == pytest.approx(20, abs=1e-5)


def test_the_path_is_scaled_by_the_length_of_the_legs_and_begins_at_the_origin(load):
    path = [(0.3, 0.9, -2.0), (0.5, 0.95, -1.5), (0.4, 0.9, -1.0)]
    clip = load([{}] * 3, path=path)
    expected = (CHARACTER_LEG / LEG) * np.array([[0, 0, 0], [0.5, 0.2, 0.05], [1.0, 0.1, 0]])
    np.testing.assert_allclose(clip.qpos[:, :3] - clip.qpos[0, :3], expected, atol=1e-9)
    np.testing.assert_allclose(clip.qpos[0, :2], 0, atol=1e-12)


def test_the_clip_stands_on_the_ground_whatever_height_it_was_recorded_at(load):
    for height in (0.2, 0.9, 5.0):
        assert load([{}] * 2, position=(0, height, 0)).qpos[0, 2] == pytest.approx(CHARACTER_LEG + 0.05, abs=1e-6)


def stops(rise):
    """A path with rests, four metres forward and two to the left, on ground that rises forward."""
    places = [(0, 0), (1, 0), (2, 1), (3, 2), (4, 2)]
    return [(left, 0.9 + rise * forward, forward) for forward, left in places for _ in range(6)]


@pytest.mark.parametrize(("rise", "left_over"), [(0.0, 0.0), (0.02, 0.1), (-0.015, 0.1), (0.1, 1.0)])
def test_the_slope_of_a_laboratory_is_taken_out_and_that_of_stairs_is_not(load, rise, left_over):
    clip = load([{}] * 30, path=stops(rise), fps=10.0, options={"rate": 10.0})
    risen = float(clip.qpos[-1, 2] - clip.qpos[0, 2])
    assert abs(risen) <= left_over * abs(4 * rise) * CHARACTER_LEG / LEG + 1e-9
    assert abs(risen) >= 0.99 * (left_over == 1.0) * abs(4 * rise) * CHARACTER_LEG / LEG


def test_the_biped_moves_its_legs_and_torso_as_the_humanoid_does(load, kinematics):
    humanoid, biped = load([ANY] * 2), load([ANY] * 2, "biped")
    (places, turned), (own_places, own_turned) = kinematics(humanoid), kinematics(biped)
    np.testing.assert_allclose(own_turned["torso"], turned["chest"], atol=1e-9)
    for body in ("root", "left_knee", "right_ankle"):
        np.testing.assert_allclose(own_turned[body], turned[body], atol=1e-9)
        np.testing.assert_allclose(own_places[body], places[body], atol=1e-2)


AXES = {
    "z up, x forward": FORWARD,
    "z up, y back": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x up": FORWARD @ FORWARD,
}


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize("axes", AXES.values(), ids=AXES)
@pytest.mark.parametrize("order", ["XYZ", "YXZ"])
def test_neither_axes_nor_orders_matter(load, axes, order):
    expected = load([arms_down(), ANY, ANY], path=[(0, 0.9, 0), (0.1, 0.8, 0.2), (0.1, 0.8, 0.2)], fps=5.0)
    found = load(
        [arms_down(), ANY, ANY], path=[(0, 0.9, 0), (0.1, 0.8, 0.2), (0.1, 0.8, 0.2)], fps=5.0, axes=axes, order=order
    )
    torch.testing.assert_close(found.qpos, expected.qpos, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("unit", "scale"), [(0.01, None), (0.001, None), (0.0254, None), (0.0254 / 0.45, None), (0.3048, 0.3048)]
)
def test_the_unit_is_known_by_the_length_of_the_legs_or_said(load, unit, scale):
    expected = load([ANY] * 2)
    torch.testing.assert_close(
        load([ANY] * 2, unit=unit, options={"scale": scale}).qpos, expected.qpos, rtol=0, atol=1e-7
    )


@pytest.mark.parametrize(
    ("unit", "scale", "length"), [(0.3048, None, "2.79 m"), (0.01, 0.0254, "2.16 m"), (1.0, 0.5, "0.425 m")]
)
def test_legs_of_an_impossible_length_are_refused(load, unit, scale, length):
    with pytest.raises(MotionFormatError, match=rf"motion\.bvh: from hip to ankle .* {length}.*: give the scale"):
        load([{}] * 2, unit=unit, options={"scale": scale})


def test_a_joint_above_the_hips_may_stand_still_and_the_hips_move(tmp_path):
    body = [("Reference", None, (0, 0, 0)), ("Hips", "Reference", (0, 0.9, 0)), *BODY[1:]]
    text = bvh([arms_down()] * 2, body=body)
    *head, first, second = re.sub(r"(Hips\n.*\n.*\nCHANNELS) 3", r"\1 4 Zposition", text).splitlines()
    rows = [first.split(), second.split()]
    rows[0].insert(6, "0.0")
    rows[1].insert(6, "0.5")
    path = tmp_path / "carried.bvh"
    path.write_text("\n".join([*head, *map(" ".join, rows)]))
    clip = import_motion(path, "humanoid")
    np.testing.assert_allclose(clip.qpos[1, :2], [0.5 * CHARACTER_LEG / LEG, 0], atol=1e-9)


def spread(name, offset):
    """Turn the bones of the leg outwards by 20 degrees."""
    turn = about(Z, 20 if name.startswith("Left") else -20)
    return tuple(turn.apply(offset)) if re.fullmatch("(Left|Right)(Leg|Foot|Toe)", name) else offset


SPLAYED = [(name, parent, spread(name, offset)) for name, parent, offset in BODY]


def test_legs_that_the_rest_pose_spreads_hang_straight_when_the_motion_closes_them(load):
    closed = arms_down(LeftUpLeg=about(Z, -20), RightUpLeg=about(Z, 20))
    clip = load([closed] * 2, body=SPLAYED)
    expected = character_model("humanoid").qpos0
    np.testing.assert_allclose(clip.qpos[0], expected, atol=1e-7)


CONVENTIONS = {
    "prefixed": lambda name: f"mixamorig:{name}",
    "3ds Max": lambda name: f"Bip01 {limbs(name, '{side} {part}', STUDIO)}",
    "Biovision": lambda name: limbs(name, "{long}{part}", BIOVISION),
    "SMPL": lambda name: limbs(name, "{side}_{part}", BIOVISION),
    "engine": lambda name: limbs(name, "{part}_{small}", ENGINE),
    "CMU": lambda name: limbs(name, "{small}{part}", CMU),
}
STUDIO = {
    "UpLeg": "Thigh",
    "Leg": "Calf",
    "Foot": "Foot",
    "Shoulder": "Clavicle",
    "Arm": "UpperArm",
    "ForeArm": "Forearm",
}
BIOVISION = {
    "UpLeg": "Hip",
    "Leg": "Knee",
    "Foot": "Ankle",
    "Shoulder": "Collar",
    "Arm": "Shoulder",
    "ForeArm": "Elbow",
}
BIOVISION["Hand"] = "Wrist"
ENGINE = {
    "UpLeg": "thigh",
    "Leg": "calf",
    "Foot": "foot",
    "Shoulder": "clavicle",
    "Arm": "upperarm",
    "ForeArm": "lowerarm",
}
CMU = {"UpLeg": "femur", "Leg": "tibia", "Foot": "foot", "Shoulder": "clavicle", "Arm": "humerus", "ForeArm": "radius"}


def limbs(name, form, parts):
    """Rename the joints of a limb."""
    found = re.fullmatch("(Left|Right)(.*)", name)
    if not found:
        return name
    long, part = found.groups()
    return form.format(long=long, side=long[0], small=long[0].lower(), part=parts.get(part, part))


@pytest.mark.parametrize("rename", CONVENTIONS.values(), ids=CONVENTIONS)
def test_joints_are_known_by_the_names_of_many_makers(load, rename):
    assert torch.equal(load([ANY] * 2, rename=rename).qpos, load([ANY] * 2).qpos)


def test_other_names_are_given_by_a_map(load):
    strange = {"LeftLeg": "Gauche2", "Head": "Tete"}
    joint_map = {"left_knee": "Gauche2", "neck": "Tete"}
    found = load([ANY] * 2, rename=lambda name: strange.get(name, name), options={"joint_map": joint_map})
    assert torch.equal(found.qpos, load([ANY] * 2).qpos)


def test_a_map_wins_over_what_names_suggest(load, kinematics):
    clip = load([ANY] * 2, options={"joint_map": {"chest": "Spine"}})
    _, orientations = kinematics(clip)
    turn = (ANY["Hips"] * ANY["Spine"]).as_matrix()
    np.testing.assert_allclose(orientations["chest"], FORWARD @ turn @ FORWARD.T, atol=1e-7)


def test_a_body_without_arms_will_do_for_the_biped(load):
    legs = [joint for joint in BODY if not re.search("Arm|Hand|Shoulder|Head|Neck", joint[0])]
    with pytest.raises(MotionFormatError, match=r"no joint known as chest: .* its joints are Hips, Spine"):
        load([{}] * 2, "biped", body=legs)
    assert load([{}] * 2, "biped", body=legs, options={"joint_map": {"chest": "Chest"}}).character == "biped"
    with pytest.raises(MotionFormatError, match="no joint known as chest, neck, right_shoulder, right_elbow"):
        load([{}] * 2, "humanoid", body=legs)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joint_map": {"left_knee": "Nowhere"}}, r"motion\.bvh: has no joint 'Nowhere': its joints are Hips"),
        ({"joint_map": {"tail": "Hips"}}, "joint_map has tail: the parts of the body are root, chest"),
        ({"joint_map": {"left_wrist": "LeftForeArm"}}, r"motion\.bvh:\d+: left_elbow and left_wrist come closer"),
        ({"scale": 0}, "scale=0 is no unit"),
        ({"scale": float("nan")}, "scale=nan is no unit"),
        ({"rate": -1}, "rate=-1 leaves less than two frames"),
        ({"skip": 3}, "skip=3 leaves less than two frames of 4"),
        ({"skip": -1}, "skip=-1 leaves"),
        ({"rest_frame": 4}, r"rest_frame=4 does not exist: pass one of 0\.\.3"),
        ({"character": "trex"}, "character='trex' has not the joints of a human body"),
    ],
)
def test_arguments_out_of_range_are_named(load, options, message):
    options = dict(options)
    with pytest.raises(ValueError, match=message):
        load([{}] * 4, options.pop("character", "humanoid"), options=options)


def test_a_t_pose_before_the_motion_is_found_by_its_jump_and_can_be_left_out(load):
    poses, path = [{}, arms_down(), arms_down()], [(0, 0, 0), (3, 0.9, 1), (3, 0.9, 1.01)]
    header = bvh(poses, path=path).splitlines().index("Frame Time: 0.03333333333333333") + 1
    with pytest.raises(
        MotionFormatError, match=rf"motion\.bvh:{header + 2}: root jumps between frames 1 and 2.*T-pose"
    ):
        load(poses, path=path)
    clip = load(poses, path=path, options={"skip": 1})
    assert clip.duration == pytest.approx(1 / 30)


def test_a_t_pose_in_place_is_found_by_the_arms(load):
    with pytest.raises(MotionFormatError, match="right_elbow jumps between frames 1 and 2"):
        load([{}, arms_down(), arms_down()], fps=120.0)


def test_a_jump_later_on_is_named_by_its_line(load):
    path = [(0, 0.9, 0)] * 5 + [(4, 0.9, 0)] * 5
    with pytest.raises(MotionFormatError, match=r":\d+: root jumps between frames 5 and 6, .*: cut the file there"):
        load([{}] * 10, path=path)


def reflected(pose):
    """The mirror image of a pose: left and right change places, and rotations about y and z their sense."""

    def other(name):
        return name.replace("Left", "right").replace("Right", "Left").replace("right", "Right")

    return {other(name): Rotation.from_rotvec([1, -1, -1] * turn.as_rotvec()) for name, turn in pose.items()}


@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_the_mirror_image_of_a_motion_gives_the_mirror_image_of_the_clip(load, character):
    poses, path = [{}, ANY, arms_down()], np.array([(0, 0.9, 0), (0.2, 0.8, 0.1), (-0.1, 0.9, 0.4)])
    clip = load(poses, character, fps=2.0, path=path)
    other = load([reflected(pose) for pose in poses], character, fps=2.0, path=path * [-1, 1, 1])
    torch.testing.assert_close(other.qpos, clip.mirrored().qpos, rtol=0, atol=1e-7)


FRAMES = {name: about([index % 3, 1, index % 5 - 2], 40 * index) for index, (name, _, _) in enumerate(BODY)}
"""Each joint with axes of its own, as some programs write them: the rest pose is then no pose at all."""


def test_a_rest_pose_that_does_not_stand_is_refused(load):
    with pytest.raises(MotionFormatError, match=r"motion\.bvh: its rest pose does not stand .*rest frame"):
        load([{}] * 2, frames=FRAMES)


def test_a_frame_in_which_the_body_stands_takes_the_place_of_the_rest_pose(load):
    path = [(0, 0.9, 0), (0.1, 0.9, 0), (0.1, 0.9, 0)]
    expected = load([{}, ANY, ANY], fps=2.0, path=path)
    found = load([{}, ANY, ANY], fps=2.0, path=path, frames=FRAMES, options={"rest_frame": 0})
    torch.testing.assert_close(found.qpos, expected.qpos, rtol=0, atol=1e-7)


def test_the_frame_that_stands_may_be_left_out(load):
    expected = load([{}, ANY, ANY], fps=2.0, options={"skip": 1})
    found = load([{}, ANY, ANY], fps=2.0, frames=FRAMES, options={"skip": 1, "rest_frame": 0})
    torch.testing.assert_close(found.qpos, expected.qpos, rtol=0, atol=1e-7)


def test_the_clip_has_the_rate_asked_for(load):
    poses = [{"LeftLeg": about(X, degrees)} for degrees in range(0, 61, 10)]
    clip = load(poses, fps=60.0, options={"rate": 40.0})
    assert (clip.fps, len(clip.qpos), clip.loop) == (40.0, 5, False)
    np.testing.assert_allclose(hinge(clip, "left_knee"), -np.radians([0, 15, 30, 45, 60]), atol=1e-7)


def test_the_frame_rate_of_the_user_wins(load):
    assert load([{}] * 11, fps=60.0, options={"fps": 10.0}).duration == pytest.approx(1.0)


@pytest.mark.parametrize("name", ["motion.fbx", "motion", "motion.asf"])
def test_a_file_of_another_kind_is_refused(tmp_path, name):
    (tmp_path / name).write_text("?")
    with pytest.raises(MotionFormatError, match="ends in none of"):
        import_motion(tmp_path / name, "humanoid")


@pytest.mark.parametrize("option", [{"scale": 1.0}, {"skip": 1}, {"rest_frame": 0}, {"joint_map": {"neck": "x"}}])
def test_options_without_meaning_for_files_of_deepmimic_are_refused(tmp_path, option):
    with pytest.raises(ValueError, match=f"{next(iter(option))} does not apply to .*motion.txt"):
        import_motion(tmp_path / "motion.txt", "humanoid", **option)


VALUES = st.floats(-1e7, 1e7) | st.floats(-180, 180) | st.sampled_from([0.0, 90.0, 180.0])
SOME_MOTION = bvh([{}, ANY, {}], fps=2.0)


@settings(max_examples=50)
@given(st.lists(st.tuples(st.integers(0, 10**6), VALUES), max_size=8), st.sampled_from([None, 0, 1]))
def test_no_numbers_raise_another_error(tmp_path_factory, changes, rest_frame):
    words = SOME_MOTION.replace("\n", " \n ").split(" ")
    numbers = [place for place, word in enumerate(words) if "." in word]
    for place, value in changes:
        words[numbers[place % len(numbers)]] = repr(value)
    path = tmp_path_factory.getbasetemp() / "any.bvh"
    path.write_text(" ".join(words))
    with suppress(MotionFormatError):
        import_motion(path, "humanoid", rest_frame=rest_frame)
