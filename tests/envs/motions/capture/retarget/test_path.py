"""The path of the body: scaled by its legs, from the origin, over level ground."""

import re

import numpy as np
import pytest
import torch

from torchrl_mcp.envs.motions.capture.importer import import_motion

# From hip to ankle in metres, of the body and of the humanoid.
LEG = 0.85
CHARACTER_LEG = 0.421546 + 0.40987


def test_the_path_is_scaled_by_the_length_of_the_legs_and_begins_at_the_origin(load):
    path = [(0.3, 0.9, -2.0), (0.5, 0.95, -1.5), (0.4, 0.9, -1.0)]
    clip = load([{}] * 3, path=path)
    expected = (CHARACTER_LEG / LEG) * np.array([[0, 0, 0], [0.5, 0.2, 0.05], [1.0, 0.1, 0]])
    np.testing.assert_allclose(clip.qpos[:, :3] - clip.qpos[0, :3], expected, atol=1e-9)
    np.testing.assert_allclose(clip.qpos[0, :2], 0, atol=1e-12)


def test_the_clip_stands_on_the_ground_whatever_height_it_was_recorded_at(load):
    for height in (0.2, 0.9, 5.0):
        assert load([{}] * 2, position=(0, height, 0)).qpos[0, 2] == pytest.approx(CHARACTER_LEG + 0.05, abs=1e-6)


def stops(rise):
    """A path with rests, four metres forward and two to the left, on ground that rises forward."""
    places = [(0, 0), (1, 0), (2, 1), (3, 2), (4, 2)]
    return [(left, 0.9 + rise * forward, forward) for forward, left in places for _ in range(6)]


@pytest.mark.parametrize("rise", [0.0, 0.02, -0.015, 0.1, -0.06])
def test_the_slope_of_a_laboratory_and_the_rise_of_stairs_are_taken_out(load, rise):
    clip = load([{}] * 30, path=stops(rise), fps=10.0, options={"rate": 10.0})
    risen = float(clip.qpos[-1, 2] - clip.qpos[0, 2])
    assert abs(risen) <= 0.1 * abs(4 * rise) * CHARACTER_LEG / LEG + 1e-9
    rests = clip.qpos[3:30:6, 2]
    torch.testing.assert_close(rests, torch.full_like(rests, CHARACTER_LEG + 0.05), rtol=0, atol=0.005)


def test_a_joint_above_the_hips_may_stand_still_and_the_hips_move(tmp_path, bvh, skeleton, arms_down):
    body = [("Reference", None, (0, 0, 0)), ("Hips", "Reference", (0, 0.9, 0)), *skeleton[1:]]
    text = bvh([arms_down()] * 2, body=body)
    *head, first, second = re.sub(r"(Hips\n.*\n.*\nCHANNELS) 3", r"\1 4 Zposition", text).splitlines()
    rows = [first.split(), second.split()]
    rows[0].insert(6, "0.0")
    rows[1].insert(6, "0.5")
    path = tmp_path / "carried.bvh"
    path.write_text("\n".join([*head, *map(" ".join, rows)]))
    clip = import_motion(path, "humanoid")
    np.testing.assert_allclose(clip.qpos[1, :2], [0.5 * CHARACTER_LEG / LEG, 0], atol=1e-9)
