"""Robots from their makers' files, where these are installed: one command each, and they stand for ten seconds."""

import pytest

from torchrl_mcp.envs.characters import CHARACTERS
from torchrl_mcp.envs.characters.stance import collapse

POSES = {"g1": [], "go1": ["--pose", "thigh=0.9", "calf=-1.8"]}
FEET = {
    "g1": ("left_ankle_roll_link", "right_ankle_roll_link"),
    "go1": ("FR_calf", "FL_calf", "RR_calf", "RL_calf"),
}


@pytest.mark.parametrize("name", POSES)
def test_a_robot_keeps_the_contract_and_stands_for_ten_seconds(robot, name):
    robot(name, *POSES[name])
    character = CHARACTERS[name]
    assert character.check() == []
    assert character.feet == FEET[name]
    assert collapse(character.spec(), character.feet, seconds=10.0) == ""


def test_torques_guessed_for_the_g1_are_near_those_of_its_maker(robot):
    robot("g1")
    model = CHARACTERS["g1"].spec().compile()
    maker = {"knee_link": 139, "ankle_pitch_link": 50, "ankle_roll_link": 50, "hip_roll_link": 139, "hip_yaw_link": 88}
    for joint, torque in maker.items():
        assert torque / 2 < model.actuator(f"left_{joint}").forcerange[1] < 2 * torque


def test_root_pose_feet_sides_and_joints_are_shown(robot):
    output = robot("go1", *POSES["go1"])
    for line in ("root: trunk", "pose: thigh=0.9 calf=-1.8", "feet: FR_calf, FL_calf, RR_calf, RL_calf"):
        assert line in output
    assert "sides: FR_:FL_ RR_:RL_" in output
    (calf,) = [line.split() for line in output.splitlines() if line.startswith("FR_calf")]
    assert calf[1:4] == ["-2.82", "to", "-0.888"]
    assert calf[5] == calf[7] == "guessed"


def test_the_pose_of_the_go1s_file_is_refused_with_a_remedy(robot_file, command, tmp_path):
    done = command("character", "adapt", robot_file("go1"), "--name", "dog", cwd=tmp_path)
    assert done.returncode == 1
    assert "beyond the range in radians of FR_calf_joint (-2.82 to -0.888)" in done.stderr
    assert "--pose FR_calf_joint=-1.85" in done.stderr
    assert list(tmp_path.iterdir()) == []
