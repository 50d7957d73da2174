"""Joints are found by the names that many makers give them, or by a map."""

import re

import numpy as np
import pytest
import torch

from torchrl_mcp.envs.motions.capture.importer import import_motion
from torchrl_mcp.envs.motions.errors import MotionFormatError

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
    "Hand": "Wrist",
}

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


VROID = {
    "UpLeg": "UpperLeg",
    "Leg": "LowerLeg",
    "Foot": "Foot",
    "Shoulder": "Shoulder",
    "Arm": "UpperArm",
    "ForeArm": "LowerArm",
}


def vroid(name):
    return limbs(name, "J_Bip_{side}_{part}", VROID) if name[:4] in ("Left", "Righ") else f"J_Bip_C_{name}"


CONVENTIONS = {
    "prefixed": lambda name: f"mixamorig:{name}",
    "3ds Max": lambda name: f"Bip01 {limbs(name, '{side} {part}', STUDIO)}",
    "Biovision": lambda name: limbs(name, "{long}{part}", BIOVISION),
    "SMPL": lambda name: limbs(name, "{side}_{part}", BIOVISION),
    "engine": lambda name: limbs(name, "{part}_{small}", ENGINE),
    "VRM": vroid,
    "CMU": lambda name: limbs(name, "{small}{part}", CMU),
}


@pytest.mark.parametrize("rename", CONVENTIONS.values(), ids=CONVENTIONS)
def test_joints_are_known_by_the_names_of_many_makers(load, rename, any_pose):
    assert torch.equal(load([any_pose] * 2, rename=rename).qpos, load([any_pose] * 2).qpos)


def test_other_names_are_given_by_a_map(load, any_pose):
    strange = {"LeftLeg": "Gauche2", "Head": "Tete"}
    joint_map = {"left_knee": "Gauche2", "neck": "Tete"}
    found = load([any_pose] * 2, rename=lambda name: strange.get(name, name), options={"joint_map": joint_map})
    assert torch.equal(found.qpos, load([any_pose] * 2).qpos)


def test_a_map_wins_over_what_names_suggest(load, kinematics, any_pose, forward):
    clip = load([any_pose] * 2, options={"joint_map": {"chest": "Spine"}})
    _, orientations = kinematics(clip)
    turn = (any_pose["Hips"] * any_pose["Spine"]).as_matrix()
    np.testing.assert_allclose(orientations["chest"], forward @ turn @ forward.T, atol=1e-7)


def test_a_body_without_arms_will_do_for_the_biped(load, skeleton):
    legs = [joint for joint in skeleton if not re.search("Arm|Hand|Shoulder|Head|Neck", joint[0])]
    with pytest.raises(MotionFormatError, match=r"no joint that is known as chest: .* its joints are Hips, Spine"):
        load([{}] * 2, "biped", body=legs)
    assert load([{}] * 2, "biped", body=legs, options={"joint_map": {"chest": "Chest"}}).character == "biped"
    with pytest.raises(MotionFormatError, match="no joint that is known as chest, neck, right_shoulder, right_elbow"):
        load([{}] * 2, "humanoid", body=legs)


def test_the_example_of_the_error_is_a_joint_of_that_name_or_none(load):
    with pytest.raises(
        MotionFormatError, match=r"no joint that is known as neck: .* such as neck=UpperHeadJoint; its joints"
    ):
        load([{}] * 2, rename=lambda name: {"Head": "UpperHeadJoint", "Neck": "LowerNeckJoint"}.get(name, name))
    with pytest.raises(MotionFormatError, match=r"such as neck=JOINT; its joints"):
        load([{}] * 2, rename=lambda name: {"Head": "Tete", "Neck": "Cou"}.get(name, name))
    with pytest.raises(MotionFormatError, match=r"such as left_knee=JOINT; its joints"):
        load([{}] * 2, rename=lambda name: {"LeftLeg": "Gauche2"}.get(name, name))


def test_the_example_of_the_error_is_no_end_site(bvh, tmp_path):
    text = bvh([{}] * 2, rename=lambda name: {"Head": "UpperHeadJoint", "Neck": "LowerNeckJoint"}.get(name, name))
    head = text.index("}", text.index("UpperHeadJoint"))
    path = tmp_path / "motion.bvh"
    path.write_text(f"{text[:head]}End Site\n{{\nOFFSET 0 0.1 0\n}}\n{text[head:]}")
    with pytest.raises(
        MotionFormatError, match=r"no joint that is known as neck: .* such as neck=UpperHeadJoint; its joints"
    ):
        import_motion(path, "humanoid")


@pytest.mark.parametrize("head", ["torso_head", "Head", "UpperNeck"])
def test_the_head_is_known_by_several_names(load, any_pose, head):
    found = load([any_pose] * 2, rename=lambda name: {"Head": head, "Neck": "Spine3"}.get(name, name))
    assert torch.equal(found.qpos, load([any_pose] * 2).qpos)


@pytest.mark.parametrize("part", ["neck", "left_knee", "right_shoulder"])
def test_no_limb_and_no_head_begins_at_the_root(load, part):
    with pytest.raises(
        MotionFormatError, match=rf"has its {part} on Hips, which carries the whole body: name with a map"
    ):
        load([{}] * 2, options={"joint_map": {part: "Hips"}})
