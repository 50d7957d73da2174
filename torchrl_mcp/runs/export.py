"""Exports deterministic policies to other programs, by ONNX and ``torch.export``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram
from torchrl.envs import ExplorationType, set_exploration_type

from torchrl_mcp.methods.transforms import TransformedCharacterEnv
from torchrl_mcp.runs import policies
from torchrl_mcp.runs.interface import interface
from torchrl_mcp.runs.onnx_files import require_onnx, write_program
from torchrl_mcp.training.run_folder import replacing

INPUTS = ("observation", "goal")


class DeterministicPolicy(nn.Module):
    """A policy, including its input normalisers, as a function of plain tensors that returns the deterministic action.

    Args:
        policy: From the keys ``observation`` and ``goal`` to ``action``.

    Raises:
        ValueError: If the policy reads other keys, such as the option that an environment stores.
    """

    def __init__(self, policy: TensorDictModuleBase) -> None:
        super().__init__()
        if stored := [str(key) for key in policy.in_keys if key not in INPUTS]:
            raise ValueError(
                f"the policy also reads {', '.join(stored)}, which an environment stores between steps: export a "
                f"policy that reads only {' and '.join(INPUTS)}"
            )
        self.policy = policy

    def forward(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Return the action ``(N, A)`` for observations ``(N, S)`` and goals ``(N, G)``."""
        state = TensorDict({"observation": observation, "goal": goal}, batch_size=observation.shape[:-1])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return self.policy(state)["action"]


def example(path: Path | str, *, num: int = 8) -> tuple[DeterministicPolicy, tuple[Tensor, Tensor], dict[str, str]]:
    """Return the policy of a run, example observations ``(num, S)`` and goals ``(num, G)``, and the policy's interface.

    Args:
        path: Run folder, for its newest checkpoint, or checkpoint file.
        num: Number of states.

    Raises:
        ValueError: If there is no checkpoint, the checkpoint is damaged, or the policy reads other keys than
            observation and goal.
    """
    _, agent, env = policies.restore(path, num_envs=num, seed=0)
    state = env.reset()
    policy = DeterministicPolicy(agent.actor.policy).eval()
    return (
        policy,
        (state["observation"], state["goal"]),
        interface(env.base_env if isinstance(env, TransformedCharacterEnv) else env),
    )


def export(policy: DeterministicPolicy, states: tuple[Tensor, Tensor]) -> ExportedProgram:
    """Return a policy as a program of tensor operations, for any batch size.

    Args:
        policy: The policy.
        states: Observations and goals for tracing, at least two of each.
    """
    batch = Dim("batch")
    with torch.no_grad():
        return torch.export.export(policy, states, dynamic_shapes=({0: batch}, {0: batch}))


def write_torch(policy: DeterministicPolicy, states: tuple[Tensor, Tensor], path: Path | str) -> None:
    """Write a policy for ``torch.export.load``, which needs only torch."""
    with replacing(Path(path)) as partial, partial.open("wb") as file:  # torch would warn of the suffix of a path
        torch.export.save(export(policy, states), file)


def write_onnx(
    policy: DeterministicPolicy, states: tuple[Tensor, Tensor], path: Path | str, metadata: Mapping[str, str]
) -> float | None:
    """Write a policy as ONNX, and compare its actions with torch's if onnxruntime is installed.

    The inputs are ``observation`` and ``goal``, the output is ``action``; the first dimension of each is called
    ``batch``.

    Args:
        policy: The policy.
        states: Observations and goals for tracing, at least two of each.
        path: The file to write.
        metadata: Metadata of the file, see :func:`~torchrl_mcp.runs.interface.interface`.

    Returns:
        The largest difference from torch's actions in ``states``, or None without onnxruntime.

    Raises:
        ValueError: If onnx or onnxscript is not installed.
    """

    def edit(model: Any) -> None:
        import onnx

        _name_batch(model.graph)
        onnx.helper.set_model_props(model, dict(metadata))

    path = Path(path)
    require_onnx(path)
    write_program(export(policy, states), path, inputs=INPUTS, outputs=("action",), edit=edit)
    return onnx_difference(policy, states, path)


def _name_batch(graph: Any) -> None:
    """Rename the first dimension of a graph's inputs to ``batch`` in the whole graph."""
    traced = graph.input[0].type.tensor_type.shape.dim[0].dim_param
    for value in (*graph.input, *graph.output, *graph.value_info):
        for dim in value.type.tensor_type.shape.dim:
            if dim.dim_param == traced:
                dim.dim_param = "batch"


def onnx_difference(policy: DeterministicPolicy, states: tuple[Tensor, Tensor], path: Path) -> float | None:
    """Return the largest difference between the actions of torch and of onnxruntime, or None without onnxruntime."""
    try:
        import onnxruntime
    except ImportError:
        return None
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    feed = dict(zip(INPUTS, (state.numpy() for state in states), strict=True))
    (actions,) = session.run(["action"], feed)
    with torch.no_grad():
        return float((policy(*states) - torch.from_numpy(actions)).abs().max())
