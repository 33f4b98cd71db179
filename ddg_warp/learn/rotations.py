"""Rotation vectors that turn on, as tensors with gradients everywhere."""

import torch

SMALL = 1e-8  # rad; below, series of first order are exact to rounding


def turned(vectors: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Rotation vectors (..., 3) [rad] after rotations `by` others, about axes in space; of the result's two the shorter one.

    By unit quaternions (s, v) = (cos(|r| / 2), sin(|r| / 2) r / |r|), whose product is (s t - v . w, s w + t v + v x w).
    """
    (s, v), (t, w) = _quaternion(by), _quaternion(vectors)
    scalar = s * t - (v * w).sum(-1, keepdim=True)
    vector = s * w + t * v + torch.linalg.cross(v, w)
    sign = torch.where(scalar < 0.0, -1.0, 1.0)
    scalar, vector = sign * scalar, sign * vector
    square = (vector**2).sum(-1, keepdim=True)
    small = square < SMALL**2
    length = torch.where(small, torch.ones_like(square), square).sqrt()  # of which there is a derivative
    return vector * torch.where(small, 2.0 / scalar, 2.0 * torch.atan2(length, scalar) / length)


def _quaternion(vectors: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Scalar (..., 1) and vector (..., 3) of the unit quaternions of rotation vectors."""
    square = (vectors**2).sum(-1, keepdim=True)
    small = square < SMALL**2
    angle = torch.where(small, torch.ones_like(square), square).sqrt()
    scalar = torch.where(small, 1.0 - square / 8.0, torch.cos(0.5 * angle))
    return scalar, vectors * torch.where(small, 0.5 - square / 48.0, torch.sin(0.5 * angle) / angle)
