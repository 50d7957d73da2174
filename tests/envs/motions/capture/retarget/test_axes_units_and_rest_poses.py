"""The same motion gives the same clip, whatever axes, angles, unit and rest pose its file has."""

import re

import numpy as np
import pytest
import torch

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.errors import MotionFormatError

AXES = {
    "z up, x forward": np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    "z up, y back": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "x up": np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]]),
}
Z = np.array([0, 0, 1])


@pytest.fixture
def splayed(skeleton, about):
    """The body with its legs turned outwards by 20 degrees in the rest pose."""

    def spread(name, offset):
        turn = about(Z, 20 if name.startswith("Left") else -20)
        return tuple(turn.apply(offset)) if re.fullmatch("(Left|Right)(Leg|Foot|Toe)", name) else offset

    return [(name, parent, spread(name, offset)) for name, parent, offset in skeleton]


@pytest.fixture
def own_frames(skeleton, about):
    """Each joint with axes of its own, as some programs write them: the rest pose is then no pose at all."""
    names = [name for name, _, _ in skeleton]
    return {name: about([index % 3, 1, index % 5 - 2], 40 * index) for index, name in enumerate(names)}


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize("axes", AXES.values(), ids=AXES)
@pytest.mark.parametrize("order", ["XYZ", "YXZ"])
def test_neither_axes_nor_orders_matter(load, axes, order, any_pose, arms_down):
    poses, path = [arms_down(), any_pose, any_pose], [(0, 0.9, 0), (0.1, 0.8, 0.2), (0.1, 0.8, 0.2)]
    expected = load(poses, path=path, fps=5.0)
    found = load(poses, path=path, fps=5.0, axes=axes, order=order)
    torch.testing.assert_close(found.qpos, expected.qpos, rtol=0, atol=1e-7)


@pytest.mark.parametrize(
    ("unit", "scale"), [(0.01, None), (0.001, None), (0.0254, None), (0.0254 / 0.45, None), (0.3048, 0.3048)]
)
def test_the_unit_is_known_by_the_length_of_the_legs_or_said(load, unit, scale, any_pose):
    expected = load([any_pose] * 2)
    torch.testing.assert_close(
        load([any_pose] * 2, unit=unit, options={"scale": scale}).qpos, expected.qpos, rtol=0, atol=1e-7
    )


def test_legs_of_an_impossible_length_are_refused(load):
    with pytest.raises(MotionFormatError, match=r"motion\.bvh: from hip to ankle .* 2\.79 m.*: pass the scale"):
        load([{}] * 2, unit=0.3048)


@pytest.mark.parametrize(("unit", "scale"), [(0.01, 0.0254), (1.0, 0.5), (1.0, 0.01)])
def test_the_scale_of_the_user_wins_over_the_usual_length_of_legs(load, unit, scale, any_pose):
    """The character's size does not depend on it."""
    expected = load([any_pose] * 2)
    found = load([any_pose] * 2, unit=unit, options={"scale": scale})
    torch.testing.assert_close(found.qpos, expected.qpos, rtol=0, atol=1e-7)


def test_legs_that_the_rest_pose_spreads_hang_straight_when_the_motion_closes_them(load, arms_down, splayed, about):
    closed = arms_down(LeftUpLeg=about(Z, -20), RightUpLeg=about(Z, 20))
    clip = load([closed] * 2, body=splayed)
    expected = character_model("humanoid").qpos0
    np.testing.assert_allclose(clip.qpos[0], expected, atol=1e-7)


def test_a_frame_in_which_the_body_stands_takes_the_place_of_the_rest_pose(load, any_pose, own_frames):
    path = [(0, 0.9, 0), (0.1, 0.9, 0), (0.1, 0.9, 0)]
    expected = load([{}, any_pose, any_pose], fps=2.0, path=path)
    found = load([{}, any_pose, any_pose], fps=2.0, path=path, frames=own_frames, options={"rest_frame": 0})
    torch.testing.assert_close(found.qpos, expected.qpos, rtol=0, atol=1e-7)


def test_the_frame_that_stands_may_be_left_out(load, any_pose, own_frames):
    expected = load([{}, any_pose, any_pose], fps=2.0, options={"skip": 1})
    found = load([{}, any_pose, any_pose], fps=2.0, frames=own_frames, options={"skip": 1, "rest_frame": 0})
    torch.testing.assert_close(found.qpos, expected.qpos, rtol=0, atol=1e-7)


@pytest.mark.parametrize("degrees", [0.0, 10.0, 35.0])
def test_how_far_a_rest_frame_is_from_standing_is_the_lean_of_its_trunk_or_the_stride_of_its_legs(
    bvh, tmp_path, about, degrees
):
    path = tmp_path / "motion.bvh"
    for turn in ({"Hips": about([1, 0, 0], degrees)}, {"LeftUpLeg": about([-1, 0, 0], degrees)}):
        path.write_text(bvh([turn, {}]))
        # From the middle of the hips, 2 cm below the root and 1 cm ahead, to the chest 24 cm above it.
        built = np.degrees(np.arctan2(0.01, 0.26))
        expected = max(abs(degrees - built), degrees) if "Hips" in turn else max(degrees, built)
        assert imported(path, "humanoid", rest_frame=0, rate=30.0).rest_lean == pytest.approx(expected, abs=1e-3)


def test_a_rest_pose_that_spreads_the_legs_stands(bvh, tmp_path, splayed):
    path = tmp_path / "motion.bvh"
    path.write_text(bvh([{}] * 2, body=splayed))
    assert imported(path, "biped").rest_lean == pytest.approx(np.degrees(np.arctan2(0.01, 0.26)), abs=1e-3)


def test_a_frame_that_does_not_stand_is_refused_by_its_number(load, about):
    sitting = {f"{side}UpLeg": about([-1, 0, 0], 80) for side in ("Left", "Right")}
    sitting |= {f"{side}Leg": about([1, 0, 0], 80) for side in ("Left", "Right")}
    assert load([{}, sitting], fps=2.0, options={"rest_frame": 0}).character == "humanoid"
    with pytest.raises(MotionFormatError, match=r"frame 1 does not stand .*--rest-frame 0"):
        load([{}, sitting], fps=2.0, options={"rest_frame": 1})
