"""Bodies that have what the library's lack: sensors, couplings, turned frames, and no name of the free joint."""

from dataclasses import replace
from importlib.resources import files

import pytest
import torch

from torchrl_mcp.envs import Carry, Heading
from torchrl_mcp.envs.characters import BIPED, CHARACTERS
from torchrl_mcp.envs.motions import MotionClip

IMU = '<sensor><framelinvel name="imu" objtype="body" objname="root"/></sensor>'
COUPLING = '<equality><joint name="coupling" joint1="left_knee" joint2="right_knee"/></equality>'


@pytest.fixture
def variant(request, tmp_path, monkeypatch):
    """Register the biped with its file changed, by the name of the test, as what is read of a name is kept."""
    name = request.node.name.replace("[", "_").replace("]", "")

    def register(old, new):
        text = files("torchrl_mcp.envs.characters").joinpath("biped.xml").read_text()
        assert old in text
        (tmp_path / "body.xml").write_text(text.replace(old, new, 1))
        monkeypatch.setitem(CHARACTERS, name, replace(BIPED, name=name, file=tmp_path / "body.xml"))
        return CHARACTERS[name]

    return register


def test_sensors_and_couplings_of_a_body_are_not_taken_for_the_boxs(variant, ahead):
    body = variant("</mujoco>", IMU + COUPLING + "</mujoco>")
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
    body = variant('<freejoint name="root"/>', "<freejoint/>")
    assert body.check() == []
    rest = torch.from_numpy(body.spec().compile().qpos0).repeat(2, 1)
    known = MotionClip("biped", rest, fps=30.0).mirrored()
    assert torch.equal(MotionClip(body.name, rest, fps=30.0).mirrored().qpos, known.qpos)


@pytest.mark.parametrize("angle", [45, 90])
def test_frames_that_are_no_mirror_images_are_found_where_mirror_images_are_asked_for(variant, angle):
    body = variant('<body name="left_knee"', f'<body name="left_knee" euler="0 0 {angle}"')
    assert any("left_knee" in str(violation) for violation in body.check())
    env = Heading(body.name, 1, num_threads=1)
    rest = torch.from_numpy(body.spec().compile().qpos0).repeat(2, 1)
    for images in (env.mirrors, MotionClip(body.name, rest, fps=30.0).mirrored):
        with pytest.raises(ValueError, match=r"frames of .*left_knee.* are no mirror images"):
            images()
