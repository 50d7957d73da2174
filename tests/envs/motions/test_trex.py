import copy

import mujoco
import numpy as np
import pytest
import torch
from scipy.optimize import nnls
from scipy.signal import detrend
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters import TREX
from torchrl_mcp.envs.motions.standing import standing_library, trex_stops
from torchrl_mcp.envs.motions.trex import trex_corpus, trex_walk

CLIPS = ["forward", "left", "sharp_left", "right", "sharp_right", "slow", "left_on_the_spot", "right_on_the_spot"]
FORWARD, LEFT, SHARP_LEFT, RIGHT, SHARP_RIGHT, SLOW, LEFT_SPOT, RIGHT_SPOT = range(8)
SPEEDS, TURN_RATES = [1.0, 0.9, 0.8, 0.9, 0.8, 0.5, 0.0, 0.0], [0.0, 0.5, 1.0, -0.5, -1.0, 0.0, 0.7, -0.7]
SIDES = ("right", "left")

every_clip = pytest.mark.parametrize("index", range(8), ids=CLIPS)


@pytest.fixture(scope="module")
def corpus():
    """The walks of the paper's length, and those beyond it."""
    return [*trex_corpus(), *list(trex_stops().values())[1:]]


@pytest.fixture(scope="module")
def model():
    spec = TREX.spec()
    floor = spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], contype=1)
    floor.margin = 0.001
    return spec.compile()


def times(clip, cycles=1.0):
    return torch.arange(round(cycles * clip.duration * clip.fps), dtype=torch.float64) / clip.fps


def bodies(model, clip, names, cycles=1.0):
    """Positions of bodies over time, shape (T, names, 3), and their orientations."""
    data, positions, orientations = mujoco.MjData(model), [], []
    ids = [model.body(name).id for name in names]
    for data.qpos in clip.at(times(clip, cycles)).numpy():
        mujoco.mj_kinematics(model, data)
        positions.append(data.xpos[ids])
        orientations.append(data.xquat[ids])
    return np.array(positions), np.array(orientations)


def contacts(model, clip):
    """For each frame: the points on the ground by foot, their depths, and the velocities of the foot there."""
    data, frames = mujoco.MjData(model), []
    jacobian = np.zeros((3, model.nv))
    for qpos, qvel in zip(clip.qpos.numpy(), clip.qvel.numpy(), strict=True):
        data.qpos, data.qvel = qpos, qvel
        mujoco.mj_fwdPosition(model, data)
        found = {side: [] for side in SIDES}
        for contact in data.contact:
            body = model.geom_bodyid[contact.geom].max()
            mujoco.mj_jac(model, data, jacobian, None, contact.pos, body)
            side = model.body(body).name.removesuffix("_toe")
            found[side].append((contact.pos.copy(), contact.dist, jacobian @ qvel))
        frames.append(found)
    return frames


def speed_of_feet(frames, depth):
    """Horizontal speeds of the points of the feet that are no higher than a depth above the ground."""
    return np.array(
        [
            np.linalg.norm(velocity[:2])
            for frame in frames
            for foot in frame.values()
            for _, distance, velocity in foot
            if distance < depth
        ]
    )


def yaw(quaternions):
    return np.unwrap(Rotation.from_quat(quaternions, scalar_first=True).as_euler("ZYX")[..., 0], axis=0)


def test_the_corpus_is_a_walk_two_left_turns_and_two_right_turns_of_eleven_seconds():
    corpus = trex_corpus()
    assert [clip.character for clip in corpus] == ["trex"] * 5
    assert all(clip.loop for clip in corpus)
    assert sum(clip.duration for clip in corpus) == pytest.approx(11)
    assert np.sign([float(clip.cycle.turn) for clip in corpus]).tolist() == [0, 1, 1, -1, -1]


def test_it_is_the_same_every_time(corpus):
    assert all(torch.equal(clip.qpos, again.qpos) for clip, again in zip(corpus[:5], trex_corpus(), strict=True))


def test_standing_and_turning_on_the_spot_are_an_option_beside_the_corpus(model):
    library = standing_library("trex")
    assert float(library.durations.sum()) == pytest.approx(9 * 2.2)
    names = ["straight", "left_gentle", "left_sharp", "right_gentle", "right_sharp", "standing", *CLIPS[5:]]
    assert library.names == names
    standing = trex_stops()["standing"]
    assert not standing.qvel.any()
    for found in contacts(model, standing):
        assert all(min(depth for _, depth, _ in found[side]) == pytest.approx(0, abs=1e-3) for side in SIDES)
    with pytest.raises(ValueError, match=r"character='biped' has stops.*pass motions=generated"):
        standing_library("biped")


@every_clip
def test_speeds_and_turn_rates_are_as_stated(corpus, index):
    clip, speed, rate = corpus[index], SPEEDS[index], TURN_RATES[index]
    assert float(clip.cycle.turn) / clip.duration == pytest.approx(rate, abs=1e-9)
    chord = speed * clip.duration if rate == 0 else abs(2 * speed / rate * np.sin(rate * clip.duration / 2))
    distance = np.linalg.norm(clip.qpos[-1, :2] - clip.qpos[0, :2])
    assert distance == pytest.approx(chord, rel=0.02, abs=0.03)


@every_clip
def test_the_loop_closes_in_pose_and_velocity(corpus, index):
    clip = corpus[index]
    first, last = clip.qpos[[0, -1]]
    torch.testing.assert_close(last[7:], first[7:], atol=1e-9, rtol=0)
    torch.testing.assert_close(last[2], first[2], atol=1e-9, rtol=0)
    turn = Rotation.from_quat(last[3:7], scalar_first=True) * Rotation.from_quat(first[3:7], scalar_first=True).inv()
    np.testing.assert_allclose(turn.as_rotvec()[:2], 0, atol=1e-9)
    spins = torch.cat([clip.qvel[:, 2:3], clip.qvel[:, 6:]], dim=-1)
    changes = (spins[1:] - spins[:-1]).abs().amax(0)
    once_more = clip.velocity(clip.duration + torch.tensor([0.0, 1.0]).double() / clip.fps)
    seam = torch.cat([once_more[:, 2:3], once_more[:, 6:]], dim=-1)
    torch.testing.assert_close(seam[0], spins[-1], atol=1e-6, rtol=0)
    assert ((seam[1] - spins[-1]).abs() <= changes + 1e-6).all()


@every_clip
def test_feet_stay_where_they_are_planted(corpus, model, index):
    speeds = speed_of_feet(contacts(model, corpus[index]), depth=1e-4)
    assert len(speeds) > 600
    assert np.percentile(speeds, 95) < 0.01
    assert speeds.max() < 0.03


@every_clip
def test_nothing_but_the_feet_touches_the_ground_and_nothing_sinks_into_it(corpus, model, index):
    data = mujoco.MjData(model)
    for data.qpos in corpus[index].qpos.numpy():
        mujoco.mj_fwdPosition(model, data)
        assert {model.body(body).name for body in model.geom_bodyid[data.contact.geom].max(1)} <= set(TREX.feet)
        assert data.contact.dist.min() > -1e-6


@every_clip
def test_it_walks_with_one_or_two_feet_on_the_ground_and_neither_hops_nor_shuffles(corpus, model, index):
    frames = contacts(model, corpus[index])[:-1]
    down = np.array([[any(point[1] < 1e-4 for point in frame[side]) for side in SIDES] for frame in frames])
    assert down.any(1).all()
    np.testing.assert_allclose(down.mean(0), 0.62, atol=0.03)
    assert down.all(1).mean() == pytest.approx(0.24, abs=0.05)
    assert (np.abs(np.diff(down.astype(int), axis=0)).sum(0) <= 4).all()
    assert (np.diff(down.astype(int), axis=0) == 1).sum() >= 3


def test_a_swinging_foot_overtakes_the_body_and_clears_the_ground(corpus, model):
    joints, _ = bodies(model, corpus[FORWARD], ["root", "right_toe", "left_toe"], cycles=2)
    forward = np.gradient(joints[..., 0], 1 / corpus[FORWARD].fps, axis=0)
    ahead = joints[:, 1:, 0] - joints[:, :1, 0]
    assert forward[:, 1:].max(0).min() > 2.5
    assert forward[:, 1:].min() > -0.1
    assert (ahead.max(0) > 0.25).all()
    assert (ahead.min(0) < -0.2).all()
    assert (joints[:, 1:, 2].max(0) > 0.2).all()


def test_knees_and_ankles_bend_in_the_swing(corpus, model):
    clip = corpus[FORWARD]
    foot = bodies(model, clip, ["right_toe"])[0][:, 0, 2]
    swinging = foot > 0.15
    for name in ("right_knee", "right_ankle"):
        angle = clip.at(times(clip))[:, model.joint(name).qposadr[0]].numpy() * (-1 if name == "right_knee" else 1)
        assert angle[swinging].mean() > angle[~swinging].mean() + 0.3


def test_right_turns_mirror_left_turns_exactly(corpus):
    for left, right in ((LEFT, RIGHT), (SHARP_LEFT, SHARP_RIGHT), (LEFT_SPOT, RIGHT_SPOT)):
        assert torch.equal(corpus[left].mirrored().qpos, corpus[right].qpos)


def test_a_turn_to_the_right_is_the_mirror_image_half_a_stride_later():
    left, right = trex_walk(0.9, 0.5), trex_walk(0.9, -0.5)
    later = times(left) + 0.55
    torch.testing.assert_close(left.mirrored().at(later)[:, 7:], right.at(times(left))[:, 7:], atol=2e-3, rtol=0)


@every_clip
def test_joint_limits_are_respected(corpus, model, index):
    qpos = corpus[index].qpos.numpy()
    for joint in range(1, model.njnt):
        start, (low, high) = model.jnt_qposadr[joint], model.jnt_range[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_BALL:
            turn = Rotation.from_quat(qpos[:, start : start + 4], scalar_first=True).magnitude()
            assert turn.max() < 0.95 * high, model.joint(joint).name
        else:
            assert low + 0.05 < qpos[:, start].min(), model.joint(joint).name
            assert qpos[:, start].max() < high - 0.05, model.joint(joint).name


@every_clip
def test_it_does_not_walk_through_itself(corpus, index):
    model = TREX.spec(self_collision=True).compile()
    data = mujoco.MjData(model)
    for data.qpos in corpus[index].qpos.numpy():
        mujoco.mj_fwdPosition(model, data)
        assert data.ncon == 0


def test_the_head_is_steadier_than_the_pelvis(corpus, model):
    positions, orientations = bodies(model, corpus[FORWARD], ["root", "head"])
    pelvis, head = detrend(positions, axis=0).std(0)
    assert (pelvis[1:] > 0.005).all()
    assert (head[1:] < 0.1 * pelvis[1:]).all()
    pelvis, head = Rotation.from_quat(orientations.swapaxes(0, 1), scalar_first=True).magnitude()
    assert pelvis.max() > 0.05
    assert head.max() < 1e-6


@every_clip
def test_the_tail_swings_against_the_pelvis(corpus, model, index):
    positions, orientations = bodies(model, corpus[index], ["tail_1", "tail_5", "root"])
    along = positions[:, 0] - positions[:, 1]
    tail, pelvis = np.unwrap(np.arctan2(along[:, 1], along[:, 0])), yaw(orientations[:, 2])
    tail, pelvis = detrend([tail, pelvis])
    assert np.corrcoef(tail, pelvis)[0, 1] < -0.7
    assert np.ptp(tail) > 0.1


@pytest.mark.parametrize("index", [FORWARD, LEFT, SHARP_LEFT, SLOW, LEFT_SPOT], ids=lambda index: CLIPS[index])
def test_the_ground_could_move_it_and_the_motors_are_strong_enough(corpus, model, index):
    clip, data = corpus[index], mujoco.MjData(model)
    free = copy.copy(model)
    free.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    free.dof_damping[:] = 0  # passive damping helps the motors follow; here they do it all
    accelerations = np.gradient(clip.qvel.numpy(), 1 / clip.fps, axis=0)
    weight, residuals, loads = 54.5 * 9.81, [], []
    for frame, found in list(enumerate(contacts(model, clip)))[1:-1]:
        data.qpos, data.qvel, data.qacc = clip.qpos[frame], clip.qvel[frame], accelerations[frame]
        mujoco.mj_inverse(free, data)
        needed = data.qfrc_inverse.copy()
        pushes = ground_forces(model, data, found)
        root = pushes[:, :6].T
        forces, _ = nnls(np.vstack([root, 1e-3 * np.eye(len(pushes))]), np.r_[needed[:6], np.zeros(len(pushes))])
        residuals.append(np.linalg.norm(needed[:3] - root[:3] @ forces) / weight)
        torques = needed - pushes.T @ forces
        loads.append([abs(torques[dofs]).max() for dofs in motors(model)])
    assert np.mean(residuals) < 0.01
    assert np.max(residuals) < 0.05
    limits = [model.actuator_forcerange[actuators[0], 1] for actuators in actuators_of_joints(model)]
    assert (np.max(loads, axis=0) < 0.75 * np.array(limits)).all()


def ground_forces(model, data, found, friction=0.9):
    """Generalised forces of unit pushes up and along the edges of the friction pyramid, at each point on the ground."""
    jacobian, edges = np.zeros((3, model.nv)), [(1, 0), (-1, 0), (0, 1), (0, -1)]
    rows = []
    for side, points in found.items():
        for position, _, _ in points:
            mujoco.mj_jac(model, data, jacobian, None, position, model.body(f"{side}_toe").id)
            rows += [jacobian.T @ [friction * x, friction * y, 1.0] for x, y in edges]
    return np.array(rows)


def motors(model):
    """Velocities that belong to each joint but the root's."""
    widths = np.where(model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_BALL, 3, 1)
    return [range(start, start + width) for start, width in zip(model.jnt_dofadr[1:], widths, strict=True)]


def actuators_of_joints(model):
    return [np.flatnonzero(model.actuator_trnid[:, 0] == joint) for joint in range(1, model.njnt)]


@pytest.mark.parametrize(
    ("speed", "turn_rate", "message"),
    [
        (2.5, 0.0, "speed=2.5.*pass less"),
        (0.5, 1.5, "turn_rate=1.5.*pass less than 1.43"),
        (-1.0, 0.0, "speed=-1.0.*pass 0 or more"),
        (float("nan"), 0.0, "speed=nan"),
        (1.0, float("nan"), "turn_rate=nan"),
    ],
)
def test_a_walk_that_the_body_cannot_make_is_an_error(speed, turn_rate, message):
    with pytest.raises(ValueError, match=message):
        trex_walk(speed, turn_rate)
