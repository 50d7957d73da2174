"""The engines that simulate: MuJoCo's threads on the CPU, and MuJoCo Warp on a GPU."""

from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

import mujoco
import torch

from torchrl_mcp.envs.batch_simulation import BatchSimulation
from torchrl_mcp.envs.simulation import Simulation

ENGINES = ("mujoco", "warp")
"""The words of ``physics=``."""


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
    """Return simulations of a model by an engine.

    Args:
        model: The compiled model.
        num_envs: Number N of simulations.
        physics: The engine, one of ``ENGINES``.
        device: Where state and outputs are.
        num_threads: Of MuJoCo's thread pool.
        persistent: Of MuJoCo's thread pool.
        substeps: Physics steps per call of :meth:`Simulation.step`.
        outputs: The other ``MjData`` fields to expose, beside the sensors. After :meth:`Simulation.step` they are one
            substep behind the state, as after ``mj_step``; after :meth:`Simulation.reset` they are current.
        model_fields: The ``MjModel`` fields of which every simulation has its own. They count as state.
        current: Bring outputs that follow from positions and velocities up to the state after every step.

    Raises:
        ValueError: If there is no such engine, it is not installed, or it does not run on the device.
    """
    shared: dict[str, Any] = {"substeps": substeps, "outputs": outputs, "model_fields": model_fields}
    require_engine(physics, device)
    if physics == "mujoco":
        shared |= {"num_threads": num_threads, "persistent": persistent}
        return BatchSimulation(model, num_envs, current=current, **shared)
    from torchrl_mcp.envs.warp_simulation import WarpSimulation  # an extra, and its kernels take seconds to load

    return WarpSimulation(model, num_envs, current=current, device=device, **shared)


def require_engine(physics: str, device: torch.device) -> None:
    """Check that an engine is installed and runs on a device.

    Raises:
        ValueError: If it is not, or does not.
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
