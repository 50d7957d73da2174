"""What keeps a body from being a character is listed with remedies, and what can be converted is."""

from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest

from torchrl_mcp.envs.characters import CHARACTERS, Character
from torchrl_mcp.envs.characters.adapt import LIMIT_ANGLE, adapted, key_bodies
from torchrl_mcp.envs.characters.contract import lowest_bodies, violations

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
GAINS = 'kp="80" kv="7" ctrlrange="-1 1"'
BODY = """
<mujoco>
  <option timestep="0.008333333333"/>
  <worldbody>{scenery}
    <body name="root" pos="0 0 {height}">{root}
      <geom type="{shape}" size="0.1 0.1 0.1" contype="{contype}"/>
      <body name="left_leg" pos="0 0.1 0">{joint}
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05" contype="0"/>
      </body>
      <body name="{right}" pos="0 -0.1 0"><joint name="{right}"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuator}<position name="{right}" joint="{right}" kp="80" kv="7" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
GOOD = {
    "scenery": "",
    "height": 0.55,
    "root": "<freejoint/>",
    "shape": "sphere",
    "contype": 0,
    "joint": '<joint name="left_leg"/>',
    "right": "right_leg",
    "actuator": f'<position name="left_leg" joint="left_leg" {GAINS}/>',
}
WRONG = {
    "floor": ({"scenery": '<geom name="lawn" type="plane" size="1 1 1"/>'}, "scenery of its own (lawn)"),
    "light": ({"scenery": "<light/>"}, "1 light(s) of its own"),
    "no free root": ({"root": ""}, "the root root has no free joint"),
    "two roots": ({"scenery": "<body><geom size='0.1' pos='0 0 1'/></body>"}, "2 bodies that hang on the world"),
    "high": ({"height": 0.75}, "rests +0.200 m above the ground: lower the root by 0.200 m"),
    "collisions": ({"contype": 1}, "its shapes collide with one another"),
    "shape": ({"shape": "cylinder"}, "shapes of kind mjGEOM_CYLINDER: use spheres, capsules and boxes"),
    "motor": (
        {"actuator": '<motor name="left_leg" joint="left_leg" ctrlrange="-1 1"/>'},
        "no position servos (left_leg)",
    ),
    "unlimited": ({"actuator": '<position name="left_leg" joint="left_leg" kp="80"/>'}, "no ctrlrange (left_leg)"),
    "no actuator": ({"actuator": ""}, "lacks the actuators left_leg"),
    "other joint": (
        {"joint": '<joint name="hip"/>', "actuator": f'<position name="left_leg" joint="hip" {GAINS}/>'},
        "the joint of left_leg is called hip: call it left_leg",
    ),
    "hinges": (
        {"joint": '<joint name="left_leg"/><joint name="b" axis="1 0 0"/>'},
        "left_leg has several hinges (left_leg, b) where a ball is expected",
    ),
    "slide": ({"joint": '<joint name="left_leg" type="slide"/>'}, "neither a hinge nor a ball"),
    "limits": ({"joint": '<joint name="left_leg" range="10 50"/>'}, "left_leg rests beyond the limits"),
    "twin": ({"right": "right_arm"}, "has no twin on the other side"),
}


def found(file=None, feet=("left_leg",), **changes):
    model = (
        mujoco.MjModel.from_xml_path(str(file))
        if file
        else mujoco.MjModel.from_xml_string(BODY.format(**GOOD | changes))
    )
    return [str(violation) for violation in violations(model, feet=feet)]


@pytest.mark.parametrize("name", CHARACTERS)
def test_the_librarys_characters_keep_the_contract(name):
    assert CHARACTERS[name].check() == []


def test_a_small_character_keeps_it():
    assert found() == []


@pytest.mark.parametrize(("changes", "said"), WRONG.values(), ids=WRONG)
def test_each_violation_is_said_with_its_remedy(changes, said):
    assert any(said in violation and ": " in violation for violation in found(**changes)), found(**changes)


@pytest.mark.parametrize(("feet", "said"), [((), "no feet are named"), (("hoof",), "feet names hoof, which it lacks")])
def test_feet_must_be_bodies(feet, said):
    (violation,) = found(feet=feet)
    assert said in violation


def test_a_timestep_must_divide_the_control_step():
    model = mujoco.MjModel.from_xml_string(BODY.format(**GOOD).replace("0.008333333333", "0.003"))
    (violation,) = violations(model, feet=["left_leg"])
    assert "does not divide 1/30 s" in str(violation)


def test_gymnasiums_humanoid_fails_for_its_motors_hinges_floor_and_height():
    said = "\n".join(found(ASSETS / "humanoid.xml"))
    for part in ("17 actuators are no position servos", "right_thigh has several hinges", "(floor)", "rests +0.107 m"):
        assert part in said


@pytest.fixture(scope="module")
def gymnast():
    before = mujoco.MjModel.from_xml_path(str(ASSETS / "humanoid.xml"))
    return before, adapted(before).compile()


def test_adapted_gymnasiums_humanoid_keeps_the_contract(gymnast):
    _, after = gymnast
    lowest, feet = lowest_bodies(after)
    assert feet == ["right_foot", "left_foot"]
    assert lowest == pytest.approx(0, abs=1e-9)
    assert violations(after, feet=feet, key_bodies=key_bodies(after)) == []


def test_adapting_keeps_masses_inertias_and_shapes(gymnast):
    before, after = gymnast
    for name in ("body_mass", "body_inertia", "body_ipos"):
        np.testing.assert_allclose(getattr(after, name), getattr(before, name), atol=1e-12)
    np.testing.assert_allclose(after.geom_size, before.geom_size[1:])  # the first is the floor


def test_servos_hold_the_torques_of_the_motors_and_reach_them_at_the_angle_stated(gymnast):
    before, after = gymnast
    motor, servo = before.actuator("right_knee"), after.actuator("right_shin")
    assert servo.forcerange[1] == pytest.approx(motor.gear[0] * motor.ctrlrange[1])
    assert servo.gainprm[0] * LIMIT_ANGLE == pytest.approx(servo.forcerange[1])


def test_the_ranges_of_a_balls_targets_hold_those_of_its_hinges(gymnast):
    before, after = gymnast
    for axis in "xyz":
        low, high = before.joint(f"right_hip_{axis}").range
        ends = after.actuator(f"right_thigh_{axis}").ctrlrange
        assert ends[0] <= low
        assert ends[1] >= high


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"joint": '<joint name="left_leg" type="slide"/>'}, "left_leg has a joint that is neither hinge nor ball"),
        ({"root": ""}, "give the root a freejoint"),
    ],
)
def test_what_cannot_be_converted_is_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        adapted(mujoco.MjModel.from_xml_string(BODY.format(**GOOD | changes)))


def test_a_joint_without_a_motor_can_hold_what_hangs_on_it():
    body = BODY.format(**GOOD | {"actuator": ""})
    model = adapted(mujoco.MjModel.from_xml_string(body)).compile()
    mass, lever = model.body("left_leg").mass[0], 0.25
    assert model.actuator("left_leg").forcerange[1] > 2 * mass * 9.81 * lever


def test_a_character_may_have_a_file_of_its_own(tmp_path):
    (tmp_path / "mine.xml").write_text(BODY.format(**GOOD))
    mine = Character("mine", feet=("left_leg", "right_leg"), key_bodies=(), carrier=None, file=tmp_path / "mine.xml")
    assert mine.check() == []
    assert mine.spec().compile().nu == 2
