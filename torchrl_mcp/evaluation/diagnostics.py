"""Computes diagnostics of networks, gates and options for training and evaluation."""

from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from torchrl_mcp.methods.actor import Actor
from torchrl_mcp.methods.options import option_diagnostics
from torchrl_mcp.modules import gate_diagnostics

DIAGNOSED = ("gates", "option", "begins")
"""Keys of samples that diagnostics may read."""

COLLAPSED = 1.1
"""Options count as collapsed into one if their effective number is below this."""

MIN_SAMPLES = 64
"""Least number of samples from which units are judged. An option that rarely acts may see fewer."""


def diagnosed(actor: Actor) -> list[str]:
    """Return the keys of an actor's output that :func:`diagnostics` reads."""
    return [key for key in DIAGNOSED if key in actor.stored]


def diagnostics(actor: Actor, samples: TensorDictBase) -> dict[str, float]:
    """Summarise the gates and options of an actor over samples.

    Args:
        actor: The actor.
        samples: Samples of the actor, of any batch shape, with the keys ``actor.stored``.

    Returns:
        Numbers of :func:`~torchrl_mcp.modules.gate_diagnostics` with the prefix ``gates/`` if the actor has gates, and
        of :func:`~torchrl_mcp.methods.options.option_diagnostics` with the prefix ``options/`` if it chooses options.
    """
    groups = {}
    if "gates" in actor.stored:
        groups["gates"] = gate_diagnostics(samples["gates"])
    if actor.num_options and "begins" in actor.stored:
        groups["options"] = option_diagnostics(samples["option"], samples["begins"], actor.num_options)
    numbers = {f"{group}/{name}": value for group, values in groups.items() for name, value in values.items()}
    if not numbers:
        return {}
    return dict(zip(numbers, torch.stack(list(numbers.values())).tolist(), strict=True))  # one transfer from a GPU


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
