import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.joints import character_model
from torchrl_mcp.envs.motions.capture.importer import import_motion

# A body in a T-pose, y up, z forward, x left, in metres: joint, parent, offset. The soles are 5 cm below the ankles.
BODY = [
    ("Hips", None, (0, 0, 0)),
    ("Spine", "Hips", (0, 0.1, 0)),
    ("Chest", "Spine", (0, 0.14, 0)),
    ("Neck", "Chest", (0, 0.24, 0)),
    ("Head", "Neck", (0, 0.08, 0)),
]
for side, sign in (("Left", 1), ("Right", -1)):
    BODY += [
        (f"{side}UpLeg", "Hips", (sign * 0.09, -0.02, 0.01)),
        (f"{side}Leg", f"{side}UpLeg", (0, -0.43, 0)),
        (f"{side}Foot", f"{side}Leg", (0, -0.42, 0)),
        (f"{side}Toe", f"{side}Foot", (0, -0.05, 0.13)),
        (f"{side}Shoulder", "Chest", (sign * 0.04, 0.2, 0)),
        (f"{side}Arm", f"{side}Shoulder", (sign * 0.14, 0, 0)),
        (f"{side}ForeArm", f"{side}Arm", (sign * 0.27, 0, 0)),
        (f"{side}Hand", f"{side}ForeArm", (sign * 0.25, 0, 0)),
    ]


@pytest.fixture(scope="session")
def skeleton():
    """The body that is retargeted."""
    return BODY


@pytest.fixture(scope="session")
def forward():
    """From the axes of the body to the character's: x is what z was."""
    return np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])


@pytest.fixture(scope="session")
def about():
    """A rotation by an axis and degrees."""

    def about(axis, degrees):
        return Rotation.from_rotvec(math.radians(degrees) * np.asarray(axis, float))

    return about


@pytest.fixture(scope="session")
def arms_down(about):
    """A pose with the arms down, and other joints turned as told."""

    def arms_down(**turns):
        return {"LeftArm": about([0, 0, 1], -90), "RightArm": about([0, 0, 1], 90), **turns}

    return arms_down


@pytest.fixture(scope="session")
def any_pose(about):
    """A pose in which nearly every joint is turned."""
    return {
        "Hips": about([1, 2, -1], 20),
        "Spine": about([0, 1, 1], 10),
        "Chest": about([1, -1, 0], 12),
        "Head": about([1, 1, 1], 20),
        "LeftUpLeg": about([-1, 0.3, 0.2], 30),
        "LeftLeg": about([1, 0, 0.4], 40),  # a knee that does not flex about its own axis alone
        "LeftFoot": about([1, 2, 0], -15),
        "RightUpLeg": about([1, 0.5, -0.2], 15),
        "RightLeg": about([1, 0, -0.3], 65),
        "LeftShoulder": about([1, 1, 1], 8),
        "LeftArm": about([0, 0, 1], -70) * about([0, 1, 0], -20),
        "LeftForeArm": about([0.5, -1, 0], 45),
        "RightArm": about([0, 0, 1], 60) * about([0, 1, 0.5], 30),
        "RightForeArm": about([0, 1, 0.5], 30),
    }


@pytest.fixture(scope="session")
def bvh(skeleton):
    """A BVH file of poses, each a rotation by joint; joints not named are not turned.

    ``axes`` are those of the file, ``frames`` rotations of the frame in which each joint turns.
    """

    def bvh(
        poses,
        *,
        body=skeleton,
        order="ZXY",
        unit=1.0,
        axes=None,
        rename=lambda name: name,
        path=None,
        fps=30.0,
        position=(0, 0.9, 0),
        frames=None,
    ):
        turn, own = Rotation.from_matrix(np.eye(3) if axes is None else axes), frames or {}
        own = {None: turn.inv(), **{name: own.get(name, Rotation.identity()) * turn.inv() for name, _, _ in body}}
        channels = " ".join(f"{axis}rotation" for axis in order)
        sequence = []

        def joint(index, keyword):
            name, parent, offset = body[index]
            sequence.append((name, parent))
            offset = " ".join(map(repr, (own[parent].inv().apply(offset) / unit).tolist()))
            extra = "6 Xposition Yposition Zposition" if keyword == "ROOT" else "3"
            children = [child for child, (_, above, _) in enumerate(body) if above == name]
            inner = "".join(joint(child, "JOINT") for child in children)
            return f"{keyword} {rename(name)}\n{{\nOFFSET {offset}\nCHANNELS {extra} {channels}\n{inner}}}\n"

        text = "HIERARCHY\n" + joint(0, "ROOT") + f"MOTION\nFrames: {len(poses)}\nFrame Time: {1 / fps!r}\n"
        for pose, place in zip(poses, [position] * len(poses) if path is None else path, strict=True):
            row = (turn.apply(place) / unit).tolist()
            for name, parent in sequence:
                rotation = own[parent].inv() * pose.get(name, Rotation.identity()) * own[name]
                row += rotation.as_euler(order, degrees=True).tolist()
            text += " ".join(map(repr, row)) + "\n"
        return text

    return bvh


@pytest.fixture
def load(bvh, tmp_path):
    """Write poses as BVH, and import them."""

    def load(poses, character="humanoid", *, options=None, **layout):
        path = tmp_path / "motion.bvh"
        path.write_text(bvh(poses, **layout))
        return import_motion(path, character, **(options or {}))

    return load


@pytest.fixture(scope="session")
def hinge():
    """Angles of a hinge of a clip by name."""

    def hinge(clip, name):
        return clip.qpos[:, character_model(clip.character).joint(name).qposadr[0]]

    return hinge
