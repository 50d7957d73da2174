"""States of a character come back: orders of quaternions and joints, archives and tables, and what is refused."""

import numpy as np
import pytest
import torch

from torchrl_mcp.envs.characters import CHARACTERS as REGISTERED
from torchrl_mcp.envs.characters import Character
from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions import trex_corpus
from torchrl_mcp.envs.motions.capture.importer import import_motion, imported
from torchrl_mcp.envs.motions.errors import MotionFormatError
from torchrl_mcp.envs.motions.gait.generator import stride
from torchrl_mcp.envs.motions.placement import Placement

CHARACTERS = ["biped", "humanoid", "trex"]
XYZW = [1, 2, 3, 0]


@pytest.fixture(scope="module")
def clips():
    """A motion of each character."""
    return {
        "biped": stride("biped", 1.0, 0.3, strides=1),
        "humanoid": stride("humanoid", 1.0, 0.3, strides=1),
        "trex": trex_corpus()[0],
    }


def reordered(clip):
    """The states with all quaternions as x, y, z, w."""
    qpos = clip.qpos.clone()
    for columns in clip.layout.quaternions:
        qpos[:, columns] = clip.qpos[:, columns[XYZW]]
    return qpos.numpy()


def owners(character):
    """Name of each column of the joints: a ball joint's with ``_w``, ..., and the joint's alone for hinges."""
    model = character_model(character)
    names = []
    for index in range(1, model.njnt):
        joint = model.joint(index)
        names += [f"{joint.name}_{axis}" for axis in "wxyz"] if len(joint.qpos0) == 4 else [joint.name]
    return names


def table(values, header=None, separator=","):
    lines = [separator.join(header)] if header else []
    return "\n".join(lines + [separator.join(map(repr, row)) for row in np.asarray(values).tolist()]) + "\n"


def assert_same(found, clip):
    """The same joints and orientation, and the same path but for where it begins."""
    torch.testing.assert_close(found.qpos[:, 3:], clip.qpos[:, 3:], rtol=0, atol=1e-9)
    shift = found.qpos[:, :3] - clip.qpos[:, :3]
    torch.testing.assert_close(shift, shift[:1].expand_as(shift), rtol=0, atol=1e-9)
    assert torch.equal(found.qpos[0, :2], torch.zeros(2, dtype=torch.float64))


@pytest.mark.parametrize("character", CHARACTERS)
@pytest.mark.parametrize("separator", [",", " ", ";", "\t"])
def test_a_table_in_the_models_order_comes_back(clips, tmp_path, character, separator):
    clip, path = clips[character], tmp_path / "motion.csv"
    path.write_text(table(clip.qpos, separator=separator))
    assert_same(import_motion(path, character, fps=clip.fps, rate=clip.fps), clip)


def test_commas_beside_semicolons_are_of_decimals(clips, tmp_path):
    clip, path = clips["biped"], tmp_path / "motion.csv"
    path.write_text(table(clip.qpos, separator=";").replace(".", ","))
    assert_same(import_motion(path, "biped", fps=clip.fps, rate=clip.fps), clip)


@pytest.mark.parametrize("character", CHARACTERS)
@pytest.mark.parametrize(("heading", "quaternion"), [(90, None), (-120, None), (0, "xyzw"), (180, "xyzw")])
def test_quaternions_in_the_other_order_are_recognised_or_said(clips, tmp_path, character, heading, quaternion):
    turn = Placement(torch.tensor(np.radians(heading)), torch.zeros(2, dtype=torch.float64))
    clip, path = clips[character].placed(turn), tmp_path / "motion.csv"
    path.write_text(table(reordered(clip)))
    assert_same(import_motion(path, character, fps=clip.fps, rate=clip.fps, quaternion=quaternion), clip)


@pytest.mark.parametrize("character", CHARACTERS)
def test_columns_with_names_may_have_any_order_and_others_between_them(clips, tmp_path, character):
    clip, path = clips[character], tmp_path / "motion.csv"
    names = owners(character)
    joint = [name[:-2] if name[-2:] in ("_w", "_x", "_y", "_z") else name for name in names]
    order = sorted(range(len(names)), key=lambda column: joint[column][::-1])  # a quaternion's stay in their order
    qpos = clip.qpos.numpy()
    values = np.concatenate([qpos[:, :7], np.full((len(qpos), 1), 9.0), qpos[:, 7:][:, order]], axis=1)
    header = ["x", "y", "z", "qw", "qx", "qy", "qz", "finger", *(names[column] for column in order)]
    path.write_text(table(values, header))
    assert_same(import_motion(path, character, fps=clip.fps, rate=clip.fps), clip)


def test_names_of_the_roots_columns_tell_the_order_of_its_quaternion(clips, tmp_path):
    clip, path = clips["humanoid"], tmp_path / "motion.csv"  # it faces along x: upright in both orders
    header = ["root_x", "root_y", "root_z", "root_qx", "root_qy", "root_qz", "root_qw", *owners("humanoid")]
    path.write_text(table(reordered(clip), header))
    assert_same(import_motion(path, "humanoid", fps=clip.fps, rate=clip.fps), clip)
    with pytest.raises(MotionFormatError, match=r"root_qx, root_qy, root_qz, root_qw, but should be .* wxyz"):
        import_motion(path, "humanoid", fps=clip.fps, quaternion="wxyz")


@pytest.mark.parametrize("root", [("time", "x", "y", "z", "qw", "qx", "qy"), ("qw", "qx", "qy", "qz", "x", "y", "z")])
def test_names_that_are_not_the_roots_are_refused(clips, tmp_path, root):
    clip, path = clips["biped"], tmp_path / "motion.csv"
    path.write_text(table(clip.qpos, [*root, *owners("biped")]))
    with pytest.raises(MotionFormatError, match=rf":1: .*columns are called {', '.join(root)}"):
        import_motion(path, "biped", fps=clip.fps, quaternion="wxyz")


def test_joints_may_be_named_by_the_user(clips, tmp_path):
    clip, path = clips["trex"], tmp_path / "motion.csv"
    names = clip.layout.names[1:]
    columns = [
        np.arange(character_model("trex").nq)[character_model("trex").joint(name).qposadr[0] :] for name in names
    ]
    widths = [len(character_model("trex").joint(name).qpos0) for name in names]
    order = [column for start, width in reversed(list(zip(columns, widths, strict=True))) for column in start[:width]]
    path.write_text(table(clip.qpos[:, [*range(7), *order]]))
    found = import_motion(path, "trex", fps=clip.fps, rate=clip.fps, joints=list(reversed(names)))
    assert_same(found, clip)


@pytest.mark.parametrize("character", CHARACTERS)
def test_archives_of_states_or_of_root_and_joints_come_back(clips, tmp_path, character):
    clip, path = clips[character], tmp_path / "motion.npz"
    np.savez(path, qpos=clip.qpos.numpy(), frequency=clip.fps)
    assert_same(import_motion(path, character, rate=clip.fps), clip)
    qpos = reordered(clip)
    parts = {"root_pos": qpos[:, :3], "root_rot": qpos[:, 3:7], "dof_pos": qpos[:, 7:]}
    np.savez(path, **parts, fps=np.array([clip.fps]), joint_names=np.array(clip.layout.names[1:]))
    assert_same(import_motion(path, character, rate=clip.fps, quaternion="xyzw"), clip)


WHEELS = """<mujoco model="cart"><worldbody><body name="cart" pos="0 0 1"><freejoint name="root"/>
<geom type="box" size=".3 .2 .1"/>
<body name="left_wheel" pos="0 .3 -.5"><joint name="left_axle" axis="0 1 0"/><geom type="sphere" size=".5"/></body>
<body name="right_wheel" pos="0 -.3 -.5"><joint name="right_axle" axis="0 1 0"/><geom type="sphere" size=".5"/></body>
</body></worldbody></mujoco>"""


def test_a_character_of_your_own_needs_no_limits_of_its_joints(tmp_path, monkeypatch):
    (tmp_path / "cart.xml").write_text(WHEELS)
    cart = Character(
        "cart", feet=("left_wheel", "right_wheel"), key_bodies=(), carrier="cart", file=tmp_path / "cart.xml"
    )
    monkeypatch.setitem(REGISTERED, "cart", cart)
    angles = np.linspace(0, 50, 11)
    rows = [[0.1 * index, 0, 1, 1, 0, 0, 0, angle, -angle] for index, angle in enumerate(angles)]
    (tmp_path / "motion.csv").write_text(table(rows, ["x", "y", "z", "w", "i", "j", "k", "right_axle", "left_axle"]))
    found = imported(tmp_path / "motion.csv", "cart", fps=10.0, rate=10.0)
    np.testing.assert_allclose(found.clip.qpos[:, 7:], np.stack([-angles, angles], axis=1), atol=1e-9)
    np.testing.assert_allclose(found.clip.qpos[:, 2], 1.0)
    assert not found.cut.any()


def test_the_frame_rate_of_the_user_wins(clips, tmp_path):
    path = tmp_path / "motion.npz"
    np.savez(path, qpos=clips["biped"].qpos[:11].numpy(), fps=60.0)
    assert import_motion(path, "biped", fps=10.0).duration == pytest.approx(1.0)


@pytest.mark.parametrize("length", [0.7, 1.3])
def test_the_length_of_quaternions_does_not_matter(clips, tmp_path, length):
    clip, path = clips["humanoid"], tmp_path / "motion.npz"
    qpos = clip.qpos.clone()
    qpos[:, clip.layout.quaternions] *= length
    np.savez(path, qpos=qpos.numpy(), fps=clip.fps)
    assert_same(import_motion(path, "humanoid", rate=clip.fps), clip)


def test_what_limits_cut_is_measured(clips, tmp_path):
    clip, path = clips["biped"], tmp_path / "motion.npz"
    knee = character_model("biped").joint("left_knee")
    qpos = clip.qpos[:4].numpy().copy()
    qpos[:, knee.qposadr[0]] = knee.range[1] + np.radians([-30, 0, 12, 20])
    np.savez(path, qpos=qpos, fps=30.0)
    np.testing.assert_allclose(imported(path, "biped").cut, [0, 0, 12, 20], atol=1e-9)


def test_angles_in_degrees_are_refused_with_the_share_of_cut_frames(clips, tmp_path):
    clip, path = clips["trex"], tmp_path / "motion.npz"
    qpos = clip.qpos.numpy().copy()
    qpos[:, clip.layout.angles] = np.degrees(qpos[:, clip.layout.angles])
    np.savez(path, qpos=qpos, fps=30.0)
    with pytest.raises(MotionFormatError, match=r"motion\.npz: in \d+ % of its frames .*angles are in radians"):
        import_motion(path, "trex")


def test_a_heading_that_both_orders_allow_needs_to_be_said_but_for_qpos_of_mujoco(tmp_path):
    """Half a turn about the vertical, (0, 0, 0, 1), is no rotation if read as x, y, z, w."""
    qpos = np.tile(character_model("biped").qpos0, (5, 1))
    qpos[:, 3:7] = [0, 0, 0, 1]
    (tmp_path / "motion.csv").write_text(table(qpos))
    with pytest.raises(MotionFormatError, match=r"both orders .* \(--quaternion wxyz or xyzw\)"):
        import_motion(tmp_path / "motion.csv", "biped", fps=30.0)
    found = import_motion(tmp_path / "motion.csv", "biped", fps=30.0, quaternion="wxyz")
    np.testing.assert_allclose(found.qpos[:, 3:7].abs(), qpos[:, 3:7])
    np.savez(tmp_path / "motion.npz", qpos=qpos, fps=30.0)
    assert torch.equal(import_motion(tmp_path / "motion.npz", "biped").qpos, found.qpos)


STANDING = ",".join(map(repr, character_model("biped").qpos0.tolist()))


WRONG = {
    "empty": ("", "has 0 frames of 0 numbers"),
    "one frame": (f"{table([[0, 0, 1, 1, 0, 0, 0]])}", "has 1 frames of 7 numbers .*: pass two or more"),
    "too narrow": ("0,0,1\n" * 3, "has 3 frames of 3 numbers"),
    "too few joints": (
        "0,0,1,1,0,0,0,0\n" * 3,
        r"has 1 numbers after the root's 7, but the joints need 22: .*--joints",
    ),
    "ragged": ("0,0,1,1,0,0,0\n0,0,1,1\n", r"csv:2: has 4 numbers, but the first line has 7: correct it"),
    "a word": ("0,0,1,1,0,0,0\n0,0,1,1,0,0,x\n", r"csv:2: 'x' is not a number: correct it"),
    "not finite": ("0,0,1,1,0,0,0\n0,0,1,nan,0,0,0\n", r"csv:2: 'nan' is not finite: correct it"),
    "no rotation": (
        f"{STANDING}\n" * 2 + STANDING.replace(",1.0,", ",0.0,", 1),
        "quaternion of the root in frame 3 has",
    ),
    "lies": (f"{STANDING}\n".replace(",1.0,0.0,", ",0.7,0.7,", 1) * 2, "upright in most frames with no order"),
    "jumps": (f"{STANDING}\n" + STANDING.replace("0.0,", "9.0,", 1), "the root jumps between frames 1 and 2"),
    "other names": (f"x,y,z,a,b,c,d{',j' * 22}\n" + f"{STANDING}\n" * 2, "has 0 columns of the joint .*, which needs"),
}


@pytest.mark.parametrize(("text", "message"), WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said_in_one_sentence(tmp_path, text, message):
    path = tmp_path / "motion.csv"
    path.write_text(text)
    with pytest.raises(MotionFormatError, match=message) as caught:
        import_motion(path, "biped", fps=30.0)
    assert str(caught.value).startswith(str(path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("option", [{"scale": 1.0}, {"up": "z"}, {"asf": "x.asf"}, {"body_model": "x.npz"}])
def test_options_of_skeletons_are_refused(tmp_path, option):
    with pytest.raises(ValueError, match=f"{next(iter(option))} does not apply to .*motion.csv"):
        import_motion(tmp_path / "motion.csv", "biped", **option)
