"""Writes exported programs as ONNX files."""

import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.export import ExportedProgram

from torchrl_mcp.training.run_folder import replacing


def require_onnx(path: Path) -> None:
    """Check that the packages which write ONNX are installed.

    Raises:
        ValueError: If onnx or onnxscript is not installed.
    """
    try:
        import onnx  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ValueError(f"{path} needs onnx and onnxscript: pip install 'torchrl-mcp[onnx]'") from error


def write_program(
    program: ExportedProgram, path: Path, *, inputs: Sequence[str], outputs: Sequence[str], edit: Callable[[Any], None]
) -> None:
    """Write a program as ONNX.

    Args:
        program: The program.
        path: The file to write.
        inputs: Names of the program's arguments.
        outputs: Names of the program's results.
        edit: Function that changes the ONNX model in place before it is saved.
    """
    import onnx

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # otherwise warns of packages that are not needed
    with replacing(path) as partial, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's exporter calls deprecated functions of torch
        torch.onnx.export(
            program,
            f=partial,
            input_names=list(inputs),
            output_names=list(outputs),
            external_data=False,
            verbose=False,
        )
        model = onnx.load(partial)
        edit(model)
        onnx.save(model, partial)
