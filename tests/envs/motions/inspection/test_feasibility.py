import math
import re
from dataclasses import replace
from importlib.resources import files

import pytest
import torch

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.ground import grounded
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.generator import walk
from torchrl_mcp.envs.motions.inspection.feasibility import feasibility
from torchrl_mcp.envs.rotations import about_x, about_y


def posed(character="humanoid", *, shift=(0.0, 0.0, 0.0), velocity=(0.0, 0.0), root=None, **joints):
    """A second of a rest pose with some joints set, moved, and gliding."""
    model = character_model(character)
    qpos = torch.from_numpy(model.qpos0).repeat(61, 1)
    qpos[:, :3] += torch.tensor(shift, dtype=torch.float64)
    qpos[:, :2] += torch.linspace(0, 1, 61, dtype=torch.float64).unsqueeze(-1) * torch.tensor(velocity).double()
    if root is not None:
        qpos[:, 3:7] = root
    for name, value in joints.items():
        start = model.joint(name).qposadr[0]
        value = torch.as_tensor(value, dtype=torch.float64).flatten()
        qpos[:, start : start + len(value)] = value
    return MotionClip(character, qpos, 60.0)


def angle(value):
    return torch.tensor(value, dtype=torch.float64)


@pytest.mark.parametrize("character", CHARACTERS)
def test_nothing_speaks_against_standing(character):
    found = feasibility(posed(character))
    assert found.limit == 0
    assert found.slide < 1e-9
    assert found.penetration < 1e-6
    assert found.airborne == 0
    assert found.imbalance == 0
    assert found.torque < 1


def test_depth_below_the_ground_is_found():
    assert feasibility(posed(shift=(0, 0, -0.013))).penetration == pytest.approx(0.013, abs=1e-9)


def test_decoration_neither_stands_nor_sinks(tmp_path, monkeypatch):
    """A box five centimetres below a sole, which collides with nothing, and then the sole itself made such a shape."""
    text = files("torchrl_mcp.envs.characters").joinpath("biped.xml").read_text()
    sole, decoration = '<geom name="left_ankle" material="left"', 'contype="0" conaffinity="0"'
    box = f'<geom type="box" size="0.02 0.02 0.02" pos="0 0 -0.1" mass="0" {decoration}/>'
    for name, drawn in (("decorated", f"{box}{sole}"), ("footless", f"{sole} {decoration}")):
        assert sole in text
        (tmp_path / f"{name}.xml").write_text(text.replace(sole, drawn))
        monkeypatch.setitem(CHARACTERS, name, replace(CHARACTERS["biped"], name=name, file=tmp_path / f"{name}.xml"))
    clip = posed("decorated")
    assert feasibility(clip) == feasibility(posed("biped"))
    times = torch.arange(len(clip.qpos), dtype=torch.float64)
    torch.testing.assert_close(grounded("decorated", clip.qpos, times)[0], clip.qpos)
    with pytest.raises(ValueError, match="left_ankle has no shape that collides: draw one, or name other feet"):
        grounded("footless", clip.qpos, times)


def test_height_above_the_ground_is_no_support():
    assert feasibility(posed(shift=(0, 0, 0.1))).airborne == 1


def test_feet_that_glide_along_slide():
    assert feasibility(posed(velocity=(0.3, 0.4))).slide == pytest.approx(0.5)


def test_a_hinge_beyond_its_limit_is_named():
    found = feasibility(posed(left_elbow=-0.2))
    assert found.limit == pytest.approx(0.2)
    assert found.limit_joint == "left_elbow"


def test_a_ball_joint_beyond_its_limit_is_named_whatever_the_axis():
    found = feasibility(posed(chest=about_x(angle(-1.5))))
    assert found.limit == pytest.approx(1.5 - 1.2)
    assert found.limit_joint == "chest"


def test_a_leaning_tower_falls_by_as_much_as_its_centre_of_mass_is_beyond_the_toes():
    lean, model = 0.4, character_model("humanoid")
    # The body turns as a whole about its ankles, and these bend so that the feet stay flat.
    ankle = float(model.body("left_hip").pos[2] + model.body("left_knee").pos[2] + model.body("left_ankle").pos[2])
    clip = posed(
        shift=(-ankle * math.sin(lean), 0, ankle * (1 - math.cos(lean))),
        root=about_y(angle(lean)),
        left_ankle=about_y(angle(-lean)),
        right_ankle=about_y(angle(-lean)),
    )
    height, toes = 0.892165 - 0.05, 0.045 + 0.0885  # above the ankles, but for the feet's 2 kg of 45
    legs = (0.892165 * 45 - 2 * 0.0275) / 43 - 0.05
    mass = (43 * (math.sin(lean) * legs - math.cos(lean) * 0.0033) + 2 * 0.045) / 45
    assert height > 0.8
    assert feasibility(clip).imbalance == pytest.approx(mass - toes, abs=0.003)


def test_arms_held_out_ask_the_shoulders_for_the_moment_of_their_weight():
    found = feasibility(posed(right_shoulder=about_x(angle(-math.pi / 2)), left_shoulder=about_x(angle(math.pi / 2))))
    moment = 9.81 * (1.5 * 0.14 + 1.0 * (0.274788 + 0.12) + 0.5 * (0.274788 + 0.258947))
    assert found.torque_joint.endswith("shoulder")
    assert found.torque == pytest.approx(moment / 100, rel=1e-3)


def test_the_knees_of_a_crouch_carry_half_of_what_is_above_them():
    bend, model = 0.8, character_model("biped")
    thigh = -float(model.body("left_knee").pos[2])
    shank = -float(model.body("left_ankle").pos[2])
    # Feet flat, trunk upright, shanks leaning forward by half of the knees' flexion and thighs backward by as much.
    half, side = bend / 2, {}
    for name in ("left", "right"):
        side[f"{name}_hip"], side[f"{name}_knee"] = about_y(angle(-half)), -bend
        side[f"{name}_ankle"] = about_y(angle(-half))
    drop = (thigh + shank) * (1 - math.cos(half))
    clip = posed("biped", shift=(math.sin(half) * (shank - thigh), 0, -drop), **side)
    found = feasibility(clip)
    # Above each knee, half of pelvis and torso, behind the knee by the thigh's whole lean, and a thigh by half of it.
    trunk = (10.0 * 0.0 + 15.0 * 0.0) / 2
    moment = 9.81 * (12.5 * thigh * math.sin(half) + 4.5 * (thigh - 0.21075) * math.sin(half)) + trunk
    assert found.torque_joint.endswith("knee")
    assert found.torque == pytest.approx(moment / 150, rel=1e-2)


@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_generated_walking_is_within_a_bodys_means(character):
    found = feasibility(walk(character, torch.full((240,), 1.0), torch.zeros(240)))
    assert found.limit == 0
    assert found.slide < 0.01
    assert found.penetration < 0.002
    assert found.torque < 1
    assert found.airborne == 0
    assert found.imbalance < 0.06


def test_joints_and_motors_without_limits_exceed_none(tmp_path, monkeypatch):
    text = files("torchrl_mcp.envs.characters").joinpath("biped.xml").read_text()
    free = re.sub(r' (range|forcerange)="[^"]*"', "", text)
    (tmp_path / "free.xml").write_text(free)
    monkeypatch.setitem(CHARACTERS, "free", replace(CHARACTERS["biped"], name="free", file=tmp_path / "free.xml"))
    model = character_model("free")
    assert not model.jnt_limited.any()
    assert not model.actuator_forcelimited.any()
    found = feasibility(posed("free"))
    assert (found.limit, found.limit_joint, found.torque) == (0.0, "", 0.0)
