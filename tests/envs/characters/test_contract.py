"""What keeps a body from being a character is listed with remedies."""

from pathlib import Path

import gymnasium
import mujoco
import pytest

from torchrl_mcp.envs.characters import CHARACTERS, Character
from torchrl_mcp.envs.characters.contract import violations
from torchrl_mcp.envs.characters.mirror import without_mirror_image

ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
GAINS = 'kp="80" kv="7" ctrlrange="-1 1"'
BODY = """
<mujoco>
  <option timestep="0.008333333333"/>
  {default}
  <worldbody>{scenery}
    <body name="root" pos="0 0 {height}">{root}
      <geom type="{shape}" size="0.1 0.1 0.1" contype="{contype}"/>
      <body name="left_leg" pos="{left_at}" {turn}>{joint}
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05" contype="0"/>
      </body>
      <body name="{right}" pos="{right_at}"><joint name="{right}"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.05" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>{actuator}<position name="{right}" joint="{right}" kp="80" kv="7" ctrlrange="-1 1"/></actuator>
</mujoco>
"""
GOOD = {
    "default": "",
    "scenery": "",
    "turn": "",
    "left_at": "0 0.1 0",
    "right_at": "0 -0.1 0",
    "height": 0.55,
    "root": "<freejoint/>",
    "shape": "sphere",
    "contype": 0,
    "joint": '<joint name="left_leg"/>',
    "right": "right_leg",
    "actuator": f'<position name="left_leg" joint="left_leg" {GAINS}/>',
}
FRAMES = "frames of left_leg, right_leg"
ONE_JOINT = {"joint": '<joint name="hip"/>', "actuator": f'<position name="left_leg" joint="hip" {GAINS}/>'}
NAMELESS = "<joint name='left_leg'/><body><joint name='x'/><geom size='.1' contype='0'/></body>"
MOTOR = '<motor name="left_leg" joint="left_leg" ctrlrange="-1 1"/>'
WRONG = {
    "floor": ({"scenery": '<geom name="lawn" type="plane" size="1 1 1"/>'}, "lawn"),
    "light": ({"scenery": "<light/>"}, "1 light(s)"),
    "no free root": ({"root": ""}, "free joint"),
    "two roots": ({"scenery": "<body><geom size='0.1' pos='0 0 1'/></body>"}, "2 bodies"),
    "low": ({"height": 0.45}, "raise the root by 0.100 m"),
    "no name": ({"joint": NAMELESS}, "body 3, on left_leg"),
    "high": ({"height": 0.75}, "lower the root by 0.200 m"),
    "collisions": ({"contype": 1}, 'contype="0" conaffinity="1"'),
    "shape": ({"shape": "cylinder"}, "mjGEOM_CYLINDER"),
    "motor": ({"actuator": MOTOR}, "position servos (left_leg)"),
    "unlimited": ({"actuator": '<position name="left_leg" joint="left_leg" kp="80"/>'}, "ctrlrange (left_leg)"),
    "no actuator": ({"actuator": ""}, "actuators left_leg"),
    "other joint": (ONE_JOINT, "call it left_leg"),
    "hinges": ({"joint": '<joint name="left_leg"/><joint name="b" axis="1 0 0"/>'}, "hinges (left_leg, b)"),
    "slide": ({"joint": '<joint name="left_leg" type="slide"/>'}, "a hinge nor a ball"),
    "limits": ({"joint": '<joint name="left_leg" range="10 50"/>'}, "limits"),
    "twin": ({"right": "right_arm"}, "no twin"),
    "turned": ({"turn": 'euler="0 0 90"'}, FRAMES),
    "oblique": ({"turn": 'euler="0 0 45"'}, FRAMES),
    "tilted hinge": ({"joint": '<joint name="left_leg" axis="0 1 1"/>'}, FRAMES),
    "zeros": ({"joint": '<joint name="left_leg" ref="30"/>'}, FRAMES),
    "welded on one side": ({"joint": "", "actuator": ""}, "twin of right_leg"),
    "defaults": ({"default": '<default><geom condim="1"/></default>'}, "defaults of geom"),
}


def found(file=None, feet=("left_leg", "right_leg"), sides=(("right_", "left_"),), **changes):
    spec = mujoco.MjSpec.from_file(str(file)) if file else mujoco.MjSpec.from_string(BODY.format(**GOOD | changes))
    return [str(violation) for violation in violations(spec, feet=feet, sides=sides)]


@pytest.mark.parametrize("name", CHARACTERS)
def test_the_librarys_characters_keep_the_contract(name):
    assert CHARACTERS[name].check() == []


def test_a_model_without_bodies_breaks_it():
    (violation,) = violations(mujoco.MjSpec(), feet=())
    assert violation.finding == "has no body"


def test_a_small_character_keeps_it():
    assert found() == []


@pytest.mark.parametrize(("changes", "said"), WRONG.values(), ids=WRONG)
def test_each_violation_is_said_with_its_remedy(changes, said):
    assert any(said in violation and ": " in violation for violation in found(**changes)), found(**changes)


def test_defaults_of_a_class_change_no_scene():
    body = BODY.format(**GOOD | {"default": '<default><default class="own"><geom condim="1"/></default></default>'})
    spec = mujoco.MjSpec.from_string(body.replace('<body name="root"', '<body name="root" childclass="own"'))
    assert violations(spec, feet=["left_leg", "right_leg"]) == []


@pytest.mark.parametrize(
    ("feet", "said"),
    [
        ((), "no feet"),
        (("hoof",), "hoof"),
        (("left_leg", "tag"), "feet tag"),
    ],
)
def test_feet_must_be_bodies_with_shapes(feet, said):
    (violation,) = found(feet=feet, root='<freejoint/><body name="tag"/>')
    assert said in violation


@pytest.mark.parametrize(
    ("left", "right", "said"),
    [
        ("-0.1 0 0", "0.1 0 0", FRAMES),  # it faces y
        ("0 0.2 0", "0 -0.1 0", FRAMES),
        ("0 -0.1 0", "0 0.1 0", "right_leg belong to the right side"),
    ],
)
def test_left_and_right_are_on_their_sides(left, right, said):
    (violation,) = found(left_at=left, right_at=right)
    assert said in violation


def test_places_may_differ_by_two_centimetres():
    model = mujoco.MjModel.from_xml_string(BODY.format(**GOOD | {"left_at": "0.02 0.12 0"}))
    assert list(without_mirror_image(model)) == []


def test_a_timestep_must_divide_the_control_step():
    spec = mujoco.MjSpec.from_string(BODY.format(**GOOD).replace("0.008333333333", "0.003"))
    (violation,) = violations(spec, feet=["left_leg"])
    assert "timestep of 0.003 s" in str(violation)


def test_gymnasiums_humanoid_fails_for_its_motors_hinges_floor_and_height():
    said = "\n".join(found(ASSETS / "humanoid.xml"))
    for part in ("17 actuators", "right_thigh has several hinges", "(floor)", "0.107 m"):
        assert part in said


def test_a_character_may_have_a_file_of_its_own(tmp_path):
    (tmp_path / "mine.xml").write_text(BODY.format(**GOOD))
    mine = Character("mine", feet=("left_leg", "right_leg"), key_bodies=(), carrier=None, file=tmp_path / "mine.xml")
    assert mine.check() == []
    assert mine.spec().compile().nu == 2


def test_sides_may_have_other_names():
    body = BODY.format(**GOOD | {"right": "FR_leg"}).replace("left_leg", "FL_leg")
    spec = mujoco.MjSpec.from_string(body)
    (violation,) = violations(spec, feet=["FR_leg", "FL_leg"])
    assert "(right_:left_)" in str(violation)
    assert violations(spec, feet=["FR_leg", "FL_leg"], sides=(("FR_", "FL_"),)) == []


STRADDLER = """
<mujoco>
  <option timestep="0.008333333333" integrator="implicitfast"/>
  <worldbody>
    <body name="root" pos="0 0 0.35"><freejoint/>
      <geom type="box" size="0.1 0.1 0.05" mass="10" contype="0"/>
      <body name="left_leg"><joint name="left_leg" axis="1 0 0" damping="5"/>
        <geom type="box" size="0.2 0.02 0.02" pos="0 0.3 -0.33" contype="0" priority="1" condim="1"/>
      </body>
      <body name="right_leg"><joint name="right_leg" axis="1 0 0" damping="5"/>
        <geom type="box" size="0.2 0.02 0.02" pos="0 -0.3 -0.33" contype="0" priority="1" condim="1"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="left_leg" joint="left_leg" kp="500" ctrlrange="-1 1" forcerange="-{torque} {torque}"/>
    <position name="right_leg" joint="right_leg" kp="500" ctrlrange="-1 1" forcerange="-{torque} {torque}"/>
  </actuator>
</mujoco>
"""
"""Two legs that spread sideways, on ice, which bear ten kilograms 0.3 m beside their hinges."""


@pytest.mark.parametrize(("torque", "failures"), [(3 * 5 * 9.81 * 0.3, 0), (0.5 * 5 * 9.81 * 0.3, 1)])
def test_a_body_has_to_hold_its_rest_pose(torque, failures):
    found = violations(mujoco.MjSpec.from_string(STRADDLER.format(torque=torque)), feet=["left_leg", "right_leg"])
    assert [violation.finding.partition(": ")[0] for violation in found] == ["does not hold its rest pose"] * failures
