"""LDL^T of a node's block, triangular solves and congruences, against NumPy."""

from functools import cache

import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.linear import block_ldlt

SIZES = pytest.mark.parametrize("size", [2, 3, 4])
REALS = pytest.mark.parametrize("real", [wp.float64, wp.float32], ids=["float64", "float32"])
COUNT = 100


@cache
def kernels(size, real):
    """Build kernels that apply the device functions to arrays."""
    H, M = wp.types.vector(size, real), wp.types.matrix((size, size), real)
    factor, lower, upper, lower_vector, upper_vector, congruence = block_ldlt.functions(size, real)

    @wp.kernel(module="unique", enable_backward=False)
    def factorise(
        A: wp.array(dtype=M),
        B: wp.array(dtype=M),
        b: wp.array(dtype=H),
        L_out: wp.array(dtype=M),
        inverse_out: wp.array(dtype=H),
        lost_out: wp.array(dtype=int),
        Z_out: wp.array(dtype=M),
        X_out: wp.array(dtype=M),
        z_out: wp.array(dtype=H),
        x_out: wp.array(dtype=H),
        schur_out: wp.array(dtype=M),
    ):
        i = wp.tid()
        L, inverse, lost = factor(A[i])
        L_out[i] = L
        inverse_out[i] = inverse
        lost_out[i] = lost
        Z = lower(L, B[i])
        Z_out[i] = Z
        X_out[i] = upper(L, inverse, Z)
        z = lower_vector(L, b[i])
        z_out[i] = z
        x_out[i] = upper_vector(L, inverse, z)
        schur_out[i] = congruence(Z, inverse, Z)

    return factorise


def solve(A, B, b, real, device):
    """Return all results of the kernel by name, in float64, and L with a unit diagonal."""
    size = A.shape[-1]
    kernel = kernels(size, real)
    names = [argument.label for argument in kernel.adj.args]
    types = [argument.type.dtype for argument in kernel.adj.args]
    inputs = [wp.array(v, dtype=t, device=device) for v, t in zip((A, B, b), types, strict=False)]
    out = [wp.zeros(len(A), dtype=t, device=device) for t in types[3:]]
    wp.launch(kernel, len(A), inputs, out, device=device)
    result = {name.removesuffix("_out"): a.numpy().astype(float) for name, a in zip(names[3:], out, strict=True)}
    result["L"] = np.tril(result["L"], -1) + np.eye(size)
    return result


def blocks(size, condition, real, seed=0):
    """Return symmetric positive definite blocks, rounded to `real`, and right-hand sides."""
    random = np.random.default_rng(seed)
    q, _ = np.linalg.qr(random.normal(size=(COUNT, size, size)))
    spectrum = np.geomspace(1.0, 1.0 / condition, size)
    A = np.einsum("nij,j,nkj->nik", q, spectrum, q)
    A = 0.5 * (A + A.transpose(0, 2, 1))
    B, b = random.normal(size=(COUNT, size, size)), random.normal(size=(COUNT, size))
    kind = wp.dtype_to_numpy(real)
    return [value.astype(kind).astype(float) for value in (A, B, b)]


def backward_error(A, x, b):
    """Return |A x - b| over |A| |x| + |b|, largest of all blocks."""
    x, b = x.reshape(*A.shape[:2], -1), b.reshape(*A.shape[:2], -1)
    residual = np.linalg.norm(A @ x - b, axis=1)
    scale = np.linalg.norm(A, axis=(1, 2))[:, None] * np.linalg.norm(x, axis=1) + np.linalg.norm(b, axis=1)
    return (residual / scale).max()


@SIZES
@REALS
def test_factors_and_solves_of_well_conditioned_blocks(device, size, real):
    A, B, b = blocks(size, 10.0, real)
    got = solve(A, B, b, real, device)
    tolerance = 100.0 * np.finfo(wp.dtype_to_numpy(real)).eps
    L, D = got["L"], 1.0 / got["inverse"]
    assert (got["lost"] == 0).all()
    np.testing.assert_allclose(np.einsum("nij,nj,nkj->nik", L, D, L), A, atol=tolerance)
    np.testing.assert_allclose(got["Z"], np.linalg.solve(L, B), atol=10 * tolerance)
    np.testing.assert_allclose(got["X"], np.linalg.solve(A, B), atol=100 * tolerance)
    np.testing.assert_allclose(got["z"], np.linalg.solve(L, b[..., None])[..., 0], atol=10 * tolerance)
    np.testing.assert_allclose(got["x"], np.linalg.solve(A, b[..., None])[..., 0], atol=100 * tolerance)
    schur = B.transpose(0, 2, 1) @ np.linalg.solve(A, B)
    np.testing.assert_allclose(got["schur"], schur, atol=100 * tolerance)
    assert np.abs(got["L"] - np.eye(size)).max() > 0.1


@SIZES
@pytest.mark.parametrize(("real", "condition"), [(wp.float64, 1e10), (wp.float32, 1e4)], ids=["float64", "float32"])
def test_ill_conditioned_blocks_keep_a_small_backward_error(device, size, real, condition):
    A, B, b = blocks(size, condition, real)
    got = solve(A, B, b, real, device)
    eps = np.finfo(wp.dtype_to_numpy(real)).eps
    assert (got["lost"] == 0).all()
    assert backward_error(A, got["x"], b) < 20.0 * eps
    assert backward_error(A, got["X"], B) < 20.0 * eps
    assert np.linalg.cond(A).min() > 0.5 * condition  # the blocks are as ill-conditioned as intended


@SIZES
@REALS
def test_small_bending_pivots_keep_their_digits(device, size, real):
    """A block of a thin rod: stiffness 1e8 along a tangent, 1 across. Its small pivots keep their digits.

    The solution loses the digits that the ratio of stiffness costs, and not more.
    """
    random = np.random.default_rng(1)
    t = random.normal(size=(COUNT, size))
    t /= np.linalg.norm(t, axis=-1, keepdims=True)
    kind = wp.dtype_to_numpy(real)
    stretch = 1e8 if real == wp.float64 else 1e4
    A = (np.eye(size) + stretch * t[:, :, None] * t[:, None]).astype(kind).astype(float)
    b = random.normal(size=(COUNT, size)).astype(kind).astype(float)
    got = solve(A, A, b, real, device)
    assert (got["lost"] == 0).all()
    assert backward_error(A, got["x"], b) < 20.0 * np.finfo(kind).eps
    exact = np.linalg.solve(A, b[..., None])[..., 0]
    error = np.linalg.norm(got["x"] - exact, axis=-1) / np.linalg.norm(exact, axis=-1)
    assert error.max() < 20.0 * stretch * np.finfo(kind).eps


@SIZES
@REALS
def test_lost_pivots_are_counted(device, size, real):
    """One negative, two negative, one zero and one pivot below the rounding floor; results stay finite and positive."""
    tiny = 0.1 * np.finfo(wp.dtype_to_numpy(real)).eps
    one, two, zero, rounded = (np.eye(size) for _ in range(4))
    one[-1, -1] = -2.0
    two[0, 0] = two[-1, -1] = -1.0
    zero[0, 0] = 0.0
    rounded[-1, -1] = 1.0
    rounded[-1, 0] = rounded[0, -1] = np.sqrt(1.0 - tiny)
    A = np.array([np.eye(size), one, two, zero, rounded])
    B, b = np.broadcast_to(np.eye(size), A.shape).copy(), np.ones((len(A), size))
    got = solve(A, B, b, real, device)
    assert got["lost"].tolist() == [0, 1, 2, 1, 1]
    assert np.isfinite(got["x"]).all()
    assert (got["inverse"] > 0.0).all()
    np.testing.assert_allclose(got["inverse"][1], [1.0] * (size - 1) + [0.5])
