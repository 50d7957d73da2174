"""Bodies made for other purposes become characters: torques and gains, pose, root, feet, sides, and what is refused."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from refusals import refused

from torchrl_mcp.envs import Heading
from torchrl_mcp.envs.characters import CHARACTERS, Character
from torchrl_mcp.envs.characters.adapt import BEYOND, adapted, key_bodies
from torchrl_mcp.envs.characters.contract import lowest_bodies, violations
from torchrl_mcp.envs.characters.drives import LIMIT_ANGLE
from torchrl_mcp.envs.characters.files import float_trunk
from torchrl_mcp.envs.characters.mirror import guessed_sides, twin

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
ROBOT = """
<mujoco>
  {option}
  <worldbody>{scenery}
    <body name="trunk" pos="0 0 1"><freejoint/>
      <geom name="belly" type="box" size="0.1 0.15 0.1" mass="{mass}"/>
      <body name="right_thigh" pos="0 -0.1 0"><joint name="right_hip" axis="0 1 0" range="-1.5 1.5" {hip}/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04" mass="1"/>
        <body name="right_shin" pos="0 0 -0.4"><joint name="right_knee" axis="0 1 0" range="{bent}" {knee}/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.5"/>
          <geom name="right_sole" type="box" pos="0.05 0 -0.35" size="0.15 0.05 0.05" mass="0.5"/>
        </body>
      </body>
      <body name="left_thigh" pos="0 0.1 0"><joint name="left_hip" axis="0 1 0" range="-1.5 1.5" {hip}/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04" mass="1"/>
        <body name="left_shin" pos="0 0 -0.4"><joint name="left_knee" axis="0 1 0" range="{bent}" {knee}/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.03" mass="0.5"/>
          <geom name="left_sole" type="box" pos="0.05 0 -0.35" size="0.15 0.05 0.05" mass="0.5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>{actuators}</actuator>
  <keyframe><key name="crouch" qpos="3 2 1 1 0 0 0 -0.5 1 -0.5 1"/></keyframe>
</mujoco>
"""
PLAIN = {"option": "", "scenery": "", "mass": 30, "hip": "", "knee": "", "bent": "-0.1 2", "actuators": ""}
SERVOS = "".join(
    f'<position joint="{side}_{joint}" kp="500" kv="20" ctrlrange="-2 2"/>'
    for side in ("right", "left")
    for joint in ("hip", "knee")
)

MOTOR = '<motor joint="right_knee" gear="30" ctrlrange="-1 1"'


def robot(**changes):
    return mujoco.MjModel.from_xml_string(ROBOT.format(**PLAIN | changes))


@pytest.fixture(scope="module")
def gymnast():
    before = mujoco.MjModel.from_xml_path(str(ASSETS / "humanoid.xml"))
    return before, adapted(before, pose=["knee=-0.035"])


def test_gymnasiums_humanoid_becomes_a_character_that_cannot_stand_still(gymnast):
    _, body = gymnast
    model = body.spec.compile()
    lowest, feet = lowest_bodies(model)
    assert (body.root, list(body.feet), body.sides) == ("torso", feet, (("right_", "left_"),))
    assert feet == ["right_foot", "left_foot"]
    assert lowest == pytest.approx(0, abs=1e-9)
    (violation,) = violations(body.spec, feet=feet, key_bodies=key_bodies(model))  # it has no ankles
    assert violation.finding.startswith("does not hold its rest pose: it topples after 1.")


def test_adapting_keeps_masses_inertias_and_shapes(gymnast):
    before, after = gymnast[0], gymnast[1].spec.compile()
    for name in ("body_mass", "body_inertia", "body_ipos"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-12)
    np.testing.assert_allclose(after.geom_size, before.geom_size[1:])  # the first is the floor


def test_servos_hold_the_torques_of_motors_and_reach_them_at_the_angle_stated(gymnast):
    before, after = gymnast[0], gymnast[1].spec.compile()
    motor, servo = before.actuator("right_elbow"), after.actuator("right_lower_arm")
    assert servo.forcerange[1] == pytest.approx(motor.gear[0] * motor.ctrlrange[1])
    assert servo.gainprm[0] * LIMIT_ANGLE == pytest.approx(servo.forcerange[1])


def test_the_ranges_of_a_balls_targets_hold_those_of_its_hinges(gymnast):
    before, after = gymnast[0], gymnast[1].spec.compile()
    for axis in "xyz":
        low, high = before.joint(f"right_hip_{axis}").range
        ends = after.actuator(f"right_thigh_{axis}").ctrlrange
        assert ends[0] <= low
        assert ends[1] >= high


@pytest.mark.parametrize(
    ("changes", "torque", "gain"),
    [
        ({"knee": 'actuatorfrcrange="-139 139"', "actuators": SERVOS}, (139, "file"), (500, "file")),
        ({"actuators": SERVOS.replace("ctrl", 'forcerange="-90 90" ctrl')}, (90, "file"), (500, "file")),
        (
            {"knee": 'actuatorfrcrange="-50 50"', "actuators": SERVOS.replace("ctrl", 'forcerange="-90 90" ctrl')},
            (50, "file"),
            (500, "file"),
        ),
        ({"actuators": SERVOS.replace("kp", 'gear="2" kp')}, None, (4 * 500, "file")),
        ({"actuators": '<motor joint="right_knee" gear="30" ctrlrange="-1 2"/>'}, (60, "file"), None),
        ({"actuators": f'{MOTOR} forcerange="-5 5"/>'}, (30, "file"), None),
        ({"actuators": f'{MOTOR} forcerange="-0.5 0.5"/>'}, (15, "file"), None),
        ({"knee": 'actuatorfrcrange="-50 50"'}, (50, "file"), None),
    ],
)
def test_torques_and_gains_are_those_of_the_file(changes, torque, gain):
    drive = adapted(robot(**changes)).drives["right_shin"]
    assert torque is None or (drive.torque, drive.torque_from) == torque
    assert gain is None or (drive.gain, drive.gain_from) == gain
    assert None not in (torque, gain) or "guessed" in (drive.torque_from, drive.gain_from)


def test_the_written_servo_has_the_drive_that_is_reported():
    body = adapted(robot(knee='actuatorfrcrange="-139 139"', actuators=SERVOS))
    servo = body.spec.compile().actuator("right_shin")
    assert (servo.gainprm[0], -servo.biasprm[1], -servo.biasprm[2]) == (500, 500, 20)
    assert servo.forcerange.tolist() == [-139, 139]


def test_every_hinge_of_several_keeps_its_torque_and_what_is_joined_is_told():
    hip = '<joint axis="{}" pos="{} 0 0" range="-1 1" actuatorfrcrange="-{} {}"/>'
    hips = hip.format("1 0 0", 0, 60, 60) + hip.format("0 0 1", 0.02, 20, 20)
    xml = ROBOT.format(**PLAIN).partition("<keyframe>")[0] + "</mujoco>"
    xml = xml.replace('<joint name="right_hip" axis="0 1 0" range="-1.5 1.5" />', hips)
    xml = xml.replace('name="right_thigh"', 'name="right_thigh" gravcomp="0.5"')
    body = adapted(mujoco.MjModel.from_xml_string(xml))
    model = body.spec.compile()
    ranges = {axis: model.actuator(f"right_thigh_{axis}").forcerange.tolist() for axis in "xyz"}
    assert ranges == {"x": [-60, 60], "y": [-20, 20], "z": [-20, 20]}
    assert model.joint("right_thigh").pos.tolist() == [0.01, 0, 0]
    assert model.body_gravcomp[model.body("right_thigh").id] == 0.5
    assert body.drives["right_thigh"].remark == (
        "a ball for 2 hinges, whose anchors are one, up to 1 cm away, torques 60, 20, 20 about x, y, z"
    )


def test_shapes_that_touch_in_named_pairs_alone_are_feet():
    xml = ROBOT.format(**PLAIN | {"scenery": '<geom name="floor" type="plane" size="1 1 1"/>'})
    xml = xml.replace("<geom ", '<geom contype="0" conaffinity="0" ')
    pairs = "".join(f'<pair geom1="floor" geom2="{side}_sole"/>' for side in ("right", "left"))
    body = adapted(mujoco.MjModel.from_xml_string(xml.replace("<actuator>", f"<contact>{pairs}</contact><actuator>")))
    assert body.feet == ("right_shin", "left_shin")
    assert lowest_bodies(body.spec.compile())[1] == ["right_shin", "left_shin"]


def test_a_leg_without_motors_can_carry_the_weight_above_it():
    drive = adapted(robot()).drives["right_shin"]
    above = 9.81 * (30 + 2 * (1 + 0.5 + 0.5) - 1)  # all but this shin with its sole, on one leg
    lever = np.linalg.norm([0.2, 0.05, 0.4])  # from the knee to the corner of the sole
    assert (drive.torque_from, drive.gain_from) == ("guessed", "guessed")
    assert drive.torque == pytest.approx(above * lever)


def test_a_guessed_gain_is_twice_that_at_which_gravity_topples_what_a_leg_carries():
    model = robot(knee='actuatorfrcrange="-1 1"')
    posed = mujoco.MjData(model)
    mujoco.mj_forward(model, posed)
    shin = model.body("right_shin").id
    mass, total = model.body_subtreemass[[shin, 1]]
    above = (total * posed.subtree_com[1, 2] - mass * posed.subtree_com[shin, 2]) / (total - mass) - 0.6
    drive = adapted(model).drives["right_shin"]
    assert drive.gain == pytest.approx(2 * (total - mass) * 9.81 * above / 2)  # on two feet


def test_an_arm_without_a_motor_can_hold_three_times_what_hangs_on_it():
    arm = '<joint name="arm" axis="0 1 0"/><geom size="0.02" pos="0.5 0 0" mass="2"/>'
    body = f'<body name="arm" pos="0 0 0.1">{arm}</body>'
    text = ROBOT.format(**PLAIN).replace('<body name="right_thigh"', f'{body}<body name="right_thigh"')
    text = text.replace('qpos="3 2 1 1 0 0 0 ', 'qpos="3 2 1 1 0 0 0 0 ')
    assert adapted(mujoco.MjModel.from_xml_string(text)).drives["arm"].torque == pytest.approx(3 * 2 * 9.81 * 0.5)


def test_the_user_may_give_torques_and_gains_by_patterns_of_which_the_last_wins():
    torques, gains = {".": 10.0, "knee": 139.0, "left_shin": 5.0}, {"hip|thigh": 321.0}
    drives = adapted(robot(actuators=SERVOS), torques=torques, gains=gains).drives
    assert {name: drive.torque for name, drive in drives.items()} == {
        "right_thigh": 10,
        "right_shin": 139,
        "left_thigh": 10,
        "left_shin": 5,
    }
    assert [(drive.gain, drive.gain_from) for drive in drives.values()] == [(321, "given"), (500, "file")] * 2


def test_what_resists_a_joint_is_kept_and_what_is_raised_is_named():
    resisted = 'stiffness="7" springref="10" frictionloss="0.3" damping="4" armature="0.001"'
    body = adapted(robot(knee=resisted, actuators=SERVOS))
    joint, drive = body.spec.compile().joint("right_shin"), body.drives["right_shin"]
    assert (joint.stiffness[0], joint.damping[0]) == (7, 4)
    assert joint.frictionloss[0] == pytest.approx(0.3)
    assert joint.qpos_spring[0] == pytest.approx(np.radians(10))
    assert joint.armature[0] > 0.001
    assert drive.remark == "armature 0.001 raised"
    assert adapted(robot(knee='armature="1"', actuators=SERVOS)).drives["right_shin"].armature == 1


def test_a_joint_without_limits_is_pointed_out():
    model = robot()
    model.jnt_limited[model.joint("right_knee").id] = 0
    drives = adapted(model).drives
    assert "1.57 rad" in drives["right_shin"].remark
    assert drives["left_shin"].remark == ""


def test_ranges_are_kept():
    assert adapted(robot()).ranges["right_shin"] == pytest.approx((np.radians(-0.1), np.radians(2)))


POSES = {"a keyframe": ["crouch"], "angles": ["hip=-0.5", "knee=1"], "both": ["crouch", "hip=-0.5"]}


@pytest.mark.parametrize("pose", POSES.values(), ids=POSES)
def test_the_rest_pose_can_be_a_keyframe_or_angles(pose):
    wide = robot(bent="-10 150")
    wide.jnt_range[1:] = [-2.0, 2.0]
    body = adapted(wide, pose=pose)
    model, data, source = body.spec.compile(), mujoco.MjData(body.spec.compile()), mujoco.MjData(wide)
    mujoco.mj_kinematics(model, data)
    source.qpos[:] = wide.key_qpos[0]
    mujoco.mj_kinematics(wide, source)
    np.testing.assert_allclose(model.qpos0[7:], [-0.5, 1, -0.5, 1])
    np.testing.assert_allclose(data.xpos[1:] - data.xpos[1], source.xpos[1:] - source.xpos[1], atol=1e-12)
    np.testing.assert_allclose(data.xpos[1, :2], 0)


def test_the_action_zero_is_the_rest_pose(tmp_path, monkeypatch):
    wide = robot(bent="-10 150", actuators=SERVOS)
    wide.jnt_range[1:] = [-2.0, 2.0]
    body = adapted(wide, pose=["crouch"])
    body.spec.compile()
    (tmp_path / "croucher.xml").write_text(body.spec.to_xml())
    croucher = Character("croucher", body.feet, (), None, tmp_path / "croucher.xml")
    monkeypatch.setitem(CHARACTERS, "croucher", croucher)
    env = Heading("croucher", num_envs=1, seed=0)
    env.step(env.reset().set("action", torch.zeros(1, 4)))
    np.testing.assert_allclose(env.simulation.state["ctrl"][0], [-0.5, 1, -0.5, 1], atol=1e-9)
    env.step(env.reset().set("action", torch.full((1, 4), 0.1)))
    np.testing.assert_allclose(
        env.simulation.state["ctrl"][0], np.add([-0.5, 1, -0.5, 1], 0.1 * BEYOND * 2.0), atol=1e-6
    )


BALL = '<body name="ball" pos="2 0 1"><freejoint/><geom name="ball_shape" size="0.1"/></body>'


def test_the_root_is_the_body_that_carries_most_or_the_one_that_is_named():
    model = robot(scenery=BALL)
    model = mujoco.MjModel.from_xml_string(
        ROBOT.format(**PLAIN | {"scenery": BALL}).replace('"3 2 1', '"2 0 1 1 0 0 0 3 2 1')
    )
    body = adapted(model)
    assert (body.root, body.left_out) == ("trunk", {"body": ["ball"], "shape": ["ball_shape"], "keyframe": ["crouch"]})
    assert adapted(model, root="trunk").root == "trunk"
    refused(lambda: adapted(model, root="chest"), "chest", "trunk")


def test_a_root_without_joint_gets_a_free_joint():
    text = ROBOT.format(**PLAIN).replace("<freejoint/>", "").replace("3 2 1 1 0 0 0 ", "")
    model = adapted(mujoco.MjModel.from_xml_string(text)).spec.compile()
    assert model.jnt_type.tolist() == [0, 3, 3, 3, 3]


def test_a_root_that_lies_on_the_ground_is_refused():
    ant = mujoco.MjModel.from_xml_path(str(ASSETS / "ant.xml"))
    refused(lambda: adapted(ant), "ankle_1")
    ant.jnt_limited[:] = 0
    refused(lambda: adapted(ant), "torso", "--pose", "--feet")
    assert adapted(ant, feet=["torso"]).feet == ("torso",)
    standing = adapted(ant, pose=["ankle_[14]=1", "ankle_[23]=-1"])
    assert standing.feet == ("body_4", "body_7", "body_10", "body_13")
    refused(lambda: adapted(ant, feet=["hoof"]), "hoof")


@pytest.mark.parametrize("size", [1.0, 0.01])
def test_what_is_written_can_be_read_however_small(size):
    """A rod's principal moments are a, a and nearly 0, which rounding makes impossible."""
    model = robot()
    model.body_mass *= size**3
    model.body_inertia[2] = size**5 * np.array([0.01, 0.01 - 1e-9, 1e-9])
    body = adapted(model)
    body.spec.compile()
    again = mujoco.MjModel.from_xml_string(body.spec.to_xml())
    np.testing.assert_allclose(
        again.body_inertia[2], model.body_inertia[2], rtol=1e-4, atol=1.2e-4 * 0.01 * size**5 + 1e-10
    )


@pytest.mark.parametrize(
    ("names", "sides"),
    [
        (["trunk", "FR_hip", "FL_hip", "RR_hip", "RL_hip"], (("FR_", "FL_"), ("RR_", "RL_"))),
        (["thorax", "coxa_T1_left", "coxa_T1_right"], (("_right", "_left"),)),
        (["root", "right_leg", "left_leg"], (("right_", "left_"),)),
        (["root", "right_leg", "left_arm"], ()),
        (["root", "toe_R", "toe_L", "R_ear"], (("_R", "_L"),)),
        (["base", "RF_HIP", "LF_HIP", "RH_HIP", "LH_HIP"], (("RF_", "LF_"), ("RH_", "LH_"))),  # ANYmal
        (["body", "fr_hip", "fl_hip", "hr_hip", "hl_hip"], (("fr_", "fl_"), ("hr_", "hl_"))),  # Spot
        (["torso", "abduct_fr", "abduct_fl", "knee_hr", "knee_hl"], (("_fr", "_fl"), ("_hr", "_hl"))),  # Mini Cheetah
        (["pelvis", "left-foot", "right-foot"], (("right", "left"),)),  # Cassie
        (["Trunk", "Shank_Left", "Shank_Right", "left_foot", "right_foot"], (("right_", "left_"), ("Right", "Left"))),
        (["root", "right_leg", "left_leg", "upright"], (("right_", "left_"),)),
    ],
)
def test_sides_are_guessed_where_names_come_in_pairs(names, sides):
    assert guessed_sides(names) == sides


def test_a_twin_is_the_same_part_on_the_other_side():
    sides = (("FR_", "FL_"), ("_R", "_L"))
    names = ["FR_calf", "FL_calf", "toe_R", "toe_L", "trunk"]
    assert [twin(name, sides) for name in names] == ["FL_calf", "FR_calf", "toe_L", "toe_R", "trunk"]


TENDONS = """<tendon><fixed name="right_pull"><joint joint="right_knee" coef="1"/></fixed></tendon>
<equality><joint name="coupled" joint1="left_knee" joint2="right_knee"/></equality>
<sensor><jointpos name="angle" joint="left_knee"/></sensor>"""


def with_tendon(actuators):
    text = ROBOT.format(**PLAIN | {"actuators": actuators, "knee": 'stiffness="7" damping="0.2"'})
    return mujoco.MjModel.from_xml_string(text.replace("</mujoco>", f"{TENDONS}</mujoco>"))


HIPS = '<motor name="r" joint="right_hip" gear="9"/><motor name="l" joint="left_hip" gear="9"/>'


def test_a_joint_on_which_no_actuator_acts_stays_passive_with_its_spring():
    body = adapted(with_tendon(HIPS))
    model = body.spec.compile()
    assert [model.actuator(index).name for index in range(model.nu)] == ["right_thigh", "left_thigh"]
    assert (body.drives["right_shin"].torque_from, body.drives["left_shin"].torque_from) == ("passive", "passive")
    knee = model.joint("right_shin")
    assert (knee.stiffness[0], knee.damping[0], knee.armature[0]) == (7, 0.2, 0)


def test_a_gain_alone_leaves_a_joint_passive_and_says_so():
    drives = adapted(with_tendon(HIPS), gains={".": 50.0}).drives
    assert (drives["right_shin"].torque_from, drives["right_thigh"].gain) == ("passive", 50)
    assert "--torque" in drives["right_shin"].remark
    assert "--torque" not in drives["right_thigh"].remark


def test_a_hinge_without_a_motor_beside_one_with_a_motor_is_named():
    hip = '<joint name="right_hip"'
    text = ROBOT.format(**PLAIN | {"actuators": HIPS})
    text = text.replace(hip, f'<joint name="right_roll" axis="1 0 0" range="-0.3 0.3"/>{hip}')
    drives = adapted(
        mujoco.MjModel.from_xml_string(text.replace("<keyframe>", "<!--").replace("</keyframe>", "-->"))
    ).drives
    assert "right_roll" in drives["right_thigh"].remark
    assert "right_hip" not in drives["right_thigh"].remark


def test_a_torque_that_is_given_makes_a_passive_joint_driven():
    drives = adapted(with_tendon(HIPS), torques={"knee": 50.0}).drives
    assert {name: drive.torque for name, drive in drives.items() if "shin" in name} == {
        "right_shin": 50,
        "left_shin": 50,
    }


def test_a_joint_that_a_motor_drives_through_a_tendon_is_not_passive():
    body = adapted(with_tendon(HIPS + '<motor name="pull" tendon="right_pull"/>'))
    assert (body.drives["right_shin"].torque_from, body.drives["left_shin"].torque_from) == ("guessed", "passive")
    assert body.left_out["actuator"] == ["pull"]


def test_everything_left_out_is_listed_by_kind_and_name():
    assert adapted(with_tendon(HIPS)).left_out == {
        "tendon": ["right_pull"],
        "equality constraint": ["coupled"],
        "sensor": ["angle"],
        "keyframe": ["crouch"],
    }


def test_joints_that_are_passive_on_both_sides_keep_the_contract_and_those_on_one_side_break_it():
    def findings(torques):
        body = adapted(with_tendon(HIPS), torques=torques)
        return [violation.finding for violation in violations(body.spec, feet=body.feet, sides=body.sides)]

    assert not [finding for finding in findings({}) if "actuators" in finding]
    assert "lacks the actuators right_shin" in findings({"left_knee": 50.0})


@pytest.mark.parametrize("size", [0.05, 1.0, 4.0])
def test_the_same_bodies_are_feet_whatever_the_size(size):
    model = robot()
    for lengths in (model.body_pos, model.body_ipos, model.geom_pos, model.geom_size, model.jnt_pos):
        lengths *= size
    model.qpos0[:3] *= size
    assert adapted(model).feet == ("right_shin", "left_shin")


def test_legs_that_end_a_little_above_the_others_have_feet():
    spec = mujoco.MjSpec.from_string(FIXED_DOG)
    float_trunk(spec)
    for side in ("hr", "hl"):
        spec.body(f"{side}_leg").pos[2] = 0.025  # the trunk is 0.3 m above the ground
    assert sorted(adapted(spec.compile()).feet) == ["fl_leg", "fr_leg", "hl_leg", "hr_leg"]
    for side in ("hr", "hl"):
        spec.body(f"{side}_leg").pos[2] = 0.05
    assert sorted(adapted(spec.compile()).feet) == ["fl_leg", "fr_leg"]


def test_a_limb_has_at_most_two_feet_and_a_tail_is_none():
    tail = '<body name="tail" pos="-0.5 0 0"><geom type="capsule" size="0.02" fromto="0 0 0 0 0 -0.78"/></body>'
    text = ROBOT.format(**PLAIN).replace('<body name="right_thigh"', f'{tail}<body name="right_thigh"')
    for side in ("right", "left"):
        ends = "".join(f'<body name="{side}_{end}" pos="0.1 0 0"><geom size="0.05" pos="0 0 -0.35"/>' for end in "abc")
        sole = f'<geom name="{side}_sole" type="box" pos="0.05 0 -0.35" size="0.15 0.05 0.05" mass="0.5"/>'
        text = text.replace(sole, sole + ends + "</body>" * 3)
    body = adapted(mujoco.MjModel.from_xml_string(text))
    assert body.feet == ("right_b", "right_c", "left_b", "left_c")


DOG = """<robot name="dog">
<link name="base"/>
<joint name="fix" type="fixed"><parent link="base"/><child link="trunk"/></joint>
<link name="trunk"><inertial><mass value="10"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>
</inertial><collision><geometry><box size="0.4 0.2 0.1"/></geometry></collision></link>{legs}</robot>"""
LEG = """<joint name="{side}_hip" type="revolute"><parent link="trunk"/><child link="{side}_leg"/>
<origin xyz="{x} {y} 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="30" velocity="9"/></joint>
<link name="{side}_leg"><inertial><origin xyz="0 0 -.15"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="0 0 -.15"/><geometry><box size="0.04 0.04 0.3"/></geometry></collision></link>"""
FIXED_DOG = DOG.format(
    legs="".join(
        LEG.format(side=side, x=x, y=y)
        for side, x, y in [("fr", 0.2, -0.1), ("fl", 0.2, 0.1), ("hr", -0.2, -0.1), ("hl", -0.2, 0.1)]
    )
)


def test_a_floating_trunk_keeps_all_legs_and_its_mass():
    spec = mujoco.MjSpec.from_string(FIXED_DOG)
    float_trunk(spec)
    body = adapted(spec.compile())
    model = body.spec.compile()
    assert body.root == "base"
    assert model.body_mass.tolist() == [0, 10, 1, 1, 1, 1]
    assert sorted(body.feet) == ["fl_leg", "fr_leg", "hl_leg", "hr_leg"]


def test_a_trunk_that_cannot_float_is_named():
    spec = mujoco.MjSpec.from_string(ROBOT.format(**PLAIN))
    refused(lambda: float_trunk(spec), "--floating", "trunk")
    refused(lambda: float_trunk(spec, "right_shin"), "--floating", "right_shin")


BENT = f"{np.degrees(-2.82)} {np.degrees(-0.89)}"
SHIN = '<body name="left_shin" pos="0 0 -0.4">'
MESH = [
    ("<worldbody>", '<asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset><worldbody>'),
    (SHIN, f'{SHIN}<geom type="mesh" mesh="m"/>'),
]


def changed(*replacements):
    text = ROBOT.format(**PLAIN)
    for old, new in replacements:
        text = text.replace(old, new, 1)
    return mujoco.MjModel.from_xml_string(text)


@pytest.mark.parametrize(
    ("make", "options", "names"),
    [
        (robot, {"torques": {"ankle": 50.0}}, ["--torque ankle=50", "right_shin"]),
        (robot, {"gains": {"ankle": 50.0}}, ["--gain ankle=50", "right_shin"]),
        (robot, {"pose": ["kneel"]}, ["--pose kneel", "crouch"]),
        (robot, {"pose": ["ankle=1"]}, ["--pose ankle=1", "right_knee"]),
        (robot, {"pose": ["knee=bent"]}, ["--pose knee=bent"]),
        (robot, {"pose": ["knee(=1"]}, ["--pose knee(=1"]),
        (lambda: robot(bent=BENT), {}, ["--pose right_knee=-1.85 left_knee=-1.85"]),  # beyond its joints' ranges
        (lambda: changed(*MESH), {}, ["left_shin", "mjGEOM_MESH"]),
        (lambda: changed(('name="right_knee"', 'type="slide" name="right_knee"')), {}, ["right_shin"]),
        (lambda: mujoco.MjSpec.from_string(FIXED_DOG).compile(), {}, ["fr_leg", "hl_leg", "--floating"]),
    ],
)
def test_a_body_or_an_option_that_does_not_fit_is_refused(make, options, names):
    model = make()
    refused(lambda: adapted(model, **options), *names)
