"""ONNX files of exported programs."""

import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from torch.export import ExportedProgram

from torchrl_mcp.training.run_folder import replacing


def require_onnx(path: Path) -> None:
    """Check that ONNX can be written.

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
        inputs: Names of its arguments.
        outputs: Names of its results.
        edit: Called with the ONNX model before it is saved, to change it in place.
    """
    import onnx

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # it warns of operators of packages that are not needed
    with replacing(path) as partial, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's exporter warns about itself
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
