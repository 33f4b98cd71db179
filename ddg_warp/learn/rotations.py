"""Rotation vectors and unit quaternions as tensors, with gradients everywhere."""

import torch

SMALL = 1e-6  # rad; below, series are exact to rounding


def quaternion(vectors: torch.Tensor) -> torch.Tensor:
    """Of rotation vectors (..., 3) [rad]: sin(|r| / 2) r / |r| and, last, cos(|r| / 2) (..., 4)."""
    square, small, length = _length(vectors)
    scalar = torch.where(small, 1.0 - square / 8.0, torch.cos(0.5 * length))
    return torch.cat([vectors * torch.where(small, 0.5 - square / 48.0, torch.sin(0.5 * length) / length), scalar], -1)


def turned(vectors: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Rotation vectors (..., 3) [rad] after rotations `by` others, about axes in space; of the result's two the shorter one.

    The product of unit quaternions (v, s) and (w, t) is (s w + t v + v x w, s t - v . w).
    """
    (v, s), (w, t) = (quaternion(own).split([3, 1], -1) for own in (by, vectors))
    scalar = s * t - (v * w).sum(-1, keepdim=True)
    vector = s * w + t * v + torch.linalg.cross(v, w)
    sign = torch.where(scalar < 0.0, -1.0, 1.0)
    scalar, vector = sign * scalar, sign * vector
    _, small, length = _length(vector)
    return vector * torch.where(small, 2.0 / scalar, 2.0 * torch.atan2(length, scalar) / length)


def partway(start: torch.Tensor, end: torch.Tensor, share: float) -> torch.Tensor:
    """Rotation vectors (..., 3) [rad] after a share of the shorter way from some to others."""
    return turned(start, share * turned(-start, end))


def halfway(start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """The quaternion halfway on the shorter way from one to another."""
    near = torch.where((start * end).sum(-1, keepdim=True) < 0.0, -end, end)
    return torch.nn.functional.normalize(start + near, dim=-1)


def matrix(quaternions: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (..., 3, 3)."""
    x, y, z, w = quaternions.unbind(-1)
    rows = [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)]
    rows += [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)]
    rows += [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(*x.shape, 3, 3)


def _length(vectors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Squares of lengths (..., 1), where they are small, and elsewhere the lengths, which have a derivative there."""
    square = (vectors * vectors).sum(-1, keepdim=True)
    small = square < SMALL**2
    return square, small, torch.where(small, torch.ones_like(square), square).sqrt()
