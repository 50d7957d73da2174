"""Simulations on a GPU by MuJoCo Warp, in float32. The extra ``warp`` installs it."""

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import mujoco
import mujoco_warp as mjw
import torch
import warp as wp
from torch import Tensor

from torchrl_mcp.envs.physics.simulation import CHANGING_FIELDS, GIVEN_FIELDS, LARGEST, Simulation

DIVERGED = 1 << 30
"""Bit of a fault for divergence; the other bits are Warp's overflows."""

GROUND_CONTACTS = {mujoco.mjtGeom.mjGEOM_SPHERE: 1, mujoco.mjtGeom.mjGEOM_CAPSULE: 2}
"""Maximum number of contacts of a geom with a plane; other types have four."""

OTHER_CONTACTS = 8
"""Additional contacts, with objects such as a ball or a box."""

JOINED_TOLERANCE = 1e-10
"""Tolerance of the solver in scenes with equality constraints.

Warp raises MuJoCo's 1e-8 to 1e-6, at which the first Newton steps end in float32: a box held by a stiff weld is then
wrong by up to 0.3 m/s after a control step. With 1e-10 the solver takes four iterations instead of two.
"""


class WarpSimulation(Simulation):
    """A batch of N simulations stepped by MuJoCo Warp, see :class:`~torchrl_mcp.envs.physics.simulation.Simulation`.

    State and outputs are float32 views of Warp's memory, without copies. The kernels of a step are recorded once as a
    graph: a CUDA graph on a GPU, and Warp's own kind of graph on the CPU, which serves tests.

    A simulation also faults if it has more contacts or constraints than the allocated memory holds.

    Args:
        model: The compiled model; a copy is kept.
        num_envs: Number N of simulations.
        device: Device of the simulation.
        substeps: Physics steps per call of :meth:`step`.
        outputs: See :data:`~torchrl_mcp.envs.physics.engines.Engine`.
        model_fields: See :data:`~torchrl_mcp.envs.physics.engines.Engine`.
        current: See :data:`~torchrl_mcp.envs.physics.engines.Engine`.
        contacts: Allocated contacts, on average over all simulations; None for :func:`contact_room`.
        constraints: Allocated constraints of each simulation; None for :func:`constraint_room` of the contacts.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        *,
        device: torch.device,
        substeps: int,
        outputs: Sequence[str] = (),
        model_fields: Sequence[str] = (),
        current: bool = False,
        contacts: int | None = None,
        constraints: int | None = None,
    ) -> None:
        self.model = copy.copy(model)
        self.substeps = substeps
        self.physics_seconds = 0.0
        self.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # Warp has no automatic reset
        self._current = current
        self._model_fields = tuple(model_fields)
        wp.init()
        self._device = wp.device_from_torch(device)
        self._torch_device = device
        room = contact_room(model) if contacts is None else contacts
        rows = constraint_room(model, room) if constraints is None else constraints
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(self.model, batch_sizes=dict.fromkeys(model_fields, num_envs))
            self._data = mjw.make_data(self.model, nworld=num_envs, nconmax=room, njmax=rows)
            if model.neq:
                self._model.opt.tolerance.fill_(JOINED_TOLERANCE)
        self._model.opt.warn_overflow = 0  # faults report overflows
        # Overflows that lose contacts or constraints. A solver that reaches its maximum of iterations is no fault.
        overflow = mjw.OverflowType
        self._lost = int(overflow.ALL & ~(overflow.ITERATIONS | overflow.LS_ITERATIONS))
        self._shared = int(overflow.BROADPHASE | overflow.NARROWPHASE)
        if self._device.is_cuda:
            self._model.opt.graph_conditional = wp.is_conditional_graph_supported()
        names = [name for name in (*CHANGING_FIELDS, *GIVEN_FIELDS) if hasattr(self._data, name)]
        arrays = {name: getattr(self._data, name) for name in names}
        arrays |= {name: getattr(self._model, name) for name in model_fields}
        self._arrays = {name: array for name, array in arrays.items() if array.size}
        self.state = {name: _view(array) for name, array in self._arrays.items()}
        sensors = ["sensordata"] if model.nsensordata else []
        self.outputs = {name: _view(getattr(self._data, name)) for name in (*outputs, *sensors)}
        self._forces = _view(self._data.cfrc_ext)
        self._initial = {name: value[:1].clone() for name, value in self.state.items()}
        self._make_graphs(num_envs)

    def step(self, ctrl: Tensor) -> Tensor:
        """See :meth:`Simulation.step`.

        Raises:
            RuntimeError: If the shared memory for contacts was too small, so that any simulation may lack contacts.
        """
        self._controls.copy_(ctrl)
        self._run(self._step)
        ids = self._faults.nonzero().squeeze(-1)
        if len(ids):
            self._require_room(self._faults[ids])
            if not self._current:
                self._bring_up_to_date(ids)
        return ids

    def reset(self, ids: Tensor, fields: Mapping[str, Tensor]) -> None:
        """See :meth:`Simulation.reset`."""
        for name, state in self.state.items():
            values = fields.get(name, self._initial[name].expand(len(ids), *state.shape[1:]))
            state.index_copy_(0, ids, values.to(state.device, state.dtype))
        self._bring_up_to_date(ids)

    def contact_forces(self) -> Tensor:
        """See :meth:`Simulation.contact_forces`."""
        self._run(self._force)
        return self._forces

    def data(self, index: int) -> mujoco.MjData:
        """See :meth:`Simulation.data`: MuJoCo computes it from the state."""
        model = copy.copy(self.model)
        data = mujoco.MjData(model)
        for name, field in self.state.items():
            owner = model if name in self._model_fields else data
            value = field[index].double().cpu().numpy()
            if name == "time":
                data.time = float(value)
            else:
                getattr(owner, name)[:] = value
        mujoco.mj_forward(model, data)
        return data

    def _make_graphs(self, num_envs: int) -> None:
        """Record the graphs of a step, of the outputs and of the contact forces."""
        with wp.ScopedDevice(self._device):
            arrays = [self._arrays[name] for name in CHANGING_FIELDS if name in self._arrays]
            self._changing = [(array, wp.empty_like(array)) for array in arrays]
            self._asked = wp.zeros_like(self._data.ctrl)
            self._faulted = wp.zeros(num_envs, dtype=int)
            self._controls = _view(self._asked)
            self._faults = _view(self._faulted)
            self._step = self._recorded(self._advance)
            self._outputs = self._recorded(self._compute_outputs)
            self._force = self._recorded(partial(mjw.rne_postconstraint, self._model, self._data))
        for name, value in self._initial.items():  # recording takes a step
            self.state[name].copy_(value.expand_as(self.state[name]))
        self._run(self._outputs)

    def _recorded(self, work: Callable[[], None]) -> Callable[[], None]:
        """Return a function that repeats some work, as one graph if the device supports graphs."""
        work()  # compiles the kernels, or loads them from the cache
        if self._device.is_cuda and not wp.is_mempool_enabled(self._device):
            return work
        with wp.ScopedCapture(self._device) as capture:
            work()
        return partial(wp.capture_launch, capture.graph)

    def _run(self, work: Callable[[], None]) -> None:
        """Launch recorded work on torch's stream, and add the time of launching to ``physics_seconds``."""
        start = time.perf_counter()
        with wp.ScopedDevice(self._device):
            if self._device.is_cuda:
                with wp.ScopedStream(wp.stream_from_torch(self._torch_device)):
                    work()
            else:
                work()
        self.physics_seconds += time.perf_counter() - start

    def _advance(self) -> None:
        """Take the physics steps of an action, and undo them in simulations that fault."""
        data = self._data
        faults = self._faulted
        worlds = self._data.nworld
        for now, before in self._changing:
            wp.copy(before, now)
        wp.copy(data.ctrl, self._asked)
        for _ in range(self.substeps):
            if self.model.neq:  # Warp's joints read the velocities of bodies before a step computes them
                self._compute_velocities()
            mjw.step(self._model, data)
        wp.launch(_note_overflows, worlds, inputs=[data.overflow, self._lost], outputs=[faults])
        # Beyond the range of float32, Warp's solver fails and leaves zero accelerations. The unconstrained acceleration
        # qacc_smooth is large then, so it is checked too.
        for values in (self._asked, data.qacc_smooth, *(now for now, _ in self._changing)):
            wp.launch(_note_divergences, worlds, inputs=[_rows(values), LARGEST, DIVERGED], outputs=[faults])
        for now, before in self._changing:
            rows = _rows(now)
            wp.launch(_take_back, rows.shape, inputs=[faults, _rows(before)], outputs=[rows])
        if self._current:
            self._compute_outputs()

    def _compute_velocities(self) -> None:
        """Compute places and velocities of bodies."""
        mjw.kinematics(self._model, self._data)
        mjw.com_pos(self._model, self._data)
        mjw.com_vel(self._model, self._data)

    def _compute_outputs(self) -> None:
        """Compute the outputs, which depend on positions and velocities."""
        self._compute_velocities()
        if self.model.nsensordata:
            mjw.collision(self._model, self._data)  # distance sensors read the contacts
            self._data.sensordata.zero_()
            mjw.sensor_pos(self._model, self._data)

    def _bring_up_to_date(self, ids: Tensor) -> None:
        """Compute the outputs of some simulations without changing those of the others."""
        others = {} if self._current else {name: value.clone() for name, value in self.outputs.items()}
        self._run(self._outputs)
        for name, before in others.items():
            after = self.outputs[name]
            after.copy_(before.index_copy(0, ids, after[ids]))

    def _require_room(self, faults: Tensor) -> None:
        """Check that no fault, ``(M,)``, is an overflow of the memory that all simulations share for contacts."""
        if (faults & self._shared).any():
            raise RuntimeError(
                f"{self._data.nworld} simulations have more contacts than the {self._data.naconmax} that there is room "
                "for: pass more contacts to WarpSimulation, or take fewer environments"
            )


def contact_room(model: mujoco.MjModel) -> int:
    """Return the number of contacts to allocate for each simulation.

    This is half of the contacts that all geoms could have with the ground, and eight more. In falls of the library's
    characters, no simulation of any scene had more than 0.6 times this number.
    """
    touching = (model.geom_contype | model.geom_conaffinity) > 0
    kinds = model.geom_type[touching & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)]
    return sum(GROUND_CONTACTS.get(kind, 4) for kind in kinds) // 2 + OTHER_CONTACTS


def constraint_room(model: mujoco.MjModel, contacts: int) -> int:
    """Return the number of constraints of ``contacts``, of all joints at their limits and of all equalities."""
    dimensions = int(model.geom_condim.max())
    rows = 2 * (dimensions - 1) if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL else dimensions
    limits = int(model.jnt_limited.sum())
    frictions = int((model.dof_frictionloss > 0).sum())
    return max(rows, 1) * contacts + limits + frictions + 6 * int(model.neq)


@wp.kernel(enable_backward=False)
def _note_overflows(overflows: wp.array[int], lost: int, faults: wp.array[int]) -> None:
    """Set the faults to the overflows of the last steps, and clear the overflows."""
    world = wp.tid()
    faults[world] = overflows[world] & lost
    overflows[world] = 0


@wp.kernel(enable_backward=False)
def _note_divergences(values: wp.array2d[float], largest: float, diverged: int, faults: wp.array[int]) -> None:
    """Add a fault to simulations with values that are NaN or not below the largest: a NaN compares false."""
    world = wp.tid()
    for column in range(values.shape[1]):
        if not (wp.abs(values[world, column]) < largest):
            faults[world] = faults[world] | diverged


@wp.kernel(enable_backward=False)
def _take_back(faults: wp.array[int], before: wp.array2d[float], values: wp.array2d[float]) -> None:
    """Restore the earlier values of simulations with a fault."""
    world, column = wp.tid()
    if faults[world] != 0:
        values[world, column] = before[world, column]


def _rows(array: Any) -> Any:
    """Return an array as a matrix with one row per simulation."""
    return array if array.ndim == 2 else array.reshape((array.shape[0], -1))


def _view(array: Any) -> Tensor:
    """Return an array as a tensor in MuJoCo's shape, in which a matrix is a row of nine numbers."""
    tensor = wp.to_torch(array)
    return tensor.flatten(-2) if array.dtype is wp.mat33 else tensor
