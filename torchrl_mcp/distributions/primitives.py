"""The base class of all compositions, with the checks of primitives and gates."""

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor
from torch.distributions import Distribution


class GatedPrimitives(Distribution):
    """A distribution made of K Gaussian primitives, which it keeps as attributes.

    Attributes:
        loc: Primitive means, shape ``(*B, K, A)``.
        scale: Primitive standard deviations, shape ``(*B, K, A)``.
        gates: Weights as they were given, shape ``(*B, K)``.
    """

    loc: Tensor
    scale: Tensor
    gates: Tensor

    def __repr__(self) -> str:
        return f"{type(self).__name__}({shapes(self.loc, self.scale, self.gates)})"

    def cdf(self, value: Tensor) -> Tensor:
        """Raise an error, because actions have several components.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no cdf, because it is a joint distribution of several actions: estimate the "
            "probability of an event from samples"
        )

    def icdf(self, value: Tensor) -> Tensor:
        """Raise an error, because actions have several components.

        Raises:
            NotImplementedError: Always.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no icdf, because it is a joint distribution of several actions: estimate "
            "quantiles of single actions from samples"
        )

    def _expand_primitives(self, other: "GatedPrimitives") -> None:
        """Keep the primitives of a smaller batch, expanded to this one."""
        self.loc = other.loc.expand(*self.batch_shape, *other.loc.shape[-2:])
        self.scale = other.scale.expand(*self.batch_shape, *other.scale.shape[-2:])
        self.gates = other.gates.expand(*self.batch_shape, other.gates.shape[-1])


def broadcast_primitives(
    loc: Tensor, scale: Tensor | float, gates: Tensor, validate_args: bool | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Check primitives and gates, and bring them to one floating-point type and one batch shape.

    Shapes are always checked. Values are checked with ``validate_args``, which on a GPU waits for the device. By
    default, scales and gates on a CPU must not be negative, as raw outputs of a network are.

    Args:
        loc: Primitive means, shape ``(*B, K, A)``.
        scale: Primitive standard deviations, a number or shape ``(*B, K, A)``.
        gates: Weights, shape ``(*B, K)``.
        validate_args: Whether to check values; ``None`` follows torch's default.

    Returns:
        ``loc``, ``scale`` and ``gates`` in the widest of their types, ``float32`` at least.

    Raises:
        ValueError: If an argument is malformed.
    """
    for name, value in (("loc", loc), ("scale", scale), ("gates", gates)):
        if value is None:
            raise ValueError(
                f"{name} must be a tensor, but it is None. TorchRL passes None for a key that a sample lacks: let a "
                "module before the distribution write this key, or store it with the sample."
            )
    if not isinstance(scale, Tensor):
        scale = torch.as_tensor(scale, dtype=torch.promote_types(loc.dtype, torch.float32), device=loc.device)
    shape = common_shape(loc, scale, gates)
    if Distribution._validate_args if validate_args is None else validate_args:
        check_values(loc, scale, gates)
    elif validate_args is None and gates.device.type == "cpu" and not torch.compiler.is_compiling():
        check_signs(scale, gates)
    dtype = reduce(torch.promote_types, (loc.dtype, scale.dtype, gates.dtype), torch.float32)
    return loc.to(dtype).expand(shape), scale.to(dtype).expand(shape), gates.to(dtype).expand(shape[:-1])


def common_shape(loc: Tensor, scale: Tensor, gates: Tensor) -> Sequence[int]:
    """Return the shape ``(*B, K, A)`` to which primitives and gates broadcast.

    An argument may lack batch dimensions or have ones in their place, such as gates ``(*B, K)`` over primitives
    ``(K, A)``. One of the arguments must have the whole batch, however, because gates ``(B, 1, K)`` over primitives
    ``(B, K, A)`` would silently make a batch of ``(B, B)``.

    Raises:
        ValueError: If there is no such shape, with the shapes and the remedy.
    """
    given = (loc.shape, scale.shape, (*gates.shape, 1))
    remedy = "pass loc and scale of shape (*B, K, A) and gates of shape (*B, K)"
    if loc.ndim < 2 or gates.ndim < 1:
        raise ValueError(f"{shapes(loc, scale, gates)} lack a dimension for the primitives: {remedy}.")
    if loc.shape == scale.shape and loc.shape[:-1] == gates.shape:  # nothing to broadcast, in a tenth of the time
        return loc.shape
    try:
        shape = torch.broadcast_shapes(*given)
    except RuntimeError as error:
        raise ValueError(f"{shapes(loc, scale, gates)} do not broadcast: {remedy}.") from error
    if gates.shape[-1] != shape[-2]:
        raise ValueError(f"{shapes(loc, scale, gates)} must have one gate for each primitive: {remedy}.")
    if shape[:-2] not in [tuple(argument[:-2]) for argument in given]:
        raise ValueError(
            f"{shapes(loc, scale, gates)} have different batch shapes, and would make a batch of {tuple(shape[:-2])}: "
            f"{remedy}."
        )
    return shape


def check_values(loc: Tensor, scale: Tensor, gates: Tensor) -> None:
    """Check that the values of primitives and gates make a distribution.

    Raises:
        ValueError: If they do not, with the argument, its value and the remedy.
    """
    for name, value, valid, rule in (
        ("loc", loc, loc.isfinite(), "finite; look for a diverged network or an unnormalised observation"),
        ("scale", scale, scale.isfinite() & (scale > 0), "positive and finite; pass it through an exp or a softplus"),
        ("gates", gates, gates.isfinite() & (gates >= 0), "non-negative and finite; end the gate in a sigmoid"),
    ):
        if not torch._is_all_true(valid):  # as in torch.distributions: all() fails under vmap
            first = value[~valid][0].item()
            raise ValueError(f"{name} of shape {tuple(value.shape)} contains {first}, but must be {rule}.")


def check_signs(scale: Tensor, gates: Tensor) -> None:
    """Check that no scale and no gate is negative, as raw outputs of a network are.

    Raises:
        ValueError: If one is negative, with the remedy.
    """
    for name, value, remedy in (
        ("scale", scale, "If they are raw outputs of a network, pass them through an exp or a softplus."),
        ("gates", gates, "If they are logits, end the gate in a sigmoid or a softmax."),
    ):
        negative = value < 0
        if not torch._is_all_true(~negative):
            first = value[negative][0].item()
            raise ValueError(
                f"{name} of shape {tuple(value.shape)} contains {first}, but must be non-negative. {remedy}"
            )


def shapes(loc: Tensor, scale: Tensor, gates: Tensor) -> str:
    """Return the shapes of primitives and gates, for messages."""
    return f"loc {tuple(loc.shape)}, scale {tuple(scale.shape)}, gates {tuple(gates.shape)}"
