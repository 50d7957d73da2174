"""How an adapter reads what other environments observe, and which actions it gives them."""

import math
from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, OneHot, TensorSpec
from torchrl.envs import EnvBase

IMAGE = 3
"""Dimensions of an observation from which on it is taken for an image: height, width and channels."""


class Vector:
    """One vector for each environment, the concatenation of several observations.

    Args:
        name: Name of the vector in errors.
        owner: Name of the environments in errors.
        keys: Keys of the observations, in order; without any, the vector has no entries.
        spec: What the environments observe, batch size ``[N]``.

    Attributes:
        size: Number of entries.

    Raises:
        ValueError: If an observation is missing, or an image.
    """

    def __init__(self, name: str, owner: str, keys: Sequence[NestedKey], spec: Composite) -> None:
        self.name = name
        self.owner = owner
        self.keys = list(keys)
        self._num_envs = spec.shape[0]
        self.size = sum(self._size_of(key, spec) for key in self.keys)

    def __call__(self, outcome: TensorDictBase) -> Tensor:
        """Return the vectors in an output of the environments, ``(N, size)``, float32.

        Raises:
            FloatingPointError: If an entry is NaN or infinite.
        """
        if not self.keys:
            return torch.zeros(self._num_envs, 0, device=outcome.device)
        parts = [outcome[key].reshape(self._num_envs, -1).to(torch.float32) for key in self.keys]
        vectors = torch.cat(parts, -1) if len(parts) > 1 else parts[0].clone()
        require_finite(vectors, self.name, self.owner)
        return vectors

    def _size_of(self, key: NestedKey, spec: Composite) -> int:
        observed = list(spec.keys(True, True))
        images = [name for name in observed if _is_image(spec[name])]
        if key in images or (key not in observed and images == observed):
            raise ValueError(
                f"{self.name} would be an image, {images[0]} of shape {tuple(spec[images[0]].shape[1:])}: images need "
                "an encoder, which the networks lack. Wrap the environment so that it observes vectors"
            )
        if key not in observed:
            raise ValueError(
                f"{self.name} names {key}, which {self.owner} does not observe: it observes "
                f"{', '.join(map(str, observed))}. Pass {self.name}=[...] with some of them"
            )
        return math.prod(spec[key].shape[1:])


def require_finite(vectors: Tensor, name: str, owner: str) -> None:
    """Check what environments return.

    Args:
        vectors: One vector for each environment, ``(N, size)``.
        name: Name of the vectors in errors.
        owner: Name of the environments in errors.

    Raises:
        FloatingPointError: If an entry is NaN or infinite.
    """
    if not vectors.isfinite().all():
        number, entry = (~vectors.isfinite()).nonzero()[0].tolist()
        what = f"entry {entry} of the {name}" if vectors.shape[1] > 1 else f"the {name}"
        raise FloatingPointError(
            f"{what} became {vectors[number, entry]} in environment {number} of {owner}: correct the environment, or "
            "end the episode before"
        )


def _is_image(spec: TensorSpec) -> bool:
    return spec.ndim - 1 >= IMAGE or spec.dtype is torch.uint8


class Number:
    """The number of each environment's goal.

    Args:
        key: Its key, as one-hot or integer.
        spec: What the environments observe, batch size ``[N]``.

    Attributes:
        count: Number of goals.

    Raises:
        ValueError: If it is missing, or is no choice among a fixed number.
    """

    def __init__(self, key: NestedKey, spec: Composite) -> None:
        kind = spec[key] if key in spec.keys(True, True) else None
        if not isinstance(kind, (OneHot, Categorical)):
            raise ValueError(
                f"goal_number names {key}, which is no observed choice among a fixed number, such as Gymnasium's "
                f"Discrete: the environment observes {', '.join(map(str, spec.keys(True, True)))}"
            )
        self.key = key
        self.count: int = kind.space.n
        self._one_hot = isinstance(kind, OneHot)

    def __call__(self, outcome: TensorDictBase) -> Tensor:
        """Return the numbers in an output of the environments, from 0, ``(N,)``, int64."""
        value = outcome[self.key]
        if self._one_hot:
            return value.to(torch.int64).argmax(-1)
        return value.reshape(len(value)).to(torch.int64)


class Scaling:
    """Map from actions between -1 and 1 to the actions of other environments; actions beyond are clipped.

    Args:
        env: The environments.
        bounds: Lowest and highest action in place of the environments' own, or None.

    Attributes:
        centre: Action of the environments for 0, ``(A,)``.
        half: Half of the range of their actions, ``(A,)``.

    Raises:
        ValueError: If the actions are several, discrete, no vectors or without bounds.
    """

    def __init__(self, env: EnvBase, bounds: Sequence[float] | None = None) -> None:
        if len(env.action_keys) > 1:
            raise ValueError(f"the environment has several actions, {env.action_keys}: wrap it so that it has one")
        spec = env.action_spec
        self.shape = spec.shape
        low, high = _bounds(spec, bounds)
        self.centre = ((low + high) / 2).to(spec.device)
        self.half = ((high - low) / 2).to(spec.device)

    def __call__(self, action: Tensor) -> Tensor:
        """Return the environments' actions, ``(N, A)``, for actions of the policy."""
        return self.centre + self.half * action.clamp(-1.0, 1.0)


def _bounds(spec: TensorSpec, bounds: Sequence[float] | None) -> tuple[Tensor, Tensor]:
    """Return the lowest and highest actions, ``(A,)`` each."""
    if not spec.dtype.is_floating_point:
        raise ValueError(
            f"the action is discrete, {type(spec).__name__} of shape {tuple(spec.shape[1:])}: the methods compose "
            "Gaussians, for actions that are vectors of real numbers. Choose an environment with continuous actions"
        )
    if spec.ndim != 2:
        raise ValueError(f"the action has shape {tuple(spec.shape[1:])}: wrap the environment so that it is a vector")
    if bounds is not None:
        low, high = (torch.full(spec.shape[1:], float(bound), dtype=spec.dtype) for bound in bounds)
    elif isinstance(spec, Bounded):
        low, high = spec.space.low[0], spec.space.high[0]
    else:
        low, high = torch.full((2, *spec.shape[1:]), math.inf)
    if not (high - low).isfinite().all() or not (high > low).all():
        raise ValueError(
            f"the action has the bounds {low.tolist()} and {high.tolist()}, but policies act from -1 to 1, which is "
            "scaled to the bounds: pass action_bounds=[LOW,HIGH], finite and in order"
        )
    return low, high
