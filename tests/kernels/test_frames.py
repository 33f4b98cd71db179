"""Parallel transport, reference twist and rotation of frames against defining properties."""

from functools import cache

import numpy as np
import pytest
import warp as wp

from ddg_warp.geometry.polyline import unit
from ddg_warp.kernels.elements import parallel_transport

REALS = pytest.mark.parametrize("real", [wp.float64, wp.float32], ids=["float64", "float32"])


@cache
def kernels(real):
    """Build kernels that apply the device functions to arrays."""
    V = wp.types.vector(3, real)
    transport, reference_twist, rotate = parallel_transport.functions(real)

    @wp.kernel(module="unique", enable_backward=False)
    def carry(d: wp.array(dtype=V), t0: wp.array(dtype=V), t1: wp.array(dtype=V), out: wp.array(dtype=V)):
        i = wp.tid()
        out[i] = transport(d[i], t0[i], t1[i])

    @wp.kernel(module="unique", enable_backward=False)
    def twist(
        ue: wp.array(dtype=V),
        uf: wp.array(dtype=V),
        te: wp.array(dtype=V),
        tf: wp.array(dtype=V),
        lagged: wp.array(dtype=real),
        out: wp.array(dtype=real),
    ):
        i = wp.tid()
        out[i] = reference_twist(ue[i], uf[i], te[i], tf[i], lagged[i])

    @wp.kernel(module="unique", enable_backward=False)
    def spin(d: wp.array(dtype=V), t: wp.array(dtype=V), angle: wp.array(dtype=real), out: wp.array(dtype=V)):
        i = wp.tid()
        out[i] = rotate(d[i], t[i], angle[i])

    return carry, twist, spin


def apply(kernel, real, device, *values):
    """Launch over arrays; the result has the type of the kernel's last argument."""
    types = [argument.type.dtype for argument in kernel.adj.args]
    inputs = [wp.array(v, dtype=t, device=device) for v, t in zip(values, types, strict=False)]
    out = wp.zeros(len(values[0]), dtype=types[-1], device=device)
    wp.launch(kernel, len(values[0]), inputs, [out], device=device)
    return out.numpy().astype(float)


def directions(count=200, seed=1):
    """Return pairs of unit tangents, and vectors of any length and direction."""
    random = np.random.default_rng(seed)
    t0, t1 = unit(random.normal(size=(2, count, 3)))
    t1[0] = t0[0]  # no rotation at all
    t1[1] = unit(t0[1] + 1e-9)
    far = np.sum(t0 * t1, -1) < -0.9  # near the singularity digits are lost by design
    t1[far] = -t1[far]
    return t0, t1, random.normal(size=(count, 3)) * random.uniform(0.1, 10.0, size=(count, 1))


def tolerance(real) -> float:
    return 200.0 * np.finfo(wp.dtype_to_numpy(real)).eps


def perpendicular(t, seed=2):
    return unit(np.cross(t, np.random.default_rng(seed).normal(size=t.shape)))


@REALS
def test_transport_takes_tangent_to_tangent(device, real):
    t0, t1, _ = directions()
    np.testing.assert_allclose(apply(kernels(real)[0], real, device, t0, t0, t1), t1, atol=tolerance(real))


@REALS
def test_transport_is_a_rotation(device, real):
    """Lengths and angles stay, and a vector perpendicular to both tangents does not move."""
    t0, t1, d = directions()
    carry = kernels(real)[0]
    e = np.random.default_rng(3).normal(size=d.shape)
    new_d, new_e = apply(carry, real, device, d, t0, t1), apply(carry, real, device, e, t0, t1)
    scale = np.linalg.norm(d, axis=-1) * np.linalg.norm(e, axis=-1)
    error = np.abs(np.sum(new_d * new_e, -1) - np.sum(d * e, -1)) / scale
    assert error.max() < tolerance(real)
    norm = np.linalg.norm(d, axis=-1)
    assert np.abs(np.linalg.norm(new_d, axis=-1) / norm - 1.0).max() < tolerance(real)
    determinant = np.sum(np.cross(new_d, new_e) * t1, -1) - np.sum(np.cross(d, e) * t0, -1)
    assert (np.abs(determinant) / scale).max() < tolerance(real)
    axis = np.cross(t0, t1)
    np.testing.assert_allclose(apply(carry, real, device, axis, t0, t1), axis, atol=tolerance(real))
    assert np.abs(new_d - d).max() > 0.1  # it does rotate


@REALS
def test_transport_back_is_the_inverse(device, real):
    t0, t1, d = directions()
    carry = kernels(real)[0]
    back = apply(carry, real, device, apply(carry, real, device, d, t0, t1), t1, t0)
    assert (np.linalg.norm(back - d, axis=-1) / np.linalg.norm(d, axis=-1)).max() < tolerance(real)


@REALS
def test_rotation_equals_rodrigues(device, real):
    t, _, _ = directions()
    d = perpendicular(t)
    angle = np.linspace(-7.0, 7.0, len(t))
    spin = np.cross(t[:, None], np.eye(3)).transpose(0, 2, 1)  # spin v = t x v
    matrix = np.eye(3) + np.sin(angle)[:, None, None] * spin + (1.0 - np.cos(angle))[:, None, None] * (spin @ spin)
    expected = np.einsum("nij,nj->ni", matrix, d)
    np.testing.assert_allclose(apply(kernels(real)[2], real, device, d, t, angle), expected, atol=tolerance(real))


@REALS
def test_reference_twist_continues_past_pi(device, real):
    """A frame rotates steadily: in small steps the twist grows through five revolutions without a jump."""
    carry, twist, spin = kernels(real)
    te, tf, _ = directions(40)
    ue = perpendicular(te)
    level = apply(carry, real, device, ue, te, tf)
    for direction in (1.0, -1.0):
        lagged = np.zeros(len(te))
        for angle in direction * np.arange(0.0, 10.0 * np.pi, 2.5):  # steps below pi
            uf = apply(spin, real, device, level, tf, np.full(len(te), angle))
            lagged = apply(twist, real, device, ue, uf, te, tf, lagged)
            np.testing.assert_allclose(lagged, angle, atol=20.0 * tolerance(real))
        assert np.abs(lagged).min() > 8.0 * np.pi


@REALS
def test_reference_twist_takes_the_nearest_branch(device, real):
    carry, twist, spin = kernels(real)
    te, tf, _ = directions(50)
    ue = perpendicular(te)
    angle = np.random.default_rng(4).uniform(-3.1, 3.1, size=len(te))
    uf = apply(spin, real, device, apply(carry, real, device, ue, te, tf), tf, angle)
    lagged = np.random.default_rng(5).uniform(-30.0, 30.0, size=len(te))
    result = apply(twist, real, device, ue, uf, te, tf, lagged)
    turns = (result - angle) / (2.0 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=tolerance(real))
    assert np.abs(result - lagged).max() <= np.pi * (1.0 + tolerance(real))
