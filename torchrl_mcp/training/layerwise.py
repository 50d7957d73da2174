"""Adam with smaller steps in layers with many inputs, whose units would otherwise die.

:class:`~torchrl_mcp.evaluation.diagnostics.DeadUnits` counts such units.
"""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

from torchrl_mcp.values import Positive, PositiveOrInfinite


def layerwise_adam(
    parameters: Iterable[Tensor], *, lr: Positive, inputs: PositiveOrInfinite, fused: bool, **kwargs: Any
) -> torch.optim.Adam:
    r"""Return Adam whose step size for the weights of a layer with :math:`n` inputs is :math:`\alpha \min(1, m / n)`.

    Adam moves every weight by about the step size, however small the gradient. The inputs of a layer after rectifiers
    are not negative. One step can therefore move the sum of a unit by the step size times the sum of all inputs. Early
    in training the steps of many minibatches agree: a few of them can make the unit zero for all samples, which means
    that it is dead.

    Args:
        parameters: Parameters of linear layers: weights ``(outputs, n)`` and biases ``(outputs,)``.
        lr: Step size :math:`\alpha` of biases and of layers with at most ``inputs`` inputs.
        inputs: Number of inputs :math:`m` above which steps are smaller; infinity for equal steps.
        fused: Whether to update all parameters in one kernel.
        **kwargs: Other arguments of :class:`torch.optim.Adam`.

    Reference:
        Yang et al., *Tensor Programs V*, 2022, Table 3: hidden layers need steps of Adam in proportion to
        :math:`1 / n`. https://arxiv.org/abs/2203.03466
    """
    groups: dict[float, list[Tensor]] = {}
    for parameter in parameters:
        share = min(1.0, inputs / parameter.shape[1]) if parameter.ndim > 1 else 1.0
        groups.setdefault(lr * share, []).append(parameter)
    return torch.optim.Adam([{"params": group, "lr": size} for size, group in groups.items()], fused=fused, **kwargs)
