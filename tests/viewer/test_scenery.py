import math
from itertools import product

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_mcp.envs import Carry, Dribble, Heading, Holdout, Imitation, Location
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.rendering.camera import Camera, arrow
from torchrl_mcp.viewer.scenery import HAZE, ZENITH, extent, scenery, sky_picture, softly_lit


def turn():
    """A biped is carried along a quarter of a circle in 2 s while its knees bend."""
    model, angle = character_model("biped"), torch.linspace(0, math.pi / 2, 61, dtype=torch.float64)
    qpos = torch.from_numpy(model.qpos0).repeat(len(angle), 1)
    qpos[:, 0], qpos[:, 1] = 2 + angle.sin(), 3 - angle.cos()
    qpos[:, 3], qpos[:, 6] = (angle / 2).cos(), (angle / 2).sin()
    for knee in ("right_knee", "left_knee"):
        qpos[:, model.joint(knee).qposadr[0]] = -angle
    return MotionClip("biped", qpos, fps=30.0)


@pytest.fixture(scope="module")
def env():
    terms = {"pose": {"weight": 1.0, "scale": 1.0}}
    return Imitation("biped", {"turn": turn()}, 2, terms=terms, switch_interval=math.inf, seed=0, num_threads=1)


def begin(env, time):
    """Begin both episodes at a moment of the clip, in the reference's own state."""
    env.reset()
    start = env.beginning(torch.zeros(2, dtype=torch.int64), torch.full((2,), time, dtype=torch.float64))
    env.reset(env.get_state().update(TensorDict(start, [2])), set_state=True)


def positions(shapes):
    return np.stack([shape.position for shape in shapes])


def test_a_ghost_is_where_the_character_is_when_its_episode_begins(env):
    begin(env, 0.7)
    data, model, shapes = env.simulation.data(1), env.simulation.model, scenery(env, 1)
    moving = model.geom_bodyid > 0
    assert np.array_equal([shape.kind for shape in shapes], model.geom_type[moving])
    np.testing.assert_allclose(positions(shapes), data.geom_xpos[moving], atol=1e-6)
    np.testing.assert_allclose([shape.orientation for shape in shapes], data.geom_xmat[moving], atol=1e-6)


def test_a_ghost_goes_on_as_its_clip_does_whatever_the_character_does(env):
    begin(env, 0.0)
    for _ in range(30):
        env.step(TensorDict({"action": torch.zeros(2, env.action_spec.shape[-1])}, [2]))
    model = character_model("biped")
    data = mujoco.MjData(model)
    data.qpos = turn().at(torch.tensor([1.0], dtype=torch.float64))[0].numpy()
    data.qpos[:2] -= turn().qpos[0, :2].numpy()  # the episode began above the origin
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(positions(scenery(env)), data.geom_xpos, atol=1e-3)
    np.testing.assert_allclose(positions(scenery(env, aside=2.0)), data.geom_xpos + np.array([0, 2, 0]), atol=1e-3)


def test_a_ghost_lets_what_is_behind_it_shine_through(env):
    begin(env, 0.0)
    assert all(0 < shape.colour[3] < 1 for shape in scenery(env))


def test_an_arrow_is_as_long_as_it_is_from_tail_to_tip_and_points_there():
    tail, tip = np.array([1.0, 2.0, 3.0]), np.array([1.0, 5.0, 7.0])
    shape = arrow(tail, tip)
    np.testing.assert_allclose(shape.position, tail)
    np.testing.assert_allclose(shape.size[2], 5.0)
    np.testing.assert_allclose(shape.orientation.reshape(3, 3)[:, 2], [0.0, 0.6, 0.8], atol=1e-7)


def test_heading_and_holdout_show_the_direction_in_which_to_go():
    walk, ant = Heading("biped", 1, seed=0, num_threads=1), Holdout(1, (2.0, 2.0), seed=0, num_threads=1)
    for env in (walk, ant):
        env.reset()
    walk.episode["direction"][:] = 2.0
    for env in (walk, ant):
        [shape] = scenery(env)
        direction = shape.orientation.reshape(3, 3)[:, 2]
        np.testing.assert_allclose(direction, [math.cos(2.0), math.sin(2.0), 0.0], atol=1e-6)


def test_location_shows_the_place_from_above():
    env = Location("biped", 1, seed=0, num_threads=1)
    env.reset()
    [shape] = scenery(env)
    np.testing.assert_allclose(shape.position, [*env.get_state()["target"][0].tolist(), 1.0])
    np.testing.assert_allclose(shape.orientation.reshape(3, 3)[:, 2], [0.0, 0.0, -1.0], atol=1e-6)


@pytest.mark.parametrize("task", [Carry, Dribble])
def test_transport_shows_the_way_from_character_to_object_and_from_object_to_target(task):
    env = task("biped", 1, seed=0, num_threads=1)
    env.reset()
    state, data = env.get_state(), env.simulation.data(0)
    thing, target = state["qpos"][0, -7:-5].numpy(), state["mocap_pos"][0, 0, :2].numpy()
    ways = thing - data.subtree_com[1, :2], target - thing
    for shape, way in zip(scenery(env), ways, strict=True):
        direction = shape.orientation.reshape(3, 3)[:2, 2]
        np.testing.assert_allclose(direction, way / np.linalg.norm(way), atol=1e-6)


def test_soft_light_is_that_of_a_copy(env):
    model = env.simulation.model
    before = model.vis.rgba.fog.copy(), model.light_diffuse.copy()
    lit = softly_lit(model)
    assert not np.array_equal(lit.vis.rgba.fog, before[0])
    assert not np.array_equal(lit.light_diffuse, before[1])
    assert np.array_equal(model.vis.rgba.fog, before[0])
    assert np.array_equal(model.light_diffuse, before[1])


def test_the_reach_is_that_of_the_furthest_shape_of_the_first_body_alone():
    model = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody>
          <geom type="plane" size="9 9 1"/>
          <body pos="5 0 1"><freejoint/>
            <geom size="0.1" pos="0.6 0 0"/><geom size="0.1" pos="-0.2 0 0"/>
            <body pos="-0.4 0 0"><joint/><geom size="0.1" pos="0 0 0"/></body>
          </body>
          <body pos="-9 0 1"><freejoint/><geom size="1"/></body>
        </worldbody></mujoco>""")
    assert math.isclose(extent(model), 0.6 + 0.1, abs_tol=1e-6)  # the centre of mass is at 0


def test_softly_lit_ground_is_pale_and_endless_and_mirrors_nothing():
    model = Holdout(1, (0.0, 0.0), seed=0, num_threads=1).simulation.model  # Gymnasium's is black and white, and shines
    lit, floor = softly_lit(model), model.geom("floor").id
    texture = model.mat_texid[model.geom_matid[floor], mujoco.mjtTextureRole.mjTEXROLE_RGB]
    start = model.tex_adr[texture]
    end = start + model.tex_height[texture] * model.tex_width[texture] * model.tex_nchannel[texture]
    assert model.tex_data[start:end].min() < 50 < 140 < lit.tex_data[start:end].min()
    others = np.ones(len(lit.tex_data), bool)
    for changed in {texture, *np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX)}:
        size = model.tex_height[changed] * model.tex_width[changed] * model.tex_nchannel[changed]
        others[model.tex_adr[changed] :][:size] = False
    assert np.array_equal(lit.tex_data[others], model.tex_data[others])
    assert not lit.mat_reflectance.any()
    assert not lit.geom_size[floor, :2].any()


def test_a_plain_ground_can_be_softly_lit_too():
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><geom type='plane' size='9 9 1'/></worldbody></mujoco>")
    assert not softly_lit(model).geom_size[0, :2].any()


@pytest.mark.parametrize(
    "env",
    [Heading("biped", 1, seed=0, num_threads=1), Holdout(1, (0.0, 0.0), seed=0, num_threads=1)],
    ids=["biped", "ant"],
)
def test_the_sky_is_no_night_from_any_camera(env):
    model = softly_lit(env.simulation.model)
    try:
        camera = Camera(model, width=96, height=96)
    except (RuntimeError, mujoco.FatalError) as error:
        pytest.skip(str(error))
    camera.view.type = mujoco.mjtCamera.mjCAMERA_FREE
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    places = [(0.0, 3.0), (90.0, 3.0), (200.0, 40.0), (0.0, -4.0), (90.0, -40.0)]
    for (azimuth, height), elevation, fog in product(places, (-10.0, 0.0, 30.0, 80.0), (False, True)):
        camera.view.azimuth, camera.view.elevation = azimuth, -elevation
        camera.view.lookat = [60.0, 20.0, height]  # far from the character
        camera.scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = fog
        dark = camera.picture(data, distance=2.0).float().mean(-1).min()
        assert dark > 60, (azimuth, height, elevation, fog)
    camera.close()


def test_the_sky_is_of_the_haze_at_the_horizon_and_below_and_bluer_above():
    sky = sky_picture(64, HAZE, ZENITH).reshape(6, 64, 64, 3)
    haze = np.round(255 * np.array(HAZE[:3]))
    for side in (0, 1, 4, 5):
        assert (sky[side, 32:] == haze).all()
        assert np.abs(sky[side, 31] - haze).max() < 5
        assert (np.diff(sky[side, :, 32, 0].astype(int)) >= 0).all()  # from above, ever less blue
    assert (sky[3] == haze).all()
    np.testing.assert_allclose(sky[2, 31:33, 31:33].mean((0, 1)), 255 * np.array(ZENITH[:3]), atol=1.0)
    # Faces meet without a seam: the lowest of the upper one is the highest of those at the sides.
    assert np.abs(sky[2, 0].astype(int) - sky[4, 0]).max() < 5
