"""A walk that is read in the wrong order of rotations is refused or pointed out, and in the right one it is not."""

from itertools import permutations

import pytest
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.kinematics import body_names, body_states
from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.gait.generator import stride
from torchrl_mcp.envs.motions.inspection.summary import GLIDING, SLIDING, summarised

BODIES = {"Hips": "root", "Chest": "chest", "Head": "neck"}
for side in ("left", "right"):
    limbs = {"UpLeg": "hip", "Leg": "knee", "Foot": "ankle", "Arm": "shoulder", "ForeArm": "elbow"}
    BODIES |= {f"{side.title()}{joint}": f"{side}_{body}" for joint, body in limbs.items()}
"""Bodies of the humanoid by joints of the skeleton."""

LEG, CHARACTER_LEG = 0.85, 0.421546 + 0.40987


@pytest.fixture(scope="module")
def walk(skeleton, forward, about):
    """Poses of the skeleton, and its path, that do as the humanoid does, who walks on a curve."""
    clip = stride("humanoid", 1.1, 0.4, strides=3).resampled(60.0)
    states, names = body_states("humanoid", clip.qpos, clip.qvel), body_names("humanoid")
    parents = {name: parent for name, parent, _ in skeleton}
    down = {"LeftArm": about([0, 0, 1], -90), "RightArm": about([0, 0, 1], 90)}
    poses = []
    for orientations in states.orientations.numpy():
        turns = {None: Rotation.identity()}
        for joint, _, _ in skeleton:
            if joint in BODIES:
                turn = Rotation.from_quat(orientations[names.index(BODIES[joint])], scalar_first=True).as_matrix()
                from_t_pose = next((down[arm] for arm in down if joint in (arm, arm.replace("Arm", "ForeArm"))), None)
                turns[joint] = Rotation.from_matrix(forward.T @ turn @ forward) * (from_t_pose or Rotation.identity())
            else:
                turns[joint] = turns[parents[joint]]
        poses.append({joint: turns[parents[joint]].inv() * turns[joint] for joint, _, _ in skeleton})
    return poses, states.positions[:, 0].numpy() @ forward * (LEG / CHARACTER_LEG)


def written(walk, bvh, path, order):
    """Write the walk as if it had been recorded in the order ZXY, with channels that claim another one."""
    poses, places = walk
    text = bvh(poses, path=places, fps=60.0)
    claimed = " ".join(f"{axis}rotation" for axis in order)
    path.write_text(text.replace("Zrotation Xrotation Yrotation", claimed))
    return path


def test_a_walk_in_the_right_order_stands(walk, bvh, tmp_path):
    found = imported(written(walk, bvh, tmp_path / "walk.bvh", "ZXY"), "humanoid")
    summary = summarised(found.clip)
    assert summary.slide < SLIDING / 4
    assert summary.gliding < GLIDING / 5
    assert abs(summary.sole) < 0.005
    assert found.ground == ""


@pytest.mark.parametrize("order", [order for order in permutations("XYZ") if order != ("Z", "X", "Y")])
def test_a_walk_in_a_wrong_order_is_refused_or_pointed_out(walk, bvh, tmp_path, order):
    path = written(walk, bvh, tmp_path / "walk.bvh", order)
    assert refused_or_pointed_out(path)


def refused_or_pointed_out(path):
    try:
        found = summarised(imported(path, "humanoid").clip)
    except MotionFormatError as error:
        return "order of its rotations" in str(error)
    return found.slide > SLIDING or found.gliding > GLIDING
