"""Writes primitives, gates and mixer of a policy as separate ONNX files, with weights in half precision."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.methods.actor import PRIMITIVES, STATE
from torchrl_mcp.runs.onnx_files import write_program

LARGE = 1000
"""Parameters with at least this number of weights are stored in half precision."""

NAMES = {STATE: "state", PRIMITIVES[0]: "loc", PRIMITIVES[1]: "scale"}
"""Names that the files use for nested keys."""


class Stage(nn.Module):
    """A part of a policy as a function of plain tensors, for the deterministic action.

    Args:
        module: Part of the policy.
        in_keys: Keys that the part reads: the arguments of the function.
        out_keys: Keys that the part writes: the results of the function.
    """

    def __init__(
        self, module: TensorDictModuleBase, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
    ) -> None:
        super().__init__()
        self.module = module
        self.in_keys = list(in_keys)
        self.out_keys = list(out_keys)

    def forward(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Return the results ``(N, ...)`` for arguments ``(N, ...)``."""
        inputs = TensorDict(dict(zip(self.in_keys, tensors, strict=True)), batch_size=tensors[0].shape[:1])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            outputs = self.module(inputs)
        return tuple(outputs[key] for key in self.out_keys)

    @torch.no_grad()
    def evaluate(self, state: TensorDictBase) -> None:
        """Add the results to a state that contains the arguments."""
        state.update(dict(zip(self.out_keys, self(*(state[key] for key in self.in_keys)), strict=True)))


def stages(policy: TensorDictModuleBase) -> dict[str, Stage]:
    """Return ``primitives``, ``gate`` and ``mixer`` of a policy.

    The primitives map an observation to the normalised state and to means and scales; the gate maps the normalised
    state and a goal to weights; the mixer maps means, scales and weights to the action.

    Raises:
        ValueError: If the policy has no gate over primitives.
    """
    if not isinstance(policy, TensorDictSequential) or "gates" not in policy[-1].in_keys:
        raise ValueError("the page needs a policy that composes primitives by gates: export one of method=mcp")
    primitives = policy.select_subsequence(in_keys=["observation"], out_keys=[*PRIMITIVES])
    gate = policy.select_subsequence(in_keys=[STATE, "goal"], out_keys=["gates"])
    return {
        "primitives": Stage(primitives, ["observation"], [STATE, *PRIMITIVES]),
        "gate": Stage(gate, [STATE, "goal"], ["gates"]),
        "mixer": Stage(policy[-1], [*PRIMITIVES, "gates"], ["action"]),
    }


def require_same_primitives(policies: Sequence[Mapping[str, Stage]]) -> None:
    """Check that policies have the same primitives.

    Args:
        policies: The :func:`stages` of each policy.

    Raises:
        ValueError: If the primitives or the normalisation of the state differ.
    """
    first = policies[0]["primitives"].state_dict()
    for number, policy in enumerate(policies[1:], 2):
        state = policy["primitives"].state_dict()
        if first.keys() != state.keys() or any(not torch.equal(first[key], state[key]) for key in first):
            raise ValueError(f"gate {number} has different primitives than gate 1: give gates over the same primitives")


def write_stage(stage: Stage, example: TensorDictBase, path: Path, *, half: bool = True) -> None:
    """Write a part of a policy as an ONNX file for one state at a time.

    Args:
        stage: The part.
        example: Arguments of the part by key, batch size 1.
        path: The file to write.
        half: Store large parameters in half precision; the arithmetic remains in single precision.
    """
    arguments = tuple(example[key] for key in stage.in_keys)
    with torch.no_grad():
        program = torch.export.export(stage, arguments)
    inputs = [NAMES.get(key, key) for key in stage.in_keys]
    outputs = [NAMES.get(key, key) for key in stage.out_keys]
    edit = halve if half else lambda model: None
    write_program(program, path, inputs=inputs, outputs=outputs, edit=edit)


def halve(model: Any) -> None:
    """Store the large parameters of an ONNX model in half precision, and cast them to single precision before use."""
    import onnx
    from onnx import numpy_helper

    graph = model.graph
    for parameter in list(graph.initializer):
        values = numpy_helper.to_array(parameter)
        if values.dtype != np.float32 or values.size < LARGE:
            continue
        name = f"{parameter.name}_half"
        graph.initializer.remove(parameter)
        graph.initializer.append(numpy_helper.from_array(values.astype(np.float16), name))
        graph.node.insert(0, onnx.helper.make_node("Cast", [name], [parameter.name], to=onnx.TensorProto.FLOAT))
