"""Many simulations of one MuJoCo model, as torch tensors: what every engine offers."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

import mujoco
from torch import Tensor

# The parts of mjSTATE_INTEGRATION in order, by the names of their MjData fields: all that the next step depends on.
CHANGING_FIELDS = ("time", "qpos", "qvel", "act", "history", "qacc_warmstart", "ctrl")
GIVEN_FIELDS = ("qfrc_applied", "xfrc_applied", "eq_active", "mocap_pos", "mocap_quat", "userdata", "plugin_state")

LARGEST = mujoco.mjMAXVAL
"""MuJoCo's own limit (1e10): a larger state has diverged."""


class Simulation(ABC):
    """A batch of N simulations with faults contained.

    A simulation *faults* in a step when its engine cannot compute it, when its state leaves the finite numbers below
    ``LARGEST``, or when its controls do. It then keeps the state it had before the step, and its neighbours do not
    notice.

    State and outputs have the names and shapes of ``MjData`` in every engine, after the number of the simulation. Their
    type is the engine's.
    """

    model: mujoco.MjModel
    """The compiled model, which all simulations share but for its ``model_fields``."""
    state: dict[str, Tensor]
    """Live views of the state fields that the model has, each ``(N, ...)``. Writing sets the state."""
    outputs: dict[str, Tensor]
    """Live views of the outputs, each ``(N, ...)``: results of the last call, not to be written to."""
    physics_seconds: float
    """Wall-clock seconds spent inside the engine so far."""

    @abstractmethod
    def step(self, ctrl: Tensor) -> Tensor:
        """Advance every simulation by the physics steps of an action.

        Args:
            ctrl: Controls, shape ``(N, A)``.

        Returns:
            The simulations that faulted, shape ``(n,)``, int64; usually none.
        """

    @abstractmethod
    def reset(self, ids: Tensor, fields: Mapping[str, Tensor]) -> None:
        """Set the state of some simulations and bring their outputs up to date.

        Args:
            ids: The n simulations, shape ``(n,)``, int64.
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
        """One simulation as an ``MjData`` with everything computed, to draw it or to look into it."""
