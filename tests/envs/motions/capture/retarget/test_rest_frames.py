"""Files whose rest pose does not stand, and in which a frame shows how their body stands."""

import re

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.errors import MotionFormatError

pytestmark = pytest.mark.filterwarnings("ignore:Gimbal lock")


@pytest.fixture(scope="module")
def along_x(skeleton):
    """Rotation of the frame of each joint whose x axis points to its first child."""
    frames = {}
    for name, _, _ in skeleton:
        children = [offset for _, parent, offset in skeleton if parent == name and any(offset)]
        if children:
            frames[name] = Rotation.align_vectors([children[0]], [[1, 0, 0]])[0]
    return frames


@pytest.fixture
def write(bvh, tmp_path):
    def write(poses, **layout):
        path = tmp_path / "motion.bvh"
        path.write_text(bvh(poses, **layout))
        return path

    return write


def test_the_first_frame_stands_for_a_rest_pose_whose_bones_lie_along_x(write, along_x, any_pose, arms_down):
    poses = [{}, arms_down(), any_pose, any_pose]
    expected = imported(write(poses, fps=5.0), "humanoid")
    path = write(poses, fps=5.0, frames=along_x)
    offsets = np.array(re.findall(r"Leg\n{\nOFFSET (.*)\n", path.read_text())[-1].split(), float)
    np.testing.assert_allclose(offsets / np.linalg.norm(offsets), [1, 0, 0], atol=1e-9)
    found = imported(path, "humanoid")
    torch.testing.assert_close(found.clip.qpos, expected.clip.qpos, rtol=0, atol=1e-6)
    assert "--rest-frame 0" in found.assumed
    assert expected.assumed == ""
    assert torch.equal(imported(path, "humanoid", rest_frame=0).clip.qpos, found.clip.qpos)


def test_a_first_frame_that_is_left_out_stands_for_the_rest_pose_nevertheless(write, along_x, any_pose, arms_down):
    poses = [{}, arms_down(), any_pose]
    expected = imported(write(poses, fps=5.0), "humanoid", skip=1)
    found = imported(write(poses, fps=5.0, frames=along_x), "humanoid", skip=1)
    torch.testing.assert_close(found.clip.qpos, expected.clip.qpos, rtol=0, atol=1e-6)


@pytest.mark.parametrize("skip", [0, 2])
def test_where_the_first_frame_does_not_stand_the_one_that_stands_straightest_is_named(
    write, along_x, about, arms_down, skip
):
    bent = arms_down(LeftUpLeg=about([1, 0, 0], -80), RightUpLeg=about([1, 0, 0], -80))
    poses = [bent, bent, bent, arms_down(), bent]
    path = write(poses, fps=5.0, frames=along_x)
    with pytest.raises(MotionFormatError, match=r"rest pose does not stand .*--rest-frame 3\)"):
        imported(path, "humanoid", skip=skip)
    assert imported(path, "humanoid", skip=skip, rest_frame=3).clip.character == "humanoid"


def test_where_no_frame_stands_none_is_named(write, along_x, about, arms_down):
    bent = arms_down(LeftUpLeg=about([1, 0, 0], -80), RightUpLeg=about([1, 0, 0], -80))
    with pytest.raises(MotionFormatError, match="rest pose does not stand") as caught:
        imported(write([bent] * 3, frames=along_x), "humanoid")
    assert "--rest-frame" not in str(caught.value)
    assert "--map" in str(caught.value)


def test_the_remedy_that_works_comes_first(write, about, arms_down):
    """A head that lies on its side in the rest pose, and that every frame turns upright again."""
    poses = [arms_down(), arms_down(Head=about([0, 1, 0], 20)), arms_down()]
    expected = imported(write(poses, fps=5.0), "humanoid")
    path = write(poses, fps=5.0, frames={"Head": about([0, 0, 1], 120)})
    with pytest.raises(MotionFormatError, match="% of its frames") as caught:
        imported(path, "humanoid")
    remedies = str(caught.value).partition(": in ")[2]
    assert 0 < remedies.index("--rest-frame 0") < remedies.index("order of its rotations")
    mended = imported(path, "humanoid", rest_frame=0)
    torch.testing.assert_close(mended.clip.qpos, expected.clip.qpos, rtol=0, atol=1e-6)
