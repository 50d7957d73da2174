"""The command that makes characters of files: what it leaves out, keeps passive, and floats."""

import re

import mujoco
import pytest

LEG = """
<body name="{side}_thigh" pos="0 {y} 0"><joint name="{side}_hip" axis="0 1 0" range="-80 80"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".04" mass="1"/>
  <body name="{side}_shin" pos="0 0 -.4"><joint name="{side}_knee" axis="0 1 0" range="-20 20" stiffness="1500"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".5"/>
    <geom type="box" pos=".05 0 -.35" size=".15 .05 .05" mass=".5"/></body></body>"""
SPRINGS = f"""
<mujoco><worldbody><body name="pelvis" pos="0 0 1"><freejoint/><geom type="box" size=".1 .15 .1" mass="20"/>
{LEG.format(side="right", y=-0.1)}{LEG.format(side="left", y=0.1)}</body></worldbody>
<equality><connect name="rod" body1="right_shin" body2="right_thigh" anchor="0 0 .1"/></equality>
<tendon><fixed name="cord"><joint joint="left_knee" coef="1"/></fixed></tendon>
<actuator><motor name="r" joint="right_hip" gear="80" ctrlrange="-1 1"/>
<motor name="l" joint="left_hip" gear="80" ctrlrange="-1 1"/></actuator></mujoco>"""

INERTIA = '<inertia ixx="{0}" iyy="{0}" izz="{0}" ixy="0" ixz="0" iyz="0"/>'
LIMB = """<joint name="{name}_hip" type="revolute"><parent link="trunk"/><child link="{name}_leg"/>
<origin xyz="{x} {y} 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="30" velocity="9"/></joint>
<link name="{name}_leg"><inertial><origin xyz="0 0 -.15"/><mass value="1"/>{inertia}</inertial>
<collision><origin xyz="0 0 -.15"/><geometry><box size=".04 .04 .3"/></geometry></collision></link>"""
CORNERS = {"FR": (0.2, -0.1), "FL": (0.2, 0.1), "RR": (-0.2, -0.1), "RL": (-0.2, 0.1)}
DOG = f"""<robot name="dog"><link name="trunk"><inertial><mass value="10"/>{INERTIA.format(0.1)}</inertial>
<collision><geometry><box size=".4 .2 .1"/></geometry></collision></link>
{"".join(LIMB.format(name=name, x=x, y=y, inertia=INERTIA.format(0.01)) for name, (x, y) in CORNERS.items())}</robot>"""


def rows(output):
    """The words of each line by the first of them."""
    return {line.split()[0]: line for line in output.splitlines() if line.strip()}


def test_what_is_left_out_and_what_stays_passive_is_listed(command, tmp_path):
    (tmp_path / "springs.xml").write_text(SPRINGS)
    done = command("character", "adapt", "springs.xml", "--name", "hopper", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = rows(done.stdout)
    assert re.split(r"  +", lines["tendon"]) == ["tendon", "1", "cord"]
    assert re.split(r"  +", lines["equality"]) == ["equality constraint", "1", "rod"]
    assert "passive" in lines["right_shin"]
    assert "80 file" in lines["right_thigh"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "hopper.xml"))
    assert [model.actuator(index).name for index in range(model.nu)] == ["right_thigh", "left_thigh"]
    checked = command("character", "check", "hopper.xml", cwd=tmp_path)
    assert "right_shin, left_shin" in rows(checked.stdout)["passive,"]


def test_a_torque_gives_passive_joints_a_servo(command, tmp_path):
    (tmp_path / "springs.xml").write_text(SPRINGS)
    command("character", "adapt", "springs.xml", "--name", "hopper", "--torque", "knee=90", cwd=tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "hopper.xml"))
    assert model.actuator("left_shin").forcerange.tolist() == [-90, 90]
    assert model.joint("left_shin").stiffness == 1500


def test_a_urdf_with_a_fixed_base_is_refused_and_floats_with_the_remedy(command, tmp_path):
    (tmp_path / "dog.urdf").write_text(DOG)
    arguments = ("character", "adapt", "dog.urdf", "--name", "hound")
    done = command(*arguments, cwd=tmp_path)
    assert done.returncode == 1
    assert all(f"{name}_leg" in done.stderr for name in CORNERS)
    assert "--floating" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["dog.urdf"]
    done = command(*arguments, "--floating", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "hound.xml"))
    assert model.body_mass.sum() == pytest.approx(14)
    assert {model.body(body).name for body in range(2, model.nbody)} == {f"{name}_leg" for name in CORNERS}


@pytest.mark.parametrize(("root", "named"), [("pelvis", "pelvis"), ("right_shin", "right_shin"), (None, "pelvis")])
def test_a_trunk_that_cannot_float_is_refused_by_name(command, tmp_path, root, named):
    (tmp_path / "springs.xml").write_text(SPRINGS)
    options = ("--root", root) if root else ()
    done = command("character", "adapt", "springs.xml", "--name", "hopper", "--floating", *options, cwd=tmp_path)
    assert done.returncode == 1
    assert named in done.stderr
    assert "--floating" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["springs.xml"]
