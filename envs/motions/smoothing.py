"""Smoothing of motions over time."""

import torch
from torch import Tensor
from torch.nn.functional import conv1d, pad


def smoothed(values: Tensor, fps: float, window: float) -> Tensor:
    """Average over time, the last dimension, with a Hann window of ``window`` seconds; the ends are held."""
    half = max(1, min(round(window * fps / 2), values.shape[-1] - 1))
    weights = torch.hann_window(2 * half + 1, periodic=False, dtype=values.dtype)
    padded = pad(values.reshape(-1, 1, values.shape[-1]), (half, half), mode="replicate")
    return conv1d(padded, (weights / weights.sum()).view(1, 1, -1)).view_as(values)
