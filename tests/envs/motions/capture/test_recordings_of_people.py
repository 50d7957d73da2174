"""What the importers make of recordings of people, which are no part of the project."""

import math
from itertools import permutations

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.amc import read_asf_amc
from torchrl_mcp.envs.motions.capture.bvh import read_bvh
from torchrl_mcp.envs.motions.capture.importer import import_motion, imported
from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.inspection.statistics import gait_statistics
from torchrl_mcp.envs.motions.inspection.summary import GLIDING, SLIDING, foot_slide, summarised
from torchrl_mcp.envs.motions.placement import placing

CHARACTER_LEG = 0.421546 + 0.40987
FORWARD = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""From the axes of the body to the character's: x is what z was."""

SPEED_BANDS = {"stride_time": (1.02, 1.28), "bob": (0.018, 0.045), "slide": (0.0, 0.05)}
"""What depends on speed at 1 m/s, and a recording's slide."""


@pytest.fixture(scope="module")
def sfu(mocap):
    return mocap / "sfu" / "0005_Walking001.bvh"


@pytest.fixture(scope="module")
def sfu_clip(sfu):
    return import_motion(sfu, "humanoid")


NUMBERS = {
    "biped/biped3d_walk.txt": (353.5941661588641, 260.5941661588641),
    "cmu/02_01.amc": (1287.6270520936146, 869.9187916247879),
    "cmu/02_02.amc": (1178.3954385760305, 790.3394312481689),
    "deepmimic/humanoid3d_jog.txt": (448.4866119736556, 255.53789318558145),
    "deepmimic/humanoid3d_long_walk1.txt": (15244.14287987136, 10493.607943990663),
    "deepmimic/humanoid3d_long_walk2.txt": (11281.363580103485, 7374.561693562421),
    "deepmimic/humanoid3d_long_walk3.txt": (7428.453988587204, 5124.300253132398),
    "deepmimic/humanoid3d_walk.txt": (509.3300547895042, 339.4962209652921),
    "sfu/0005_Walking001.bvh": (17929.64319030167, 12495.478105734444),
    "sfu/0005_Walking001_retargeted_deepmimic_60hz.txt": (18013.160736602353, 12583.86961937276),
}
"""Sum of the absolute values of all states but heights of the humanoid and of the biped, as first imported."""


@pytest.mark.parametrize("file", NUMBERS)
def test_real_files_are_imported_to_the_numbers_that_they_had_without_an_assumption(mocap, file):
    for character, expected in zip(("humanoid", "biped"), NUMBERS[file], strict=True):
        found = imported(mocap / file, character)
        columns = [column for column in range(found.clip.qpos.shape[1]) if column != 2]
        assert float(found.clip.qpos[:, columns].abs().sum()) == pytest.approx(expected, rel=1e-10)
        assert (found.assumed, found.ground) == ("", "")
        assert found.cut.max() < 8


SFU_NAMES = {"hip": "UpLeg", "knee": "Leg", "ankle": "Foot"}
CMU_NAMES = {"hip": "femur", "knee": "tibia", "ankle": "foot"}


@pytest.mark.parametrize("character", ["humanoid", "biped"])
@pytest.mark.parametrize("file", ["sfu/0005_Walking001.bvh", "cmu/02_01.amc", "cmu/02_02.amc"])
def test_knees_and_ankles_of_real_files_are_where_the_scaled_source_has_them(mocap, file, character, kinematics):
    """Within the difference of the hips' width, 13 mm, but for knees that are straighter than straight."""
    cmu, path = file.startswith("cmu"), mocap / file
    source = read_asf_amc(path) if cmu else read_bvh(path)
    clip = import_motion(path, character, rate=source.fps)
    frames = slice(0, len(clip.qpos), 16)
    places = source.poses().positions[frames].numpy() @ FORWARD.T
    joints = {
        f"{side}_{joint}": places[:, source.names.index((side[0] if cmu else side.title()) + name)]
        for side in ("left", "right")
        for joint, name in (CMU_NAMES if cmu else SFU_NAMES).items()
    }
    bones = [
        (f"{side}_{a}", f"{side}_{b}") for side in ("left", "right") for a, b in (("hip", "knee"), ("knee", "ankle"))
    ]
    length = sum(np.linalg.norm(joints[b] - joints[a], axis=-1).mean() for a, b in bones) / 2
    middle = (joints["left_hip"] + joints["right_hip"]) / 2
    bodies = [kinematics(clip, index)[0] for index in range(*frames.indices(len(clip.qpos)))]
    for part in ("left_knee", "right_knee", "left_ankle", "right_ankle"):
        expected = (joints[part] - middle) * (CHARACTER_LEG / length)
        error = np.linalg.norm([found[part] - found["root"] for found in bodies] - expected, axis=-1)
        assert np.quantile(error, 0.95) < 0.0132, part
        assert error.max() < 0.015, part


def test_the_given_retarget_of_a_real_file_is_reproduced_but_for_the_flat_feet(mocap, sfu):
    ours = import_motion(sfu, "humanoid", rate=120.0)
    given = import_motion(mocap / "sfu" / "0005_Walking001_retargeted_deepmimic_60hz.txt", "humanoid", rate=60.0)
    times = torch.arange(0, len(given.qpos), 5) / given.fps
    ours, given = ours.placed(placing(ours.qpos[0], given.qpos[0])).at(times), given.at(times)
    assert (ours[:, :3] - given[:, :3]).norm(dim=-1).max() < 0.02
    model = character_model("humanoid")
    for index in range(model.njnt):
        joint = model.joint(index)
        place = joint.qposadr[0] + (3 if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE else 0)
        if joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE:
            difference = (ours[:, place] - given[:, place]).abs()
        else:
            own, other = (Rotation.from_quat(state[:, place : place + 4], scalar_first=True) for state in (ours, given))
            difference = torch.from_numpy((other.inv() * own).magnitude())
        if joint.name.endswith("ankle"):  # by a constant angle of at most 11 degrees
            assert difference.max() < math.radians(11)
            assert difference.max() - difference.min() < math.radians(1)
        else:
            assert difference.quantile(0.95) < math.radians(0.05), joint.name
            assert difference.max() < math.radians(2), joint.name


def test_a_real_walk_is_a_human_walk(sfu_clip, human_bands):
    strides = gait_statistics(sfu_clip)
    straight = (strides.turn_rate.abs() < 0.35) & (strides.speed > 0.85) & (strides.speed < 1.35)
    found = strides.select(straight).medians()
    assert int(straight.sum()) >= 8
    outside = {
        name: found[name] for name, (low, high) in (human_bands | SPEED_BANDS).items() if not low <= found[name] <= high
    }
    assert not outside


def test_feet_of_a_real_file_stand_while_they_should(sfu_clip, mocap):
    assert 0.01 < foot_slide(sfu_clip) < 0.05
    for name in ("02_01", "02_02"):  # shorter, faster and noisier
        assert foot_slide(import_motion(mocap / "cmu" / f"{name}.amc", "humanoid")) < 0.1


@pytest.mark.parametrize("order", [order for order in permutations("XYZ") if order != ("X", "Y", "Z")])
def test_a_real_file_read_in_a_wrong_order_jumps_or_slides(sfu, tmp_path, order):
    text = sfu.read_text()
    *head, last = text[: text.index("Frames:")].splitlines()
    rows = text[text.index("Frame Time") :].splitlines()[:1501]
    skeleton = "\n".join([*head, last]).replace(
        "Xrotation Yrotation Zrotation", " ".join(f"{axis}rotation" for axis in order)
    )
    path = tmp_path / "wrong.bvh"
    path.write_text("\n".join([skeleton, "Frames: 1500", *rows]))
    assert jumps_or_slides(path)


def jumps_or_slides(path):
    try:
        found = summarised(import_motion(path, "humanoid"))
        return found.slide > SLIDING or found.gliding > GLIDING
    except MotionFormatError as error:
        return "jumps between" in str(error) and "correct the order of its rotations" in str(error)
