"""Gate and option diagnostics, for training and evaluation."""

import torch
from tensordict import TensorDictBase

from torchrl_mcp.methods.actor import Actor
from torchrl_mcp.methods.options import option_diagnostics
from torchrl_mcp.modules import gate_diagnostics

DIAGNOSED = ("gates", "option", "begins")

COLLAPSED = 1.1
"""Effective number of options at or below which they count as collapsed into one."""


def diagnosed(actor: Actor) -> list[str]:
    """Return the keys of an actor's output that :func:`diagnostics` reads."""
    return [key for key in DIAGNOSED if key in actor.stored]


def diagnostics(actor: Actor, samples: TensorDictBase) -> dict[str, float]:
    """Summarise the gates and options of an actor over samples.

    Args:
        actor: The actor.
        samples: Samples of the actor, of any batch shape, with the keys ``actor.stored``.

    Returns:
        Numbers of :func:`~torchrl_mcp.modules.gate_diagnostics` under ``gates/``, if there are gates, and of
        :func:`~torchrl_mcp.methods.options.option_diagnostics` under ``options/``, if options are chosen.
    """
    groups = {}
    if "gates" in actor.stored:
        groups["gates"] = gate_diagnostics(samples["gates"])
    if actor.num_options and "begins" in actor.stored:
        groups["options"] = option_diagnostics(samples["option"], samples["begins"], actor.num_options)
    named = {f"{group}/{name}": value for group, values in groups.items() for name, value in values.items()}
    if not named:
        return {}
    return dict(zip(named, torch.stack(list(named.values())).tolist(), strict=True))  # one transfer from a GPU
