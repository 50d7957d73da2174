"""Transfer: the parts that a method keeps, freezes and re-initialises for a new task (Algorithm 1)."""

import hashlib
from collections.abc import Collection, Iterable

import torch
from torch import nn

from torchrl_mcp.modules import RunningNormaliser


class FrozenParts:
    """Parts that training must not change, with a check of their bits.

    Args:
        parts: All parts of an agent by name.
        names: Parts to freeze: their parameters require no gradients, and normalisers among them stop updating.

    Raises:
        ValueError: If a name is not a part.
    """

    def __init__(self, parts: nn.ModuleDict, names: Collection[str]) -> None:
        require_parts(parts, names, "transfer.freeze")
        self.modules = {name: parts[name].requires_grad_(False) for name in names}
        self.fingerprints = {name: fingerprint(module) for name, module in self.modules.items()}

    def __contains__(self, name: str) -> bool:
        """Return whether a part is frozen."""
        return name in self.modules

    def state_dict(self) -> dict[str, str]:
        """Return the fingerprints, so that a resumed run is checked against its first ones."""
        return dict(self.fingerprints)

    def load_state_dict(self, state: dict[str, str]) -> None:
        """Restore the result of :meth:`state_dict`."""
        self.fingerprints = dict(state)

    def verify(self) -> None:
        """Check that no bit of a frozen part has changed.

        Raises:
            RuntimeError: If a part has changed.
        """
        for name, module in self.modules.items():
            if fingerprint(module) != self.fingerprints[name]:
                raise RuntimeError(f"the frozen part {name!r} changed during training: a bug, please report it")


def require_parts(parts: nn.ModuleDict, names: Iterable[str], argument: str) -> None:
    """Raise a ``ValueError`` if some of ``names``, given as ``argument``, are not among ``parts``."""
    if unknown := sorted(set(names) - set(parts)):
        raise ValueError(f"{argument} names {unknown}, but the parts of this method are {sorted(parts)}")


def require_frozen_input(parts: nn.ModuleDict, keep: Collection[str], freeze: Collection[str]) -> None:
    """Check that frozen networks see the inputs of their pre-training, and that the critic is not frozen.

    Args:
        parts: All parts of an agent by name.
        keep: Parts that come from pre-training.
        freeze: Parts that do not change.

    Raises:
        ValueError: If the normaliser of their inputs may change, is not kept with them, or the critic is frozen.
    """
    if "critic" in freeze:
        raise ValueError("transfer.freeze names the critic, which learns in every stage: leave it out")
    normaliser = "observation_normaliser"
    networks = [name for name in freeze if not name.endswith("_normaliser")]
    if not networks or normaliser not in parts:
        return
    if normaliser not in freeze:
        raise ValueError(
            f"transfer.freeze names {networks}, whose outputs change with {normaliser}: add it to transfer.freeze"
        )
    if normaliser not in keep and not set(networks).isdisjoint(keep):
        raise ValueError(f"transfer.keep names parts that need the {normaliser} of their pre-training: add it as well")


@torch.no_grad()
def widen_goal(wide: nn.Module, narrow: nn.Module, entry: slice) -> None:
    """Copy a network that saw a goal into one that sees it as an entry of its own goal.

    At first, the wide network ignores the other entries: their weights are zero, and normalisers have no samples of
    them.

    Args:
        wide: New network whose last inputs are the goal, ``G``.
        narrow: The same for the goal of the entry's size, whose weights are copied. Its normalisers count the samples
            of each feature by itself from then on.
        entry: The entry.
    """
    for module in (*wide.modules(), *narrow.modules()):
        if isinstance(module, RunningNormaliser):
            module.count_each()
    for name, tensor in wide.state_dict().items():
        source = narrow.state_dict()[name]
        if tensor.shape == source.shape:
            tensor.copy_(source)
            continue
        before = source.shape[-1] - (entry.stop - entry.start)
        if tensor.ndim > 1:
            tensor.zero_()
        tensor[..., :before] = source[..., :before]
        tensor[..., before + entry.start : before + entry.stop] = source[..., before:]


def fingerprint(module: nn.Module) -> str:
    """Return a hash of all parameters and buffers of ``module``, sensitive to every bit."""
    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    return digest.hexdigest()
