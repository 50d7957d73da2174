"""Walk with an exported policy: NumPy, MuJoCo and ONNX Runtime, without torch and without this library."""

import json
import sys
from collections.abc import Mapping

import mujoco
import numpy as np
import onnxruntime

SECONDS = 20


def rotated(vectors: np.ndarray, angle: float) -> np.ndarray:
    """Turn vectors ``(*B, 3)`` about the vertical axis by ``-angle``, in radians: into the heading frame."""
    cos, sin = np.cos(angle), np.sin(angle)
    return vectors @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def heading(data: mujoco.MjData) -> float:
    """Angle of the root's x axis from the world's, in radians."""
    return float(np.arctan2(data.xmat[1, 3], data.xmat[1, 0]))


def observe(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    """State of the character, ``(S,)``: the entries that the metadata name, in their order."""
    angle = heading(data)
    turn = np.array([np.cos(angle / 2), 0, 0, -np.sin(angle / 2)])
    parts = [data.xpos[1, 2:]]
    for body in range(1, model.nbody):
        orientation, velocity = np.empty(4), np.empty(6)
        mujoco.mju_mulQuat(orientation, turn, data.xquat[body])
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
        parts += [
            rotated(data.xpos[body] - data.xpos[1], angle),
            orientation * np.copysign(1, orientation[0]),
            rotated(velocity[3:], angle),
            rotated(velocity[:3], angle),
        ]
    return np.concatenate(parts)


def controls(actuators: list[Mapping[str, float]], action: np.ndarray) -> np.ndarray:
    """Targets of the servos, ``(A,)``, in radians, for an action in [-1, 1]."""
    return np.array([one["centre"] for one in actuators]) + action * np.array([one["scale"] for one in actuators])


def main() -> None:
    """Walk along the world's x axis, and print how far."""
    session = onnxruntime.InferenceSession(sys.argv[1])
    metadata = {key: json.loads(text) for key, text in session.get_modelmeta().custom_metadata_map.items()}
    model = mujoco.MjModel.from_xml_string(metadata["scene"])
    data = mujoco.MjData(model)
    substeps = round(metadata["control_timestep"] / metadata["physics_timestep"])
    mujoco.mj_forward(model, data)
    while data.time < SECONDS:
        angle = -heading(data)  # of the target direction, seen by the character
        goal = np.array([[np.cos(angle), np.sin(angle)]], dtype=np.float32)
        observation = observe(model, data)[None].astype(np.float32)
        (action,) = session.run(["action"], {"observation": observation, "goal": goal})
        data.ctrl = controls(metadata["action"], action[0])
        mujoco.mj_step(model, data, substeps)
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
    print(f"{data.qpos[0]:.1f} m in {data.time:.0f} s, the root {data.qpos[2]:.2f} m above the ground")


if __name__ == "__main__":
    main()
