"""Dead units: hidden units that no sample of a batch activates, so that they get no gradient."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

MIN_SAMPLES = 64
"""Least number of samples from which units are judged. An option that rarely acts may see fewer."""


class DeadUnits:
    """Detects dead units in the hidden layers of networks: units that are zero for all samples of an evaluation.

    Args:
        networks: Networks by name, whose hidden layers end in :class:`torch.nn.ReLU`.
    """

    def __init__(self, networks: nn.ModuleDict) -> None:
        self.layers = {name: layer for name, layer in networks.named_modules() if isinstance(layer, nn.ReLU)}

    @torch.no_grad()
    def __call__(self, evaluate: Callable[[], Any]) -> dict[str, float]:
        """Return the share of dead units in the worst hidden layer of each network that ``evaluate`` runs.

        Args:
            evaluate: Evaluates networks on samples of one batch dimension.

        Returns:
            Shares as ``dead_units/<network>``, 0 if all layers saw fewer than :data:`MIN_SAMPLES`.
        """
        shares: dict[str, Tensor] = {}
        with ExitStack() as hooks:
            for name, layer in self.layers.items():
                handle = layer.register_forward_hook(partial(_record, shares, name))
                hooks.callback(handle.remove)
            evaluate()
        if not shares:
            return {}
        worst: dict[str, float] = {}
        for name, share in zip(shares, torch.stack([*shares.values()]).tolist(), strict=True):
            key = f"dead_units/{name.partition('.')[0]}"
            worst[key] = max(worst.get(key, 0.0), share)
        return worst


def _record(shares: dict[str, Tensor], name: str, layer: nn.Module, inputs: tuple[Tensor], output: Tensor) -> None:
    """Store under ``name`` the share of the units of ``output``, ``(B, ...)``, that are zero in all B samples."""
    judged = len(output) >= MIN_SAMPLES
    shares[name] = (output <= 0).all(0).float().mean() if judged else output.new_zeros((), dtype=torch.float32)
