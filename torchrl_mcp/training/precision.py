"""Chooses the precision of networks, bfloat16 or float32, by which is faster on the machine.

``autocast=auto`` chooses when a run begins, and the run keeps the choice. The choice depends on the device:

=================================================  ==================================================
device                                             choice
=================================================  ==================================================
x86 processor with AMX tiles of bfloat16           bfloat16
x86 processor with neither AMX nor AVX512-BF16     float32: oneDNN would emulate bfloat16
CUDA or ROCm device                                bfloat16 from compute capability 8 (Ampere) on
any other                                          the faster one for a timed matrix product
=================================================  ==================================================

The last row includes x86 processors that have AVX512-BF16 but no AMX, some of which compute bfloat16 at twice the rate
of float32 and others at half the rate. It also includes Arm processors, where the speed depends on the build of torch.
"""

import time
import warnings
from dataclasses import dataclass

import torch

from torchrl_mcp.training.threads import threads

ADVANTAGE = 0.8
"""Bfloat16 is chosen if a product takes at most this share of the time in float32."""

SHAPE = (256, 1024, 1024)
"""Rows, inputs and outputs of the timed product: a small batch in a wide layer."""
REPEATS = 10


@dataclass(frozen=True)
class Precision:
    """The precision of a run's networks.

    Attributes:
        autocast: Whether matrix products are in bfloat16.
        reason: Short reason for the choice.
    """

    autocast: bool
    reason: str

    def __str__(self) -> str:
        """Return the precision and the reason, for logs."""
        return f"networks in {name(self.autocast)}: {self.reason}"


def name(autocast: bool) -> str:
    """Return the name of the precision."""
    return "bfloat16" if autocast else "float32"


def choose(autocast: bool | str, device: torch.device | str) -> Precision:
    """Return the precision of networks on a device, and warn if ``autocast=True`` is slower than float32.

    Args:
        autocast: True for bfloat16, False for float32, or ``auto`` for the faster.
        device: Device of the networks.

    Raises:
        ValueError: If ``autocast`` is neither a Boolean nor ``auto``.
    """
    if autocast != "auto" and not isinstance(autocast, bool):
        raise ValueError(f"autocast={autocast!r} must be auto, true or false")
    if autocast is False:
        return Precision(False, "autocast=false")
    native = is_native(device)
    if autocast is True:
        if not native and (ratio := relative_time(device)) > 1:
            warnings.warn(
                f"autocast=true: on this {_kind(device)} a matrix product takes {ratio:.1f} times as long in bfloat16 "
                "as in float32; autocast=auto would choose the faster",
                stacklevel=2,
            )
        return Precision(True, "autocast=true")
    if native is not None:
        return Precision(native, f"this {_kind(device)} has {'' if native else 'no '}instructions for bfloat16")
    ratio = relative_time(device)
    return Precision(ratio <= ADVANTAGE, f"bfloat16 takes {ratio:.2f} times as long on this {_kind(device)}")


def is_native(device: torch.device | str) -> bool | None:
    """Return whether a device multiplies bfloat16 matrices faster than float32 matrices, None if torch cannot tell."""
    kind = torch.device(device).type
    if kind == "cuda":
        with torch.cuda.device(device):
            return torch.cuda.is_bf16_supported(including_emulation=False)
    if kind != "cpu":
        return None
    features = torch.cpu.get_capabilities()
    if not features["architecture"].startswith("x86"):
        return None
    if features["amx_bf16"]:
        return True
    return None if features["avx512_bf16"] else False


def relative_time(device: torch.device | str) -> float:
    """Return the time of a matrix product in bfloat16, as a multiple of the time in float32; a CPU uses one thread."""
    rows, inputs, outputs = SHAPE
    operands = torch.ones(rows, inputs, device=device), torch.ones(outputs, inputs, device=device)
    products = [[x.to(dtype) for x in operands] for dtype in (torch.bfloat16, torch.float32)]
    with threads(1):  # another run may use the other cores
        times = [[_seconds(*product) for product in products] for _ in range(1 + REPEATS)]  # the first prepares kernels
    bfloat16_times, float32_times = zip(*times[1:], strict=True)
    return min(bfloat16_times) / min(float32_times)


def _seconds(rows: torch.Tensor, weight: torch.Tensor) -> float:
    """Return the time of ``rows @ weight.T`` in seconds."""
    # A thread's own time does not depend on other processes.
    clock = time.thread_time if rows.device.type == "cpu" else time.perf_counter
    _wait(rows.device)
    start = clock()
    torch.nn.functional.linear(rows, weight)
    _wait(rows.device)
    return clock() - start


def _wait(device: torch.device) -> None:
    """Wait until an accelerator has finished its work."""
    if device.type != "cpu":
        torch.accelerator.synchronize(device)


def _kind(device: torch.device | str) -> str:
    return "processor" if torch.device(device).type == "cpu" else "device"
