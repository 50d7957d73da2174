"""Transfer: the parts that a method keeps, freezes and initialises anew on a new task (Algorithm 1)."""

import hashlib
from collections.abc import Collection, Iterable

import torch
from torch import nn


class FrozenParts:
    """Parts that training must not change, with a check that it did not.

    Args:
        parts: All parts of an agent by name.
        names: Those to freeze: their parameters no longer require gradients, and normalisers among them stop updating.

    Raises:
        ValueError: If a name is not a part.
    """

    def __init__(self, parts: nn.ModuleDict, names: Collection[str]) -> None:
        require_parts(parts, names, "transfer.freeze")
        self.modules = {name: parts[name].requires_grad_(False) for name in names}
        self.fingerprints = {name: fingerprint(module) for name, module in self.modules.items()}

    def __contains__(self, name: str) -> bool:
        """Tell whether a part is frozen."""
        return name in self.modules

    def state_dict(self) -> dict[str, str]:
        """Return the fingerprints, so that a continued run is checked against those it began with."""
        return dict(self.fingerprints)

    def load_state_dict(self, state: dict[str, str]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self.fingerprints = dict(state)

    def verify(self) -> None:
        """Check that no frozen part has changed by a bit since it was frozen.

        Raises:
            RuntimeError: If one has.
        """
        for name, module in self.modules.items():
            if fingerprint(module) != self.fingerprints[name]:
                raise RuntimeError(f"the frozen part {name!r} changed during training: a bug, please report it")


def require_parts(parts: nn.ModuleDict, names: Iterable[str], argument: str) -> None:
    """Raise a ``ValueError`` if some of ``names``, given as ``argument``, are not among ``parts``."""
    if unknown := sorted(set(names) - set(parts)):
        raise ValueError(f"{argument} names {unknown}, but the parts of this method are {sorted(parts)}")


def fingerprint(module: nn.Module) -> str:
    """Return a hash of all parameters and buffers of ``module``, sensitive to every bit."""
    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data)
    return digest.hexdigest()
