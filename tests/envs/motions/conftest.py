import math

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from torchrl_mcp.envs.characters.joints import character_model


@pytest.fixture(scope="session")
def human_bands() -> dict[str, tuple[float, float]]:
    """Of measured walking at 1 m/s, in metres and degrees: means of subjects and the spread between them."""
    return {
        "step_width": (0.06, 0.16),
        "stance": (0.62, 0.67),
        "double_support": (0.25, 0.34),
        "sway": (0.02, 0.055),
        "thigh_forward": (26, 36),
        "thigh_back": (-29, -8),
        "knee_strike": (0, 10),
        "knee_loading": (6, 25),
        "knee_stance": (0, 12),
        "knee_swing": (65, 77),
        "ankle_dorsiflexion": (13, 24),
        "ankle_plantarflexion": (-25, -4),
        "pitch_strike": (15, 26),
        "pitch_toe_off": (-80, -62),
        "pelvis_yaw": (4, 15),
        "pelvis_list": (6, 14),
        "shoulder_yaw": (2, 11),
        "trunk_roll": (2, 8),
        "toe_clearance": (0.085, 0.115),
        "slide": (0, 0.03),
        "arm_swing": (24, 46),
        "elbow_mean": (15, 34),
        "elbow_swing": (18, 50),
    }


@pytest.fixture(scope="session")
def kinematics():
    """Body positions and orientations of a frame of a clip by name, from MuJoCo."""

    def kinematics(clip, index=0):
        model = character_model(clip.character)
        data = mujoco.MjData(model)
        data.qpos = clip.qpos[index].numpy()
        mujoco.mj_kinematics(model, data)
        names = [model.body(i).name for i in range(model.nbody)]
        orientations = data.xmat.reshape(-1, 3, 3)
        return dict(zip(names, data.xpos.copy(), strict=True)), dict(zip(names, orientations, strict=True))

    return kinematics


@pytest.fixture(scope="session")
def turned():
    """A rotation about an axis by degrees."""

    def turned(axis, degrees):
        return Rotation.from_rotvec(math.radians(degrees) * np.asarray(axis, float))

    return turned


@pytest.fixture(scope="session")
def posed():
    """States of the humanoid from frames of a position of the root and of rotations or angles by joint."""

    def posed(frames):
        model = character_model("humanoid")
        qpos = np.tile(model.qpos0, (len(frames), 1))
        for row, (position, joints) in zip(qpos, frames, strict=True):
            row[:3] = position
            for name, value in joints.items():
                start = model.joint(name).qposadr[0] + (3 if name == "root" else 0)
                if isinstance(value, Rotation):
                    row[start : start + 4] = value.as_quat(scalar_first=True)
                else:
                    row[start] = value
        return torch.from_numpy(qpos)

    return posed
