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

from torchrl_mcp.envs.simulation import CHANGING_FIELDS, GIVEN_FIELDS, LARGEST, Simulation

DIVERGED = 1 << 30
"""Bit of a fault that is no overflow."""

GROUND_CONTACTS = {mujoco.mjtGeom.mjGEOM_SPHERE: 1, mujoco.mjtGeom.mjGEOM_CAPSULE: 2}
"""Most contacts of a geom with a plane, where they are not four."""

OTHER_CONTACTS = 8
"""Room for contacts with other things than the ground, such as a ball or a box."""


class WarpSimulation(Simulation):
    """A batch of N simulations stepped by MuJoCo Warp, see :class:`~torchrl_mcp.envs.simulation.Simulation`.

    State and outputs are float32 views of Warp's memory; nothing is copied. Everything that a step launches is recorded
    once as a graph: a CUDA graph on a GPU, and Warp's own on the CPU, which is there for tests.

    A simulation also faults where it has more contacts or constraints than there is room for.

    Args:
        model: The compiled model; a copy is kept.
        num_envs: Number N of simulations.
        device: Where to simulate.
        substeps: Physics steps per call of :meth:`step`.
        outputs: See :func:`~torchrl_mcp.envs.engines.make_simulation`.
        model_fields: See :func:`~torchrl_mcp.envs.engines.make_simulation`.
        current: See :func:`~torchrl_mcp.envs.engines.make_simulation`.
        contacts: Contacts that there is room for, on average over all simulations; None for :func:`contact_room`.
        constraints: Constraints that each simulation has room for; None for :func:`constraint_room` of the contacts.
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
        self.model, self.substeps, self.physics_seconds = copy.copy(model), substeps, 0.0
        self.model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # Warp has none to switch off
        self._current, self._model_fields = current, tuple(model_fields)
        wp.init()
        self._device, self._torch_device = wp.device_from_torch(device), device
        room = contact_room(model) if contacts is None else contacts
        rows = constraint_room(model, room) if constraints is None else constraints
        with wp.ScopedDevice(self._device):
            self._model = mjw.put_model(self.model, batch_sizes=dict.fromkeys(model_fields, num_envs))
            self._data = mjw.make_data(self.model, nworld=num_envs, nconmax=room, njmax=rows)
        self._model.opt.warn_overflow = 0  # faults say it
        # What loses contacts or constraints; a solver that has used up its iterations goes on with what it has.
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
            RuntimeError: If there was no room for the contacts of all simulations, so that any of them may lack some.
        """
        self._controls.copy_(ctrl)
        self._run(self._step)
        ids = self._faults.nonzero().squeeze(-1)
        if len(ids):
            self._require_room(int(self._faults[ids[0]]))
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
        """See :meth:`Simulation.data`: by MuJoCo itself, of this state."""
        model = copy.copy(self.model)
        data = mujoco.MjData(model)
        for name, field in self.state.items():
            owner, value = model if name in self._model_fields else data, field[index].double().cpu().numpy()
            if name == "time":
                data.time = float(value)
            else:
                getattr(owner, name)[:] = value
        mujoco.mj_forward(model, data)
        return data

    def _make_graphs(self, num_envs: int) -> None:
        """Record what is launched again and again."""
        with wp.ScopedDevice(self._device):
            arrays = [self._arrays[name] for name in CHANGING_FIELDS if name in self._arrays]
            self._changing = [(array, wp.empty_like(array)) for array in arrays]
            self._asked, self._faulted = wp.zeros_like(self._data.ctrl), wp.zeros(num_envs, dtype=int)
            self._controls, self._faults = _view(self._asked), _view(self._faulted)
            self._step, self._outputs = self._recorded(self._advance), self._recorded(self._compute_outputs)
            self._force = self._recorded(partial(mjw.rne_postconstraint, self._model, self._data))
        for name, value in self._initial.items():  # recording takes a step
            self.state[name].copy_(value.expand_as(self.state[name]))
        self._run(self._outputs)

    def _recorded(self, work: Callable[[], None]) -> Callable[[], None]:
        """Return what does some work again, as one graph where the device has them."""
        work()  # compiles the kernels, or loads them from the cache
        if self._device.is_cuda and not wp.is_mempool_enabled(self._device):
            return work
        with wp.ScopedCapture(self._device) as capture:
            work()
        return partial(wp.capture_launch, capture.graph)

    def _run(self, work: Callable[[], None]) -> None:
        """Do recorded work, on the stream on which torch works, and count the time that it takes to launch it."""
        start = time.perf_counter()
        with wp.ScopedDevice(self._device):
            if self._device.is_cuda:
                with wp.ScopedStream(wp.stream_from_torch(self._torch_device)):
                    work()
            else:
                work()
        self.physics_seconds += time.perf_counter() - start

    def _advance(self) -> None:
        """Take the physics steps of an action, and take them back where they fault."""
        data, faults, worlds = self._data, self._faulted, self._data.nworld
        for now, before in self._changing:
            wp.copy(before, now)
        wp.copy(data.ctrl, self._asked)
        for _ in range(self.substeps):
            mjw.step(self._model, data)
        wp.launch(_note_overflows, worlds, inputs=[data.overflow, self._lost], outputs=[faults])
        # Where float32 ends, Warp's solver gives up and leaves no acceleration: without constraints it would be large.
        for values in (self._asked, data.qacc_smooth, *(now for now, _ in self._changing)):
            wp.launch(_note_divergences, worlds, inputs=[_rows(values), LARGEST, DIVERGED], outputs=[faults])
        for now, before in self._changing:
            rows = _rows(now)
            wp.launch(_take_back, rows.shape, inputs=[faults, _rows(before)], outputs=[rows])
        if self._current:
            self._compute_outputs()

    def _compute_outputs(self) -> None:
        """Compute what follows from positions and velocities."""
        mjw.kinematics(self._model, self._data)
        mjw.com_pos(self._model, self._data)
        mjw.com_vel(self._model, self._data)
        if self.model.nsensordata:
            mjw.collision(self._model, self._data)  # distances are sensed by way of contacts
            self._data.sensordata.zero_()
            mjw.sensor_pos(self._model, self._data)

    def _bring_up_to_date(self, ids: Tensor) -> None:
        """Compute the outputs of some simulations; those of the others stay as they are."""
        others = {} if self._current else {name: value.clone() for name, value in self.outputs.items()}
        self._run(self._outputs)
        for name, before in others.items():
            after = self.outputs[name]
            after.copy_(before.index_copy(0, ids, after[ids]))

    def _require_room(self, fault: int) -> None:
        """Check that a fault is not one of all simulations, whose contacts share their room."""
        if fault & self._shared:
            raise RuntimeError(
                f"{self._data.nworld} simulations have more contacts than the {self._data.naconmax} that there is room "
                "for: pass more contacts to WarpSimulation, or take fewer environments"
            )


def contact_room(model: mujoco.MjModel) -> int:
    """Contacts that each simulation should have room for.

    Half of those that all that can touch the ground could have with it, and eight more. Of the library's scenes, with
    characters that flail and lie about, none has more than 0.6 times as many.
    """
    touching = (model.geom_contype | model.geom_conaffinity) > 0
    kinds = model.geom_type[touching & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)]
    return sum(GROUND_CONTACTS.get(kind, 4) for kind in kinds) // 2 + OTHER_CONTACTS


def constraint_room(model: mujoco.MjModel, contacts: int) -> int:
    """Constraints of as many contacts, with all joints at their limits and all that equalities may hold."""
    dimensions = int(model.geom_condim.max())
    rows = 2 * (dimensions - 1) if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL else dimensions
    limits, frictions = int(model.jnt_limited.sum()), int((model.dof_frictionloss > 0).sum())
    return max(rows, 1) * contacts + limits + frictions + 6 * int(model.neq)


@wp.kernel(enable_backward=False)
def _note_overflows(overflows: wp.array[int], lost: int, faults: wp.array[int]) -> None:
    """Begin faults with the overflows of the steps just made, and forget these."""
    world = wp.tid()
    faults[world] = overflows[world] & lost
    overflows[world] = 0


@wp.kernel(enable_backward=False)
def _note_divergences(values: wp.array2d[float], largest: float, diverged: int, faults: wp.array[int]) -> None:
    """Add the simulations with values that are no numbers below the largest: a NaN compares false."""
    world = wp.tid()
    for column in range(values.shape[1]):
        if not (wp.abs(values[world, column]) < largest):
            faults[world] = faults[world] | diverged


@wp.kernel(enable_backward=False)
def _take_back(faults: wp.array[int], before: wp.array2d[float], values: wp.array2d[float]) -> None:
    """Restore values where there is a fault."""
    world, column = wp.tid()
    if faults[world] != 0:
        values[world, column] = before[world, column]


def _rows(array: Any) -> Any:
    """An array with a row of numbers for each simulation."""
    return array if array.ndim == 2 else array.reshape((array.shape[0], -1))


def _view(array: Any) -> Tensor:
    """An array as a tensor with the shape of MuJoCo's: matrices are rows of nine numbers."""
    tensor = wp.to_torch(array)
    return tensor.flatten(-2) if array.dtype is wp.mat33 else tensor
