import math

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.generator import stride
from torchrl_mcp.envs.motions.inspection.summary import GLIDING, summarised


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


@pytest.mark.parametrize("height", [0.03, -0.012])
def test_the_height_of_standing_soles_is_found(height):
    walk = stride("humanoid", 1.0, 0.0, strides=3)
    qpos = walk.qpos.clone()
    qpos[:, 2] += height
    found, lifted = summarised(walk).sole, summarised(MotionClip("humanoid", qpos, walk.fps)).sole
    assert lifted - found == pytest.approx(height, abs=1e-9)
    assert abs(found) < 0.005


FPS = 60.0


def jumps(turned):
    """Three leaps forward at 1.5 m/s, in each of which the legs pass each other four times in the air."""
    frames, start = [], 0.0
    for _ in range(3):
        frames += [((start, 0, 0.881416), {})] * 30
        for t in np.arange(1, 37) / FPS:
            angle = 35 * math.sin(4 * math.pi * t / 0.6) * math.sin(math.pi * t / 0.6)
            legs = {"left_hip": turned([0, 1, 0], angle), "right_hip": turned([0, 1, 0], -angle)}
            frames.append(((start + 1.5 * t, 0, 0.881416 + 9.81 / 2 * t * (0.6 - t)), legs))
        start += 0.9
    return frames


def lowest_geom(model, data):
    """Height, geom and position on the geom of the lowest point of the body."""
    points = []
    for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
        place, matrix, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
        match model.geom_type[geom]:
            case mujoco.mjtGeom.mjGEOM_SPHERE:
                centres, radius = np.zeros((1, 3)), size[0]
            case mujoco.mjtGeom.mjGEOM_CAPSULE:
                centres, radius = np.array([[0, 0, -size[1]], [0, 0, size[1]]]), size[0]
            case _:
                centres, radius = size * np.stack(np.meshgrid(*[[-1, 1]] * 3), axis=-1).reshape(8, 3), 0.0
        for point in place + centres @ matrix.T - [0, 0, radius]:
            points.append((point[2], geom, matrix.T @ (point - place)))
    return min(points, key=lambda point: point[0])


def rolls(turned, posed):
    """Two rolls forward in a ball over whatever is lowest, which does not slip; the legs move in the air."""
    model, frames, x, contact = character_model("humanoid"), [], 0.0, None
    data = mujoco.MjData(model)
    for seconds in np.arange(300) / FPS:
        degrees = 144 * seconds
        sway = 15 * math.sin(math.radians(2 * degrees))
        joints = {"root": turned([0, 1, 0], degrees), "chest": turned([0, 1, 0], 30), "neck": turned([0, 1, 0], 20)}
        for side, sign in (("left", 1), ("right", -1)):
            joints |= {f"{side}_hip": turned([0, 1, 0], -115 + sign * sway), f"{side}_knee": -2.2, f"{side}_elbow": 2.0}
        data.qpos = posed([((0, 0, 0), joints)])[0].numpy()
        mujoco.mj_kinematics(model, data)
        if contact is not None:
            geom, local, before = contact
            x -= (data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ local - before)[0]
        height, geom, local = lowest_geom(model, data)
        contact = geom, local, data.geom_xpos[geom] + data.geom_xmat[geom].reshape(3, 3) @ local
        frames.append(((x, 0, -height), joints))
    return frames


def crawls(turned):
    """On hands and knees at 0.6 m/s: a knee stands while the other overtakes it, and both shanks sway in the air."""
    frames, thigh, shank = [], 0.421546, math.radians(115)
    for t in np.arange(360) / FPS:
        joints = {"root": turned([0, 1, 0], 90)}
        for side, phase in (("left", t % 1.0), ("right", (t + 0.5) % 1.0)):
            ahead = 0.15 - 0.6 * phase if phase < 0.5 else 0.6 * (phase - 0.5) - 0.15
            sway = turned([0, 0, 1], 25 * math.sin(4 * math.pi * t))
            joints[f"{side}_hip"] = turned([0, 1, 0], -90 - math.degrees(math.asin(ahead / thigh))) * sway
            joints[f"{side}_knee"] = -shank
        frames.append(((0.6 * t, 0, thigh + 0.05), joints))
    return frames


def test_correct_jumps_rolls_and_crawls_are_no_walks_that_slide(turned, posed):
    for frames in (jumps(turned), rolls(turned, posed), crawls(turned)):
        found = summarised(MotionClip("humanoid", posed(frames), FPS))
        assert math.isnan(found.slide)
        assert found.gliding < GLIDING


def test_a_body_that_tumbles_or_flies_along_glides(turned, posed):
    """What turns about its middle at 1 m/s, and what hovers."""
    tumbling = [((t, 0, 0.9), {"root": turned([0.3, 1, 0.5], 360 * t)}) for t in np.arange(180) / FPS]
    hovering = [((t, 0, 0.881416), {}) for t in np.arange(180) / FPS]
    for frames in (tumbling, hovering):
        assert summarised(MotionClip("humanoid", posed(frames), FPS)).gliding > GLIDING
