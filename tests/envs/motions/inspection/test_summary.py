import math

import pytest
import torch

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.generator import stride
from torchrl_mcp.envs.motions.inspection.summary import summarised


def standing(frames, fps=10.0):
    """The humanoid in its rest pose, for as many frames."""
    qpos = torch.from_numpy(character_model("humanoid").qpos0).repeat(frames, 1)
    return MotionClip("humanoid", qpos, fps)


def changed(clip, **columns):
    qpos = clip.qpos.clone()
    for joint, values in columns.items():
        place = character_model("humanoid").joint(joint).qposadr[0]
        qpos[:, place : place + values.shape[-1]] = values
    return MotionClip("humanoid", qpos, clip.fps)


def on_a_circle(radius, rate, frames=101):
    """Gliding counterclockwise on a circle."""
    clip = standing(frames)
    angle = rate * torch.arange(frames, dtype=torch.float64) / clip.fps
    zero, height = torch.zeros(frames), clip.qpos[:, 2]
    place = [radius * angle.sin(), -radius * angle.cos(), height, (angle / 2).cos(), zero, zero, (angle / 2).sin()]
    return changed(clip, root=torch.stack(place, dim=-1))


@pytest.mark.parametrize("rate", [0.7, -1.5])
def test_speed_and_turn_rate_are_those_of_the_root(rate):
    found = summarised(on_a_circle(2.0, rate))
    assert found.duration == pytest.approx(10.0)
    assert found.speed == pytest.approx(2.0 * abs(rate), rel=1e-2)
    assert found.turn_rate == pytest.approx(abs(rate))


def test_who_does_not_walk_does_not_slide():
    assert math.isnan(summarised(standing(5)).slide)
    assert math.isnan(summarised(on_a_circle(1.0, 3.0)).slide)  # too fast for that


def test_the_feet_of_a_generated_walk_stand_and_those_of_one_on_ice_slide():
    walk = stride("humanoid", 1.0, 0.0, strides=3)
    assert summarised(walk).slide < 0.05
    skating = MotionClip("humanoid", walk.qpos.clone(), walk.fps)
    skating.qpos[:, 1] += 0.4 * torch.arange(len(walk.qpos)) / walk.fps
    assert summarised(skating).slide == pytest.approx(0.4, abs=0.05)
