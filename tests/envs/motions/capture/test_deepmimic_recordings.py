"""Published files of DeepMimic have their duration, stand on the ground, and hold the bodies of their skeletons."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.motions.capture.importer import import_motion, imported
from torchrl_mcp.envs.motions.errors import MotionFormatError

FILES = {
    "deepmimic/humanoid3d_walk.txt": (1.27, True),
    "deepmimic/humanoid3d_jog.txt": (0.83, True),
    "deepmimic/humanoid3d_long_walk1.txt": (32.79, False),
    "deepmimic/humanoid3d_long_walk2.txt": (24.56, False),
    "deepmimic/humanoid3d_long_walk3.txt": (17.74, False),
    "sfu/0005_Walking001_retargeted_deepmimic_60hz.txt": (39.08, False),
    "biped/biped3d_walk.txt": (1.0, True),
}


@pytest.mark.parametrize("file", FILES)
@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_real_files_have_their_duration_and_stand_on_the_ground(mocap, file, character, kinematics):
    clip = import_motion(mocap / file, character)
    duration, loop = FILES[file]
    assert clip.duration == pytest.approx(duration, abs=0.01)
    assert clip.loop is loop
    places = [kinematics(clip, index)[0] for index in range(0, len(clip.qpos), 5)]
    ankles = np.array([min(found["left_ankle"][2], found["right_ankle"][2]) for found in places])
    assert 0.04 < np.quantile(ankles, 0.1) < 0.08
    assert ankles.min() > 0.03


@pytest.mark.parametrize("file", [file for file in FILES if not file.startswith("biped")])
def test_real_files_with_reordered_quaternions_are_refused_or_read_as_told(mocap, file, tmp_path):
    content = json.loads((mocap / file).read_text())
    widths = [4, 4, 4, *[4, 1, 4, 4, 1] * 2]
    starts = 4 + np.cumsum([0, *widths[:-1]])
    order = [0, 1, 2, 3]
    for start, width in zip(starts, widths, strict=True):
        order += [start + 1, start + 2, start + 3, start] if width == 4 else [start]
    content["Frames"] = np.array(content["Frames"])[:, order].tolist()
    (tmp_path / "reordered.txt").write_text(json.dumps(content))
    with pytest.raises(MotionFormatError, match=r"reordered\.txt: in (9\d|100) % of its frames .* up to 12\d: "):
        import_motion(tmp_path / "reordered.txt", "humanoid")
    found = imported(tmp_path / "reordered.txt", "humanoid", quaternion="xyzw")
    expected = imported(mocap / file, "humanoid")
    torch.testing.assert_close(found.clip.qpos, expected.clip.qpos, rtol=0, atol=1e-12)
    assert expected.cut.max() < 8


@pytest.mark.parametrize(
    ("file", "skeleton", "character"),
    [
        ("deepmimic/humanoid3d_long_walk3.txt", "deepmimic/humanoid3d_character.txt", "humanoid"),
        ("biped/biped3d_walk.txt", "biped/biped3d_mocap_character.txt", "biped"),
    ],
)
def test_bodies_are_where_the_skeleton_of_a_real_file_has_them(mocap, file, skeleton, character, kinematics):
    """All but the ends of the cycle of a loop, which are drawn together."""
    joints = json.loads((mocap / skeleton).read_text())["Skeleton"]["Joints"]
    frames = json.loads((mocap / file).read_text())["Frames"]
    step = max(1, len(frames) // 30)
    clip = import_motion(mocap / file, character, rate=(len(frames) - 1) / sum(frame[0] for frame in frames[:-1]))
    start = None
    for index in range(0, len(frames), step):
        places = skeleton_positions(joints, frames[index])
        found, _ = kinematics(clip, index)
        start = found["root"] - places["root"] if start is None else start
        for name, place in places.items():
            np.testing.assert_allclose(found[name], place + start, atol=2e-3 if clip.loop else 1e-6, err_msg=name)


def skeleton_positions(joints, columns):
    """Joint positions by rotation matrices, in our axes."""
    axes = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    places, turns, rest = [np.array(columns[1:4])], [], list(columns[4:])
    for joint in joints:
        width = {"none": 4, "spherical": 4, "revolute": 1, "fixed": 0}[joint["Type"]]
        own, rest = rest[:width], rest[width:]
        turn = Rotation.from_quat(own, scalar_first=True) if width == 4 else Rotation.from_rotvec([0, 0, sum(own)])
        parent = joint["Parent"]
        offset = [joint["AttachX"], joint["AttachY"], joint["AttachZ"]]
        if parent >= 0:
            places.append(places[parent] + turns[parent].apply(offset))
            turn = turns[parent] * turn
        turns.append(turn)
    return {joint["Name"]: axes @ place for joint, place in zip(joints, places, strict=True)}
