"""Arrays in place of tensors, for what runs right after the physics.

On the CPU, where the physics leaves nothing in the cache, an operation of NumPy takes a third of one of torch. On
other devices tensors are their own arrays.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

Array = Any
"""An ``np.ndarray`` in place of a tensor on the CPU, or else a tensor."""


def as_array(tensor: Tensor) -> Array:
    """Return a view of a tensor."""
    return tensor.numpy() if tensor.is_cpu else tensor


def as_tensor(array: Array) -> Tensor:
    """Return a view of an array."""
    return torch.from_numpy(array) if isinstance(array, np.ndarray) else array
