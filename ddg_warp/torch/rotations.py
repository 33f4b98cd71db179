"""Rotation vectors and unit quaternions as tensors, differentiable everywhere."""

import torch

SMALL = 1e-6  # rad; below, series are exact to rounding


def quaternion(vectors: torch.Tensor) -> torch.Tensor:
    """Return unit quaternions (..., 4) of rotation vectors r (..., 3) [rad]: sin(|r| / 2) r / |r|, then cos(|r| / 2)."""
    square, small, length = _length(vectors)
    scalar = torch.where(small, 1.0 - square / 8.0, torch.cos(0.5 * length))
    return torch.cat([vectors * torch.where(small, 0.5 - square / 48.0, torch.sin(0.5 * length) / length), scalar], -1)


def turned(vectors: torch.Tensor, rotations: torch.Tensor) -> torch.Tensor:
    """Compose rotation vectors (..., 3) [rad] with `rotations`, about fixed axes in space; the result is at most pi long.

    The product of unit quaternions (v, s) and (w, t) is (s w + t v + v x w, s t - v . w).
    """
    (v, s), (w, t) = (quaternion(rotation).split([3, 1], -1) for rotation in (rotations, vectors))
    scalar = s * t - (v * w).sum(-1, keepdim=True)
    vector = s * w + t * v + torch.linalg.cross(v, w)
    sign = torch.where(scalar < 0.0, -1.0, 1.0)
    scalar, vector = sign * scalar, sign * vector
    _, small, length = _length(vector)
    return vector * torch.where(small, 2.0 / scalar, 2.0 * torch.atan2(length, scalar) / length)


def partway(start: torch.Tensor, end: torch.Tensor, fraction: float) -> torch.Tensor:
    """Interpolate rotation vectors (..., 3) [rad] along the shorter arc, at a given `fraction`."""
    return turned(start, fraction * turned(-start, end))


def halfway(start: torch.Tensor, end: torch.Tensor) -> torch.Tensor:
    """Return the quaternion halfway along the shorter arc."""
    near = torch.where((start * end).sum(-1, keepdim=True) < 0.0, -end, end)
    return torch.nn.functional.normalize(start + near, dim=-1)


def matrix(quaternions: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) of quaternions."""
    x, y, z, w = quaternions.unbind(-1)
    rows = [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w)]
    rows += [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w)]
    rows += [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)]
    return torch.stack(rows, -1).reshape(*x.shape, 3, 3)


def _length(vectors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return squared lengths (..., 1), a mask of small ones, and lengths, 1 where small, with derivatives everywhere."""
    square = (vectors * vectors).sum(-1, keepdim=True)
    small = square < SMALL**2
    return square, small, torch.where(small, torch.ones_like(square), square).sqrt()
