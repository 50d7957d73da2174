"""Many simulations of one MuJoCo model as torch tensors: the interface of the engines."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

import mujoco
from torch import Tensor

# The MjData fields of mjSTATE_INTEGRATION in order: everything that the next step depends on.
CHANGING_FIELDS = ("time", "qpos", "qvel", "act", "history", "qacc_warmstart", "ctrl")
GIVEN_FIELDS = ("qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata", "plugin_state")

LARGEST = mujoco.mjMAXVAL
"""MuJoCo's limit (1e10): a larger state has diverged."""


class Simulation(ABC):
    """A batch of N simulations with isolated faults.

    A simulation *faults* in a step if its engine cannot compute the step, or if its state or controls are not finite or
    not below ``LARGEST``. It then keeps its state from before the step, and other simulations are not affected.

    State and outputs have the names and shapes of ``MjData`` in every engine, after the dimension of simulations. Their
    type depends on the engine.
    """

    model: mujoco.MjModel
    """The compiled model, which all simulations share except its ``model_fields``."""
    state: dict[str, Tensor]
    """Live views of the model's state fields, each ``(N, ...)``. Writing sets the state."""
    outputs: dict[str, Tensor]
    """Live views of the outputs of the last call, each ``(N, ...)``; read-only."""
    physics_seconds: float
    """Wall-clock seconds spent inside the engine so far."""

    @abstractmethod
    def step(self, ctrl: Tensor) -> Tensor:
        """Advance every simulation by the physics steps of an action.

        Args:
            ctrl: Controls, shape ``(N, A)``, of any floating-point type.

        Returns:
            Indices of the simulations that faulted, shape ``(n,)``, int64; usually none.
        """

    @abstractmethod
    def reset(self, ids: Tensor, fields: Mapping[str, Tensor]) -> None:
        """Set the state of some simulations and update their outputs.

        Args:
            ids: Indices of the n simulations, shape ``(n,)``, int64.
            fields: Values of state fields, each ``(n, ...)``; the other fields take the model's defaults.
        """

    @abstractmethod
    def contact_forces(self) -> Tensor:
        """External contact forces on every body, MuJoCo's ``cfrc_ext``, at the time of the outputs.

        Returns:
            Torques and forces about the centre of mass, shape ``(N, bodies, 6)``, in N m and N.
        """

    @abstractmethod
    def data(self, index: int) -> mujoco.MjData:
        """One simulation as a fully computed ``MjData``, for drawing or inspection."""
