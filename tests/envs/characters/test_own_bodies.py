"""Bodies that have what the library's lack: sensors, couplings, turned frames, and no name of the free joint."""

from dataclasses import replace
from importlib.resources import files

import pytest
import torch
from refusals import refused

from torchrl_mcp.envs import Carry, Heading
from torchrl_mcp.envs.characters import BIPED, CHARACTERS
from torchrl_mcp.envs.motions import MotionClip

IMU = '<sensor><framelinvel name="imu" objtype="body" objname="root"/></sensor>'
COUPLING = '<equality><joint name="coupling" joint1="left_knee" joint2="right_knee"/></equality>'


@pytest.fixture
def variant(request, tmp_path, monkeypatch):
    """Register the biped with its file changed, by the name of the test, as what is read of a name is kept."""
    name = request.node.name.replace("[", "_").replace("]", "")

    def register(*changes):
        text = files("torchrl_mcp.envs.characters").joinpath("biped.xml").read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        (tmp_path / "body.xml").write_text(text)
        monkeypatch.setitem(CHARACTERS, name, replace(BIPED, name=name, file=tmp_path / "body.xml"))
        return CHARACTERS[name]

    return register


def mirror_images(body):
    """What makes mirror images: of observations and of clips."""
    rest = torch.from_numpy(body.spec().compile().qpos0).repeat(2, 1)
    return Heading(body.name, 1, num_threads=1).mirrors, MotionClip(body.name, rest, fps=30.0).mirrored


def test_sensors_and_couplings_of_a_body_are_not_taken_for_the_boxs(variant, ahead):
    body = variant(("</mujoco>", IMU + COUPLING + "</mujoco>"))
    assert body.check() == []
    env = Carry(body.name, 2, seed=0, num_threads=1)
    coupling = env.simulation.model.equality("coupling").id
    before = env.simulation.state["eq_data"][:, coupling].clone()
    states = ahead(env, 1.0)
    state = ahead(env, -0.002)
    states["qpos"][0], states["mocap_pos"][0] = state["qpos"][0], state["mocap_pos"][0]
    start = env.reset(states, set_state=True)
    end = env.step(start.set("action", torch.zeros(env.action_spec.shape)))["next"]
    assert end["box_taken"].flatten().tolist() == [True, False]
    weld = env.simulation.model.equality("box_joint").id
    assert env.simulation.state["eq_active"][:, [coupling, weld]].tolist() == [[1, 1], [1, 0]]
    assert torch.equal(env.simulation.state["eq_data"][:, coupling], before)


def test_a_free_joint_needs_no_name(variant):
    body = variant(('<freejoint name="root"/>', "<freejoint/>"))
    assert body.check() == []
    rest = torch.from_numpy(body.spec().compile().qpos0).repeat(2, 1)
    known = MotionClip("biped", rest, fps=30.0).mirrored()
    assert torch.equal(MotionClip(body.name, rest, fps=30.0).mirrored().qpos, known.qpos)


@pytest.mark.parametrize("angle", [45, 90])
def test_frames_that_are_no_mirror_images_are_found_where_mirror_images_are_asked_for(variant, angle):
    body = variant(('<body name="left_knee"', f'<body name="left_knee" euler="0 0 {angle}"'))
    assert any("left_knee" in str(violation) for violation in body.check())
    for images in mirror_images(body):
        refused(images, "left_knee")


def test_limbs_whose_sides_are_unknown_have_no_mirror_images(variant, monkeypatch):
    body = variant()
    monkeypatch.setitem(CHARACTERS, body.name, replace(body, sides=()))
    for images in mirror_images(body):
        refused(images, "right_hip", "left_ankle", "sides")


def test_a_joint_that_its_twin_lacks_prevents_mirror_images_alone(variant):
    """One ankle is welded."""
    servo = '<position class="ankle" name="left_ankle_{}" joint="left_ankle" gear="{}"/>'
    servos = [(servo.format(*pair), "") for pair in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1"))]
    body = variant(('<joint name="left_ankle"/>', ""), *servos)
    assert any("the twin of right_ankle has other joints" in str(violation) for violation in body.check())
    for images in mirror_images(body):
        refused(images, "right_ankle")
