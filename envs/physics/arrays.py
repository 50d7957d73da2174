"""Arrays in place of tensors, for code that runs right after the physics.

On the CPU, where the physics evicts the caches, an operation takes NumPy a third of torch's time. On other
devices :data:`Array` is a tensor.
"""

from functools import cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

Array = Any
"""An ``np.ndarray`` on the CPU, a tensor on other devices."""


def as_array(tensor: Tensor) -> Array:
    """Return a view of a tensor as an array."""
    return tensor.numpy() if tensor.is_cpu else tensor


def as_tensor(array: Array) -> Tensor:
    """Return a view of an array as a tensor."""
    return torch.from_numpy(array) if isinstance(array, np.ndarray) else array


def by_component(array: Array) -> Array:
    """View vectors of each simulation, ``(n, L, C)``, with the simulations side by side, ``(L, C, n)``."""
    return array.swapaxes(0, 1).swapaxes(1, 2)


def contiguous(array: Array) -> Array:
    """Return an array whose memory is in the order of its axes."""
    return np.ascontiguousarray(array) if isinstance(array, np.ndarray) else array.contiguous()


def converted(array: Array, dtype: torch.dtype) -> Tensor:
    """Return an array as a tensor of a type, whose memory is in the order of its axes."""
    if isinstance(array, np.ndarray):
        return torch.from_numpy(array.astype(_numpy_type(dtype), "C"))
    return array.to(dtype)


@cache
def _numpy_type(dtype: torch.dtype) -> np.dtype:
    return torch.empty(0, dtype=dtype).numpy().dtype
