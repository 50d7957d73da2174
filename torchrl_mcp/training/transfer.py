"""Transfer: which parts a method keeps, freezes and re-initialises for a new task (Algorithm 1)."""

import hashlib
from collections.abc import Collection, Iterable

import torch
from torch import nn

from torchrl_mcp.modules import RunningNormaliser


class FrozenParts:
    """Parts that training must not change, which is checked bit by bit.

    Args:
        parts: All parts of an agent by name.
        names: Parts to freeze: their parameters require no gradients, and normalisers among them stop updating.

    Raises:
        ValueError: If a name is not the name of a part.
    """

    def __init__(self, parts: nn.ModuleDict, names: Collection[str]) -> None:
        require_parts(parts, names, "transfer.freeze")
        self.modules = {name: parts[name].requires_grad_(False) for name in names}
        self.fingerprints = {name: fingerprint(module) for name, module in self.modules.items()}

    def __contains__(self, name: str) -> bool:
        """Return whether a part is frozen."""
        return name in self.modules

    def state_dict(self) -> dict[str, str]:
        """Return the fingerprints, so that a resumed run is checked against the fingerprints of its beginning."""
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
                raise RuntimeError(f"the frozen part {name!r} changed during training: please report this bug")


def require_parts(parts: nn.ModuleDict, names: Iterable[str], argument: str) -> None:
    """Check that ``names`` are names of ``parts``.

    Raises:
        ValueError: If a name is not; the message calls the names ``argument``.
    """
    if unknown := sorted(set(names) - set(parts)):
        raise ValueError(f"{argument} names {unknown}, but the parts of this method are {sorted(parts)}")


def require_frozen_input(parts: nn.ModuleDict, keep: Collection[str], freeze: Collection[str]) -> None:
    """Check that frozen networks see states as in their pre-training, and that the critic is not frozen.

    The normaliser of goals is not checked, although it changes the outputs of a frozen network that reads the goal.

    Args:
        parts: All parts of an agent by name.
        keep: Parts that come from pre-training.
        freeze: Parts that do not change.

    Raises:
        ValueError: If the normaliser of states is not frozen although networks are, if it is not kept although frozen
            networks are, or if the critic is frozen.
    """
    if "critic" in freeze:
        raise ValueError("transfer.freeze names the critic, which learns in every stage: leave it out")
    normaliser = "observation_normaliser"
    networks = [name for name in freeze if not name.endswith("_normaliser")]
    if not networks or normaliser not in parts:
        return
    if normaliser not in freeze:
        raise ValueError(
            f"transfer.freeze names {networks}, whose outputs change with the {normaliser}: add {normaliser} to "
            "transfer.freeze"
        )
    if normaliser not in keep and not set(networks).isdisjoint(keep):
        raise ValueError(
            f"transfer.keep names parts that need the {normaliser} of their pre-training: add {normaliser} to "
            "transfer.keep"
        )


@torch.no_grad()
def widen_goal(wide: nn.Module, narrow: nn.Module, entry: slice) -> None:
    """Copy the weights of a network into one whose goal contains the first network's goal as an entry.

    At first, the wide network ignores the other entries of its goal: their weights are zero, and its normalisers have
    no samples of these features.

    Args:
        wide: New network, whose last inputs are its goal, ``G``. From now on, its normalisers count samples per
            feature.
        narrow: Network with the same layers, whose goal has the size of ``entry``. Its normalisers also change to
            counting per feature.
        entry: Place of the narrow network's goal in the goal of the wide network.
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
