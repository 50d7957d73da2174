"""The physics engines: MuJoCo's threads on the CPU, and MuJoCo Warp on a GPU."""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import mujoco
import torch

from torchrl_mcp.envs.physics.batch import BatchSimulation
from torchrl_mcp.envs.physics.simulation import Simulation

ENGINES = ("mujoco", "warp")
"""Values of ``physics=``."""


def make_simulation(
    model: mujoco.MjModel,
    num_envs: int,
    *,
    physics: str,
    device: torch.device,
    num_threads: int,
    persistent: bool,
    substeps: int,
    outputs: Sequence[str],
    model_fields: Sequence[str],
    current: bool,
) -> Simulation:
    """Return simulations of a model with an engine.

    Args:
        model: The compiled model.
        num_envs: Number N of simulations.
        physics: The engine, one of ``ENGINES``.
        device: Device of state and outputs.
        num_threads: Size of MuJoCo's thread pool.
        persistent: Keep one ``MjData`` per simulation in MuJoCo's thread pool.
        substeps: Physics steps per call of :meth:`Simulation.step`.
        outputs: ``MjData`` fields to expose in addition to the sensors. After :meth:`Simulation.step` they are one
            substep behind the state, as after ``mj_step``; after :meth:`Simulation.reset` they are current.
        model_fields: ``MjModel`` fields of which every simulation has its own copy. They count as state.
        current: After every step, update the outputs that follow from positions and velocities.

    Raises:
        ValueError: If the engine is unknown, is not installed, or does not run on the device.
    """
    shared: dict[str, Any] = {"substeps": substeps, "outputs": outputs, "model_fields": model_fields}
    require_engine(physics, device)
    if physics == "mujoco":
        shared |= {"num_threads": num_threads, "persistent": persistent}
        return BatchSimulation(model, num_envs, current=current, **shared)
    from torchrl_mcp.envs.physics.warp import WarpSimulation  # an extra whose kernels take seconds to load

    return WarpSimulation(model, num_envs, current=current, device=device, **shared)


def require_engine(physics: str, device: torch.device) -> None:
    """Check that an engine is installed and runs on a device.

    Raises:
        ValueError: If the engine is unknown, is not installed, or does not run on the device.
    """
    if physics not in ENGINES:
        raise ValueError(f"physics={physics!r} is unknown: pass {' or '.join(ENGINES)}")
    if physics == "mujoco" and device.type != "cpu":
        raise ValueError(
            f"device={device}: MuJoCo's threads simulate on the CPU. Pass physics='warp', or leave device out and move "
            "what the environment emits"
        )
    if physics == "warp" and find_spec("mujoco_warp") is None:
        raise ValueError("physics=warp needs MuJoCo Warp: pip install 'torchrl-mcp[warp]', or choose physics=mujoco")
