"""Any character follows a recording by inverse kinematics: on the ground, within its limits, and as its map says."""

import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from torchrl_mcp.envs.characters import CHARACTERS, Character
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.characters.kinematics import body_names, body_states
from torchrl_mcp.envs.motions.capture.anatomy import HEAD_AND_ARMS, LEGS, TRUNK
from torchrl_mcp.envs.motions.capture.clips import as_source
from torchrl_mcp.envs.motions.capture.importer import imported
from torchrl_mcp.envs.motions.capture.inverse_kinematics import solved
from torchrl_mcp.envs.motions.capture.joint_motion import states
from torchrl_mcp.envs.motions.capture.key_bodies import PARTS, _limbs, key_map, read_key_map
from torchrl_mcp.envs.motions.capture.recording import record
from torchrl_mcp.envs.motions.clip import MotionClip
from torchrl_mcp.envs.motions.gait.generator import stride
from torchrl_mcp.envs.motions.inspection.feasibility import feasibility
from torchrl_mcp.envs.motions.inspection.summary import foot_slide, summarised

TREX_MAP = {
    "root": "root",
    "chest": "chest",
    "neck": "head",
    "right_hip": "right_hip",
    "right_knee": "right_knee",
    "right_ankle": "right_toe",
    "left_hip": "left_hip",
    "left_knee": "left_knee",
    "left_ankle": "left_toe",
    "right_shoulder": "right_shoulder",
    "left_shoulder": "left_shoulder",
}


@pytest.fixture(scope="module")
def walk():
    return stride("humanoid", 1.0, 0.3, strides=2)


@pytest.fixture(scope="module")
def walk_file(walk, tmp_path_factory):
    path = tmp_path_factory.mktemp("clips") / "walk.npz"
    walk.save(path)
    return path


@pytest.fixture(scope="module")
def trex(walk_file):
    return imported(walk_file, "trex")


def positions(clip, bodies):
    names, found = body_names(clip.character), body_states(clip.character, clip.qpos, clip.qvel).positions
    return found[:, [names.index(body) for body in bodies]]


def test_the_humanoid_follows_itself(walk):
    """Its own motion as the recording: bodies come back to a centimetre, though its joints were not told."""
    source, bodies = as_source(walk, "walk.npz"), key_map("humanoid")
    body = record(source, (*TRUNK, *LEGS, *HEAD_AND_ARMS), joint_map=bodies)
    motion, missed = solved(body, "humanoid", bodies)
    found = MotionClip("humanoid", states("humanoid", motion)[0], walk.fps)
    away = positions(found, bodies.values()) - positions(walk, bodies.values())
    away[..., 2] -= away[..., 2].mean()
    assert away.norm(dim=-1).max() < 0.015
    assert torch.rad2deg(missed).max() < 5


def test_a_body_of_half_the_size_walks_half_as_far_and_does_not_slide(walk, tmp_path, monkeypatch):
    spec = CHARACTERS["humanoid"].spec()
    for part in (*spec.bodies[1:], *spec.geoms):
        part.pos = 0.5 * part.pos
    for geom in spec.geoms:
        geom.size = 0.5 * geom.size
        geom.fromto = 0.5 * geom.fromto
    spec.compile()
    (tmp_path / "child.xml").write_text(spec.to_xml())
    grown = CHARACTERS["humanoid"]
    child = Character("child", grown.feet, grown.key_bodies, None, tmp_path / "child.xml")
    monkeypatch.setitem(CHARACTERS, "child", child)
    walk.save(tmp_path / "walk.npz")
    clip = imported(tmp_path / "walk.npz", "child", rate=walk.fps).clip
    bodies = key_map("humanoid").values()
    found, expected = positions(clip, bodies), positions(walk, bodies) / 2
    torch.testing.assert_close(found - found[:1, :1], expected - expected[:1, :1], rtol=0, atol=0.015)
    assert foot_slide(clip) <= foot_slide(walk) / 2 + 0.01


def test_joints_stay_within_their_limits_and_feet_on_the_ground(trex):
    demand = feasibility(trex.clip)
    assert demand.limit < 1e-6
    assert demand.penetration < 0.03  # the tip of a toe that pushes off
    found = summarised(trex.clip)
    assert found.slide < 0.1
    assert abs(found.sole) < 0.005
    assert trex.cut.max() < 1e-6
    assert trex.missed.max() < 15


def test_the_map_of_bodies_is_guessed_from_names(trex):
    assert dict(trex.bodies) == TREX_MAP == key_map("trex")
    assert key_map("humanoid") == {part: part for part in PARTS}


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["shoulder_pitch", "elbow", "forearm", "hand"], ["shoulder_pitch", "elbow", "hand"]),
        (["collar", "upper_arm", "forearm", "wrist"], ["upper_arm", "forearm", "wrist"]),
        (["shoulder", "arm", "forearm", "hand"], ["arm", "forearm", "hand"]),
    ],
)
def test_a_forearm_is_no_upper_arm(names, found):
    arms = [f"{side}_{name}" for side in ("right", "left") for name in names]
    assert list(_limbs(["root", *arms], (("right_", "left_"),)).items()) == [
        (f"{side}_{part}", f"{side}_{body}")
        for side in ("right", "left")
        for part, body in zip(("shoulder", "elbow", "wrist"), found, strict=True)
    ]


def test_a_map_of_the_user_replaces_guesses(walk_file, tmp_path):
    (tmp_path / "bodies.yaml").write_text("neck: upper_neck\n")
    given = read_key_map(tmp_path / "bodies.yaml")
    bodies = imported(walk_file, "trex", bodies=given).bodies
    assert dict(bodies) == TREX_MAP | {"neck": "upper_neck"}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"tail": "tail_1"}, "the map of bodies has tail: the parts are root, chest, right_hip"),
        ({"chest": "breast"}, "trex has no body breast: its bodies are root, chest"),
    ],
)
def test_a_wrong_map_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        key_map("trex", given)


@pytest.mark.parametrize(
    ("text", "message"), [("- a", "must have lines of the form"), ("a: 1", "must have"), ("a: [", "must be YAML")]
)
def test_a_file_that_is_no_map_is_refused(tmp_path, text, message):
    (tmp_path / "bodies.yaml").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_key_map(tmp_path / "bodies.yaml")


def test_a_character_without_known_legs_says_how_to_name_them(monkeypatch, tmp_path):
    text = '<mujoco><worldbody><body name="b"><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    (tmp_path / "blob.xml").write_text(text)
    monkeypatch.setitem(CHARACTERS, "blob", Character("blob", ("b",), (), None, tmp_path / "blob.xml"))
    with pytest.raises(ValueError, match=r"blob has no body that is known as right_hip, .*'right_hip: BODY'.*--bodies"):
        key_map("blob")


def test_a_body_without_known_sides_needs_a_map(monkeypatch):
    monkeypatch.setitem(CHARACTERS, "trex", replace(CHARACTERS["trex"], sides=()))
    with pytest.raises(ValueError, match="trex has no body that is known as right_hip"):
        key_map("trex")


def test_what_is_missing_is_named_with_its_extra(walk_file, monkeypatch):
    monkeypatch.setitem(sys.modules, "mink", None)
    with pytest.raises(ImportError, match=r"needs mink: pip install 'torchrl-mcp\[retargeting\]'"):
        imported(walk_file, "trex")


def test_recordings_of_every_format_reach_any_character(mocap):
    for name in ("cmu/02_01.amc", "deepmimic/humanoid3d_walk.txt", "biped/biped3d_walk.txt"):
        found = imported(mocap / name, "trex")
        assert found.clip.character == "trex"
        assert found.missed.median() < 10


@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0, 120.0, 240.0])
def test_the_g1_walks_alike_at_any_frame_rate(robot, walk, tmp_path, fps):
    robot("g1")
    walk.resampled(fps).save(tmp_path / "walk.npz")
    found = imported(tmp_path / "walk.npz", "g1")
    assert found.clip.duration == pytest.approx(walk.duration)
    assert foot_slide(found.clip) < 0.05
    assert feasibility(found.clip).limit < 1e-6
    assert found.missed.median() < 10


def test_a_motion_of_the_g1_comes_back_to_it(robot, walk, tmp_path):
    robot("g1")
    walk.save(tmp_path / "walk.npz")
    own = imported(tmp_path / "walk.npz", "g1").clip
    bodies = key_map("g1")
    parts = tuple(part for part in PARTS if part in bodies)
    body = record(as_source(own, "own.npz"), parts, joint_map=bodies, scale=1.0)
    motion, _ = solved(body, "g1", bodies)
    again = MotionClip("g1", states("g1", motion)[0], own.fps)
    legs = [bodies[part] for part in (*TRUNK, *LEGS)]
    away = positions(again, legs) - positions(own, legs)
    away[..., 2] -= away[..., 2].mean()
    assert away.norm(dim=-1).max() < 0.03


@pytest.mark.parametrize("order", ["wxyz", "xyzw"])
def test_states_of_the_g1_come_back(robot, walk, tmp_path, order):
    robot("g1")
    walk.save(tmp_path / "walk.npz")
    clip = imported(tmp_path / "walk.npz", "g1").clip
    columns = [3, 4, 5, 6] if order == "wxyz" else [4, 5, 6, 3]
    table = np.concatenate([clip.qpos[:, :3], clip.qpos[:, columns], clip.qpos[:, 7:]], axis=1)
    np.savetxt(tmp_path / "states.csv", table, delimiter=",", fmt="%.12f")
    found = imported(tmp_path / "states.csv", "g1", fps=clip.fps, quaternion=order, rate=clip.fps).clip
    torch.testing.assert_close(found.qpos[:, 3:], clip.qpos[:, 3:], rtol=0, atol=1e-9)


def test_a_clip_as_a_source_has_the_positions_of_its_bodies(walk):
    """Against MuJoCo: forward kinematics of the source, which knows translations and rotations only."""
    source, model = as_source(walk, "walk.npz"), character_model("humanoid")
    data = mujoco.MjData(model)
    for frame in (0, 7, 20):
        data.qpos = walk.qpos[frame].numpy()
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(source.poses().positions[frame], data.xpos[1:], atol=1e-9)
