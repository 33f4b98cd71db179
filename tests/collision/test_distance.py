"""Distances with closest points against all cases one by one, at random and at boundaries of cases."""

import brute_force
import numpy as np
import pytest
import warp as wp

from ddg_warp.kernels.collision.broad_phase.candidate_validity import corners_function
from ddg_warp.kernels.collision.primitives import EDGE_POINT, EDGES, POINT_POINT, POINT_TRIANGLE, pair_functions
from ddg_warp.kernels.core.launch import CPU_OPTIONS

KINDS = {
    "edges": (EDGES, brute_force.edge_edge),
    "point and triangle": (POINT_TRIANGLE, brute_force.point_triangle),
    "edge and point": (EDGE_POINT, lambda a, b, p, _: brute_force.point_edge(p, a, b)),
    "two points": (POINT_POINT, lambda a, b, *_: np.linalg.norm(a - b, axis=-1)),
}
REGIONS = {"edges": 9, "point and triangle": 7, "edge and point": 3, "two points": 1}


def closest_points(kind, corners: np.ndarray, device: str, real=wp.float64) -> tuple[np.ndarray, np.ndarray]:
    """Return offsets (n, 3) and weights (n, 4) of corners (n, 4, 3)."""
    X, W = wp.types.vector(3, real), wp.types.vector(4, real)
    *_, closest = pair_functions(kind, real)
    corners_of = corners_function(real)

    @wp.kernel(module="unique", enable_backward=False, module_options=CPU_OPTIONS)
    def measure(x: wp.array(dtype=X), r: wp.array(dtype=X), w: wp.array(dtype=W)):
        i = wp.tid()
        a, b = closest(corners_of(x, wp.vec4i(4 * i, 4 * i + 1, 4 * i + 2, 4 * i + 3)))
        r[i] = a
        w[i] = b

    n = len(corners)
    r, w = wp.zeros(n, dtype=X, device=device), wp.zeros(n, dtype=W, device=device)
    wp.launch(measure, n, [wp.array(corners.reshape(-1, 3), dtype=X, device=device)], [r, w], device=device)
    return r.numpy(), w.numpy()


def exact_distances(reference, corners: np.ndarray) -> np.ndarray:
    """Return distances in extended precision, to resolve the boundaries of cases."""
    return reference(*np.moveaxis(corners.astype(np.longdouble), 1, 0)).astype(float)


def configurations() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(20_000, 4, 3))
    parallel, near, coincident, point, flat = (x[:4000].copy() for _ in range(5))
    parallel[:, 3] = parallel[:, 2] + rng.uniform(-2, 2, (4000, 1)) * (parallel[:, 1] - parallel[:, 0])
    near[:, 3] = (
        near[:, 2] + near[:, 1] - near[:, 0] + 10.0 ** rng.uniform(-12, -3, (4000, 1)) * rng.normal(size=(4000, 3))
    )
    coincident[:, 2:] = coincident[:, :2]
    point[:, 3] = point[:, 2]
    flat[..., 2] = 0.0
    return {
        "random": x,
        "parallel": parallel,
        "near parallel": near,
        "coincident": coincident,
        "point": point,
        "flat": flat,
    }


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("case", configurations())
def test_distances_equal_the_least_of_all_cases(device, name, case):
    kind, reference = KINDS[name]
    corners = configurations()[case]
    r, w = closest_points(kind, corners, device)
    assert np.linalg.norm(r, axis=1) == pytest.approx(exact_distances(reference, corners), abs=2e-14, rel=1e-13)
    # the offset joins the closest points, which lie on both primitives
    assert np.einsum("nk,nkd->nd", w, corners) == pytest.approx(r, abs=2e-14)
    side = kind.first
    assert w[:, :side].min() >= 0.0 and w[:, side:].max() <= 0.0
    assert w[:, :side].sum(1) == pytest.approx(np.ones(len(w)), abs=1e-15)
    assert w[:, side:].sum(1) == pytest.approx(-np.ones(len(w)), abs=1e-15)


@pytest.mark.parametrize("name", KINDS)
def test_float32_keeps_seven_digits_of_the_size(device, name):
    kind, reference = KINDS[name]
    for corners in configurations().values():
        corners = corners.astype(np.float32).astype(float)
        r, _ = closest_points(kind, corners, device, wp.float32)
        assert np.linalg.norm(r, axis=1) == pytest.approx(exact_distances(reference, corners), abs=2e-5)


@pytest.mark.parametrize("name", KINDS)
def test_every_region_occurs_with_zero_weights_outside(device, name):
    kind, _ = KINDS[name]
    _, w = closest_points(kind, configurations()["random"], device)
    regions = {tuple(row) for row in w != 0.0}
    assert len(regions) == REGIONS[name]
