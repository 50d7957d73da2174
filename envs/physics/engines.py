"""The physics engines: MuJoCo's threads on the CPU, and MuJoCo Warp on a GPU."""

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import mujoco
import torch

from torchrl_mcp.envs.physics.batch import BatchSimulation
from torchrl_mcp.envs.physics.simulation import Simulation

Engine = Callable[..., Simulation]
"""An engine makes simulations from

* ``model``: the compiled model;
* ``num_envs``: number N of simulations;

and from these arguments, by name:

* ``device``: device of state and outputs;
* ``num_threads``: threads on a CPU; 0 takes one per processor;
* ``persistent``: keep one ``MjData`` per simulation, which MuJoCo's threads need for contact forces;
* ``substeps``: physics steps per call of :meth:`Simulation.step`;
* ``outputs``: ``MjData`` fields to expose in addition to the sensors. After :meth:`Simulation.step` they are one
  substep behind the state, as after ``mj_step``; after :meth:`Simulation.reset` they are current;
* ``model_fields``: ``MjModel`` fields of which every simulation has its own copy. They count as state;
* ``current``: after every step, update the outputs that follow from positions and velocities.
"""


def mujoco_threads(model: mujoco.MjModel, num_envs: int, *, device: torch.device, **settings: Any) -> Simulation:
    """Return simulations on MuJoCo's thread pool, from the arguments of every :data:`Engine`.

    Raises:
        ValueError: If the device is not the CPU.
    """
    if device.type != "cpu":
        raise ValueError(
            f"device={device}: MuJoCo's threads simulate on the CPU. Pass physics='warp', or leave device out and move "
            "what the environment emits"
        )
    return BatchSimulation(model, num_envs, **settings)


def mujoco_warp(
    model: mujoco.MjModel, num_envs: int, *, num_threads: int, persistent: bool, **settings: Any
) -> Simulation:
    """Return simulations by MuJoCo Warp, from the arguments of every :data:`Engine`.

    Raises:
        ValueError: If it is not installed.
    """
    if find_spec("mujoco_warp") is None:
        raise ValueError("physics=warp needs MuJoCo Warp: pip install 'torchrl-mcp[warp]', or choose physics=mujoco")
    from torchrl_mcp.envs.physics.warp import WarpSimulation  # an extra whose kernels take seconds to load

    return WarpSimulation(model, num_envs, **settings)


ENGINES: dict[str, Engine] = {"mujoco": mujoco_threads, "warp": mujoco_warp}
"""The engines by name."""


def named(physics: str | Engine) -> Engine:
    """Return an engine by its name, or the one given.

    Raises:
        ValueError: If the name is unknown.
    """
    if not isinstance(physics, str):
        return physics
    if physics not in ENGINES:
        raise ValueError(f"physics={physics!r} is unknown: pass {' or '.join(ENGINES)}")
    return ENGINES[physics]
