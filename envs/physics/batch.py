"""Simulations on MuJoCo's own thread pool, in float64."""

import copy
import os
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
import torch
from mujoco.batch import Batch, SimulationError
from torch import Tensor

from torchrl_mcp.envs.physics.simulation import CHANGING_FIELDS, GIVEN_FIELDS, LARGEST, Simulation


class BatchSimulation(Simulation):
    """A :class:`~torchrl_mcp.envs.physics.simulation.Simulation` that MuJoCo's thread pool steps.

    MuJoCo's default on divergence, a silent reset in the middle of a step, is switched off; its warnings still go to
    ``MUJOCO_LOG.TXT`` in the working directory. State and outputs are float64.

    The arguments are those of every :data:`~torchrl_mcp.envs.physics.engines.Engine` but the device. Results do not
    depend on ``num_threads``. If ``persistent``, ``current`` costs nothing, because the next step reuses the results.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        num_envs: int,
        *,
        substeps: int,
        outputs: Sequence[str] = (),
        model_fields: Sequence[str] = (),
        num_threads: int = 0,
        persistent: bool = False,
        current: bool = False,
    ) -> None:
        self.model = copy.copy(model)
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.substeps = substeps
        stages = mujoco.mjtStage
        self._after_step = stages.mjSTAGE_VEL if current else stages.mjSTAGE_NONE
        self._after_reset = stages.mjSTAGE_VEL if current else stages.mjSTAGE_ACC
        self.physics_seconds = 0.0
        self._process = os.getpid()
        self._batch = Batch(self.model, num_envs, num_threads, persistent)
        self._data = mujoco.MjData(self.model)
        fields = {name: self._batch.bind(name) for name in (*CHANGING_FIELDS, *GIVEN_FIELDS)}
        fields.update((name, self._batch.expand(name)) for name in model_fields)
        self._fields = {name: field for name, field in fields.items() if field.size}
        self.state = {name: torch.from_numpy(field) for name, field in self._fields.items()}
        self._model_fields = tuple(model_fields)
        self._rows = self._batch.state[:, : sum(fields[name][0].size for name in CHANGING_FIELDS)]
        self._initial = self._batch.state[0].copy()
        self._before = np.empty_like(self._rows)
        sensors = ["sensordata"] if model.nsensordata else []
        self.outputs = {name: _view(self._batch.bind(name)) for name in (*outputs, *sensors)}
        self._num_contacts = self._batch.bind("ncon")
        self._num_constraints = self._batch.bind("nefc")

    def step(self, ctrl: Tensor) -> Tensor:
        """See :meth:`Simulation.step`."""
        controls = ctrl.detach().double().numpy()  # of any precision, as from autocast
        np.copyto(self._before, self._rows)
        np.copyto(self._fields["ctrl"], controls)
        failed = self._run(self._batch.step, nstep=self.substeps, stage=self._after_step)
        if not len(failed) and _bounded(controls) and _bounded(self._rows):
            return torch.from_numpy(_NOBODY)
        faults = ~(_bounded(controls, -1) & _bounded(self._rows, -1))
        faults[failed] = True
        ids = faults.nonzero()[0]
        self._rows[ids] = self._before[ids]
        self._run(self._batch.forward, ids, stage=self._after_reset)  # outputs that fail to compute keep their values
        self._rows[ids] = self._before[ids]
        return torch.from_numpy(ids)

    def reset(self, ids: Tensor, fields: Mapping[str, Tensor]) -> None:
        """See :meth:`Simulation.reset`.

        Raises:
            ValueError: If MuJoCo cannot compute the state.
        """
        rows = ids.numpy()
        self._batch.state[rows] = self._initial
        for name in self._model_fields:
            self._fields[name][rows] = getattr(self.model, name)
        for name, value in fields.items():
            self._fields[name][rows] = value.numpy()
        if len(failed := self._run(self._batch.forward, rows, stage=self._after_reset)):
            raise ValueError(f"MuJoCo cannot compute the state given to simulation {failed[0]}: correct it")
        if "qacc_warmstart" in fields:  # mj_forward replaced it
            self._fields["qacc_warmstart"][rows] = fields["qacc_warmstart"].numpy()

    def contact_forces(self) -> Tensor:
        """See :meth:`Simulation.contact_forces`.

        They come from ``mj_rnePostConstraint``, which ``Batch`` cannot call, so each ``MjData`` is copied to Python, in
        about 20 microseconds each on one thread.
        """
        forces = np.empty((len(self._rows), self.model.nbody, 6))
        start = time.perf_counter()
        for index, row in enumerate(forces):
            self._batch.get_data(index, self._data)
            mujoco.mj_rnePostConstraint(self.model, self._data)
            row[:] = self._data.cfrc_ext
        self.physics_seconds += time.perf_counter() - start
        return torch.from_numpy(forces)

    def data(self, index: int) -> mujoco.MjData:
        """See :meth:`Simulation.data`."""
        self._batch.get_data(index, self._data)
        mujoco.mj_forward(self._batch.get_model(index), self._data)
        return self._data

    def _run(self, call: Callable[..., None], *args: Any, **kwargs: Any) -> np.ndarray:
        """Call MuJoCo, add the time, and return the simulations in which it raised an error or dropped constraints."""
        if os.getpid() != self._process:  # MuJoCo would wait forever for threads that a fork does not copy
            raise RuntimeError(
                f"process {os.getpid()} inherited this environment by a fork from process {self._process}, without its "
                "threads: make environments in the process that steps them"
            )
        start = time.perf_counter()
        try:
            call(*args, **kwargs)
        except SimulationError as error:
            return error.ids
        finally:
            self.physics_seconds += time.perf_counter() - start
        return self._short_of_memory()

    def _short_of_memory(self) -> np.ndarray:
        """Return the simulations in which MuJoCo dropped all constraints because the arena was full.

        From MuJoCo 4 on this is a warning, before it is an error. Contacts without any constraint are its sign, which
        contacts in the gap of two geoms share. ``MjData.warning`` tells them apart, but copying it is slow.
        """
        suspects = np.flatnonzero((self._num_contacts > 0) & (self._num_constraints == 0))
        if not len(suspects):
            return _NOBODY
        dropped = []
        for index in suspects:
            self._batch.get_data(index, self._data)
            if any(self._data.warning[kind].number for kind in _ARENA_WARNINGS):
                dropped.append(index)
        return np.array(dropped, dtype=np.int64)


_ARENA_WARNINGS = (int(mujoco.mjtWarning.mjWARN_CONTACTFULL), int(mujoco.mjtWarning.mjWARN_CNSTRFULL))

_NOBODY = np.empty(0, dtype=np.int64)


def _bounded(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Whether all absolute values are below ``LARGEST``; false for NaN."""
    return (values.max(axis) < LARGEST) & (values.min(axis) > -LARGEST)


def _view(array: np.ndarray) -> Tensor:
    """An output as a tensor. The array is read-only, which torch does not support and warns about."""
    array = array.view()
    array.flags.writeable = True
    return torch.from_numpy(array)
