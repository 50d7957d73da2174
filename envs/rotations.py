"""Rotations as functions of tensors, batched over leading dimensions: unit quaternions ``(w, x, y, z)``, and angles."""

import torch
from torch import Tensor
from torch.nn.functional import normalize


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Compose two rotations, first ``b``, then ``a``.

    Args:
        a: Quaternions, shape ``(*B, 4)``.
        b: Quaternions, shape ``(*B, 4)``.
    """
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    ).movedim(0, -1)  # stored by component, for speed


def inverse(q: Tensor) -> Tensor:
    """Return the opposite rotation, shape ``(*B, 4)``."""
    return torch.cat([q[..., :1], -q[..., 1:]], dim=-1)


def rotate(q: Tensor, v: Tensor) -> Tensor:
    r"""Rotate vectors, :math:`v + 2 w (u \times v) + 2 u \times (u \times v)` with :math:`q = (w, u)`.

    Args:
        q: Quaternions, shape ``(*B, 4)``.
        v: Vectors, shape ``(*B, 3)``.
    """
    w, (u, v) = q[..., :1], torch.broadcast_tensors(q[..., 1:], v)
    cross = 2 * torch.linalg.cross(u, v)
    return v + w * cross + torch.linalg.cross(u, cross)


def from_rotation_vector(v: Tensor) -> Tensor:
    r"""Exponential map, :math:`(\cos \frac{|v|}{2}, \frac{v}{|v|} \sin \frac{|v|}{2})`.

    Args:
        v: Axis times angle, shape ``(*B, 3)``, in radians.
    """
    angle = torch.linalg.vector_norm(v, dim=-1, keepdim=True)
    return torch.cat([(angle / 2).cos(), v / 2 * torch.sinc(angle / (2 * torch.pi))], dim=-1)


def to_rotation_vector(q: Tensor) -> Tensor:
    """Logarithm: axis times angle, shape ``(*B, 3)``, with an angle of at most pi."""
    q = torch.where(q[..., :1] < 0, -q, q)
    w, u = q[..., :1], q[..., 1:]
    sine = torch.linalg.vector_norm(u, dim=-1, keepdim=True).clamp_min(torch.finfo(q.dtype).tiny)
    return u * (2 * torch.atan2(sine, w) / sine)


def about_x(angle: Tensor) -> Tensor:
    """Rotation about x, shape ``(*B, 4)``, by an angle of shape ``(*B)``."""
    zero = torch.zeros_like(angle)
    return torch.stack([(angle / 2).cos(), (angle / 2).sin(), zero, zero], dim=-1)


def about_y(angle: Tensor) -> Tensor:
    """Rotation about y, shape ``(*B, 4)``, by an angle of shape ``(*B)``."""
    zero = torch.zeros_like(angle)
    return torch.stack([(angle / 2).cos(), zero, (angle / 2).sin(), zero], dim=-1)


def about_z(angle: Tensor) -> Tensor:
    """Rotation about the vertical, shape ``(*B, 4)``, by an angle of shape ``(*B)``."""
    zero = torch.zeros_like(angle)
    return torch.stack([(angle / 2).cos(), zero, zero, (angle / 2).sin()], dim=-1)


def heading(q: Tensor) -> Tensor:
    """Horizontal angle of a body's x axis from the world's x axis, shape ``(*B)``, in (-pi, pi]."""
    w, x, y, z = q.unbind(-1)
    return torch.atan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def shortest(a: Tensor, b: Tensor) -> Tensor:
    """Shortest rotation from one direction to another, shape ``(*B, 4)``; a half turn if they are opposite.

    Args:
        a: Unit vectors, shape ``(*B, 3)``.
        b: Unit vectors, shape ``(*B, 3)``.
    """
    turn = torch.cat([1 + (a * b).sum(-1, keepdim=True), torch.linalg.cross(a, b)], dim=-1)
    x, y = torch.eye(3, dtype=a.dtype, device=a.device)[:2]
    across = torch.linalg.cross(a, torch.where(a[..., :1].abs() < 0.9, x, y))
    half_turn = torch.cat([torch.zeros_like(across[..., :1]), across], dim=-1)
    return normalize(torch.where(turn.norm(dim=-1, keepdim=True) < 1e-9, half_turn, turn), dim=-1)


def slerp(a: Tensor, b: Tensor, fraction: Tensor) -> Tensor:
    r"""Interpolate at constant angular velocity along the shorter arc.

    .. math:: \frac{\sin (1 - t) \theta}{\sin \theta} a + \frac{\sin t \theta}{\sin \theta} b,
        \quad \cos \theta = a \cdot b

    Args:
        a: Quaternions at :math:`t = 0`, shape ``(*B, 4)``.
        b: Quaternions at :math:`t = 1`, shape ``(*B, 4)``.
        fraction: :math:`t`, shape ``(*B)``.
    """
    b = torch.where((a * b).sum(-1, keepdim=True) < 0, -b, b)
    difference = torch.linalg.vector_norm(a - b, dim=-1)
    total = torch.linalg.vector_norm(a + b, dim=-1)
    angle = 2 * torch.atan2(difference, total) / torch.pi  # accurate if a and b are close, unlike acos
    whole = torch.sinc(angle)
    before = (1 - fraction) * torch.sinc((1 - fraction) * angle) / whole
    after = fraction * torch.sinc(fraction * angle) / whole
    return before.unsqueeze(-1) * a + after.unsqueeze(-1) * b


def continuous(q: Tensor) -> Tensor:
    """Choose the signs of a sequence of quaternions: w >= 0 in the first, and each next one close to its predecessor.

    Args:
        q: Quaternions over time, shape ``(*B, T, 4)``.
    """
    first = torch.where(q[..., :1, 0] < 0, -1.0, 1.0).to(q.dtype)
    turns = torch.where((q[..., 1:, :] * q[..., :-1, :]).sum(-1) < 0, -1.0, 1.0).to(q.dtype)
    return q * torch.cat([first, turns], dim=-1).cumprod(-1).unsqueeze(-1)


def unit_vector(angle: Tensor) -> Tensor:
    """Return (cos, sin) of angles in radians, ``(*B, 2)``."""
    return torch.stack([angle.cos(), angle.sin()], dim=-1)
