"""Arrays in place of tensors, for code that runs right after the physics.

On the CPU, where the physics evicts the caches, an operation takes NumPy a third of torch's time. On other
devices :data:`Array` is a tensor.
"""

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
