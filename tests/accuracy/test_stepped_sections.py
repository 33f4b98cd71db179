"""Sections with a jump at a node: half cells of both edges in series, h / B = h_1 / B_1 + h_2 / B_2, against closed forms."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.kernels.densities.quadratic import quadratic

X, Y, Z = np.eye(3)
FORCE = 1e-4


def section(stiffness, **options) -> ddg.Stiffness:
    return ddg.Stiffness(EA=1e6, EI1=stiffness, EI2=stiffness, GJ=stiffness, **options)


def stepped_deflection(device, ratio: float, edges: int, joined: bool = False, dimension: int = 3) -> float:
    """Return the tip deflection of a cantilever, EI = 1 up to the middle and `ratio` beyond, of one rod or two joined rigidly."""
    scene, points = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension), np.linspace(0.0 * X, X, edges + 1)
    half = edges // 2
    if joined:
        rods = [scene.add_rod(points[: half + 1], section=section(1.0), director=Y)]
        rods.append(scene.add_rod(points[half:], section=section(ratio), director=Y))
        scene.join([(rods[0], -1), (rods[1], 0)])
    else:
        rods = [scene.add_rod(points, section=section(np.where(np.arange(edges) < half, 1.0, ratio)))]
    scene.clamp_end(rods[0])
    scene.add_force(rods[-1], -1, FORCE * min(1.0, ratio) * Z)
    return ddg.statics.solve(scene.build(device, "float64")).points()[-1, 2]


CASES = [
    (10.0, {}),
    (0.1, {}),
    (1e-6, {}),
    (0.1, {"joined": True}),
    pytest.param(0.1, {"dimension": 2}, marks=pytest.mark.slow),
]


# d = F (L2^3 / 3 EI2 + L1^3 / 3 EI1 + L1^2 L2 / EI1 + L1 L2^2 / EI1), L1 = L2 = 1/2
@pytest.mark.parametrize(("ratio", "options"), CASES)
def test_stiffness_jump_keeps_second_order(device, ratio, options):
    exact = FORCE * min(1.0, ratio) * (1.0 / ratio + 7.0) / 24.0
    errors = [abs(stepped_deflection(device, ratio, edges, **options) / exact - 1.0) for edges in (10, 20, 40)]
    assert errors[-1] < 2e-3
    np.testing.assert_allclose(np.diff(np.log2(errors)), -2.0, atol=0.05)


def uneven(seed: int, edges: int = 8):
    """Return points of a straight rod of uneven edges, edge lengths, and edge stiffnesses over two decades."""
    random = np.random.default_rng(seed)
    lengths = random.uniform(0.5, 1.5, edges) / edges
    return np.outer(np.concatenate([[0.0], np.cumsum(lengths)]), X), lengths, 10.0 ** random.uniform(-1.0, 1.0, edges)


def to_middles(lengths, rates) -> np.ndarray:
    """Return the integral of rates (edges,) from the first node to the midpoint of every edge."""
    return np.cumsum(lengths * rates) - 0.5 * lengths * rates


def test_shaft_of_many_sections_twists_exactly(device):
    """A moment M rotates midpoints of edges by the integral of M / GJ, for any lengths and sections."""
    points, lengths, GJ = uneven(3)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=1e3, EI1=1.0, GJ=GJ))
    scene.clamp_end(rod)
    scene.add_twisting_moment(rod, -1, 0.3)
    angles = ddg.statics.solve(scene.build(device, "float64")).angles()
    np.testing.assert_allclose(angles, to_middles(lengths, 0.3 / GJ), rtol=1e-9)


def test_natural_twist_per_edge_is_exact(device):
    """The moment is continuous: zero with a free end, M = GJ_i (tau_i - tau0_i) with both ends fixed."""
    points, lengths, GJ = uneven(4)
    natural = np.random.default_rng(5).uniform(-1.0, 1.0, len(GJ))
    laws = {"rod_bend_twist": ddg.Law(quadratic, stiffness=[1.0, 1.0, GJ], rest=[0.0, 0.0, natural])}
    for both_fixed in (False, True):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        rod = scene.add_rod(points, section=section(1.0), laws=laws)
        scene.clamp_end(rod)
        if both_fixed:
            scene.clamp_end(rod, "last")
        angles = ddg.statics.solve(scene.build(device, "float64")).angles()
        moment = -(natural @ lengths) / (lengths / GJ).sum() if both_fixed else 0.0
        np.testing.assert_allclose(angles, to_middles(lengths, natural + moment / GJ), atol=1e-9)
