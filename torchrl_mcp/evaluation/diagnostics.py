"""Computes diagnostics of gates and options for training and evaluation."""

import torch
from tensordict import TensorDictBase

from torchrl_mcp.methods.actor import Actor
from torchrl_mcp.methods.options import option_diagnostics
from torchrl_mcp.modules import gate_diagnostics

DIAGNOSED = ("gates", "option", "begins")
"""Keys of samples that diagnostics may read."""

COLLAPSED = 1.1
"""Options count as collapsed into one if their effective number is at most this."""


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
