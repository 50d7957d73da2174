import math

import pytest
import torch

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.importer import import_motion
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.corpus import turning_clips, walking_corpus
from torchrl_mcp.envs.motions.inspection.crossing import legs_apart
from torchrl_mcp.envs.motions.inspection.feasibility import feasibility
from torchrl_mcp.envs.motions.trex import trex_corpus

RECORDINGS = (
    *(f"deepmimic/humanoid3d_{name}.txt" for name in ("walk", "long_walk1", "long_walk2", "long_walk3")),
    "sfu/0005_Walking001.bvh",
    "cmu/02_01.amc",
    "cmu/02_02.amc",
)

HIP, THIGH = 0.084887, 0.055
"""Of the humanoid in metres: half the distance between the hips, and the radius of a thigh."""


def posed(hip_angle=0.0):
    """The humanoid at rest, but for thighs turned inwards."""
    model = character_model("humanoid")
    qpos = torch.from_numpy(model.qpos0).clone().unsqueeze(0)
    for side, sign in (("right", 1), ("left", -1)):
        start = model.joint(f"{side}_hip").qposadr[0]
        half = sign * hip_angle / 2
        qpos[0, start : start + 4] = torch.tensor([math.cos(half), math.sin(half), 0.0, 0.0])
    return qpos


def generated(character):
    """Distances over the original half of the corpus: the other is its mirror image."""
    clips = walking_corpus(character, 0)
    return torch.cat([legs_apart(character, clip.qpos) for name, clip in clips.items() if "mirrored" not in name])


def test_straight_legs_are_apart_by_what_the_hips_leave_between_the_thighs():
    assert legs_apart("humanoid", posed()).tolist() == pytest.approx([2 * HIP - 2 * THIGH])


def test_thighs_that_cross_are_in_each_other_by_what_their_axes_lack():
    """Legs turned inwards are nearest below the knees, where shanks are 5 cm thick."""
    angle = 0.08
    middle = 0.421546 + 0.045 + 0.31  # lower end of the shank's axis, from the hip
    axes = 2 * (HIP - middle * math.sin(angle))
    expected = min(axes - 2 * 0.05, 0.0)
    assert legs_apart("humanoid", posed(angle)).item() == pytest.approx(expected, abs=0.01)
    clip = MotionClip("humanoid", posed(angle).repeat(2, 1), 30.0)
    assert feasibility(clip).crossing == pytest.approx(-legs_apart("humanoid", posed(angle)).item())


@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_legs_of_generated_walks_stay_out_of_each_other(character):
    apart = generated(character)
    assert apart.min() > -0.02
    assert (apart < 0).double().mean() < 0.002
    assert min(legs_apart(character, clip.qpos).min() for clip in turning_clips(character).values()) > 0


def test_legs_of_the_trex_stay_out_of_each_other():
    assert min(legs_apart("trex", clip.qpos).min() for clip in trex_corpus()) > 0


@pytest.mark.parametrize("character", ["humanoid", "biped"])
def test_legs_of_generated_walks_come_no_deeper_and_no_more_often_into_each_other_than_those_of_people(
    mocap, character
):
    recorded = torch.cat(
        [legs_apart(character, import_motion(mocap / name, character, rate=60.0).qpos) for name in RECORDINGS]
    )
    apart = generated(character)
    assert recorded.min() < 0  # retargeted legs are thicker than people's
    assert apart.min() >= recorded.min()
    assert (apart < 0).double().mean() <= (recorded < 0).double().mean()
