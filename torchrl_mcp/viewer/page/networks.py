"""Primitives, gates and mixer of a policy as ONNX files of their own, with weights in half precision."""

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
"""Number of weights from which a parameter is stored in half precision."""

NAMES = {STATE: "state", PRIMITIVES[0]: "loc", PRIMITIVES[1]: "scale"}
"""Names in the files of keys that are no names themselves."""


class Stage(nn.Module):
    """A part of a policy as a function of plain tensors, for its deterministic action.

    Args:
        module: Part of the policy.
        in_keys: Keys that it reads, the arguments of the function.
        out_keys: Keys that it writes, its results.
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
        """Add the results to a state that has the arguments."""
        state.update(dict(zip(self.out_keys, self(*(state[key] for key in self.in_keys)), strict=True)))


def stages(policy: TensorDictModuleBase) -> dict[str, Stage]:
    """Return ``primitives``, ``gate`` and ``mixer`` of a policy.

    The primitives map an observation to the normalised state and to means and scales; the gate maps the normalised
    state and a goal to weights; the mixer maps means, scales and weights to the action.

    Raises:
        ValueError: If the policy has no gate over primitives.
    """
    if not isinstance(policy, TensorDictSequential) or "gates" not in policy[-1].in_keys:
        raise ValueError("the policy composes no primitives by gates, which the page shows: export one of method=mcp")
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
        policies: The :func:`stages` of each.

    Raises:
        ValueError: If the primitives or the normalisation of the state differ.
    """
    first, *others = (policy["primitives"].state_dict() for policy in policies)
    for number, other in enumerate(others, 2):
        if first.keys() != other.keys() or any(not torch.equal(first[key], other[key]) for key in first):
            raise ValueError(f"gate {number} has other primitives than gate 1: give gates over the same primitives")


def write_stage(stage: Stage, example: TensorDictBase, path: Path, *, half: bool = True) -> None:
    """Write a part of a policy as ONNX, for one state at a time.

    Args:
        stage: The part.
        example: Its arguments by key, batch size 1.
        path: The file to write.
        half: Store large parameters in half precision; the arithmetic remains in single precision.
    """
    inputs = tuple(example[key] for key in stage.in_keys)
    with torch.no_grad():
        program = torch.export.export(stage, inputs)
    names = [[NAMES.get(key, key) for key in keys] for keys in (stage.in_keys, stage.out_keys)]
    edit = halve if half else lambda model: None
    write_program(program, path, inputs=names[0], outputs=names[1], edit=edit)


def halve(model: Any) -> None:
    """Store the large parameters of an ONNX model in half precision, and cast them back where they are used."""
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
