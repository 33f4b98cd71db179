"""Measures of shells beyond the derivative table (test_terms): at sharp folds, with degenerate triangles, in closed form."""

import numpy as np
import pytest

from ddg_warp.geometry.polyline import unit
from ddg_warp.kernels.terms import SHELLS
from ddg_warp.run import derivative_checks

COUNT = 8
# Every term compiles the kernels of the derivative table, so that tests of the same terms are not slow here and there.
DAILY = ("shell_stretch_damped", "shell_stretch_curved", "shell_hinge_damped", "shell_tilt", "shell_isometric")
FLAT = {"shell_stretch", "shell_stretch_damped", "shell_isometric", "shell_isometric_damped"}  # without angles


def cases(names):
    """Return names of terms as parameters, slow outside `DAILY`."""
    return [pytest.param(name, marks=() if name in DAILY else pytest.mark.slow) for name in names]


def sample_of(name: str, device: str, precision: str = "float64") -> derivative_checks.Sample:
    """Return the random elements of the derivative table."""
    (sample,) = derivative_checks.samples_of(SHELLS[name], precision, device)
    return sample


def strains(name: str, device: str, nodes, angles: int = 0, data=None) -> np.ndarray:
    """Return strains (8, strains) of elements with nodes (8 or 1, nodes, 3), angles of zero and data (8 or 1, data)."""
    q = np.broadcast_to(nodes, (COUNT, *np.shape(nodes)[1:])).transpose(1, 0, 2).reshape(-1, 3)
    data = np.broadcast_to([[0.0]] if data is None else data, (COUNT, 1 if data is None else np.shape(data)[1])).T
    q = np.concatenate([q, np.zeros((angles * COUNT, 3))])
    return sample_of(name, device).strains(q=q, constants=data)[0].T


def folded(name: str, device: str) -> derivative_checks.Sample:
    """Return the sample with edges folded by 90 to 170 degrees, to either side, and clamped normals as far from the triangles'."""
    sample, random = sample_of(name, device), np.random.default_rng(3)
    q, data = sample.data["q"].copy(), sample.data["constants"].copy()
    x = q[sample.slots]
    # an edge and its corner: that of hinges and tilts, or the three of a triangle
    edges = [(0, 1, 2)] if sample.measure.nodes < 6 else [(1, 2, 0), (2, 0, 1), (0, 1, 2)]
    for k, (first, second, corner) in enumerate(edges):
        e, a = x[second] - x[first], x[corner] - x[first]
        t = unit(e)
        d = a - t * np.sum(a * t, -1, keepdims=True)
        angle = np.radians(random.uniform(90.0, 170.0, COUNT) * random.choice([-1.0, 1.0], COUNT))[:, None]
        if sample.measure.nodes > 3:
            q[sample.slots[3 + k]] = x[first] + random.uniform(0.2, 0.8, (COUNT, 1)) * e - rotated(d, t, angle) * 1.2
        if sample.measure.data_size:
            kinds, place = (data[0], 1) if sample.measure.nodes == 3 else (data[k], 3 + 3 * k)
            plane, clamp = rotated(unit(d), t, 0.5 * angle), unit(rotated(unit(np.cross(e, a)), t, angle) + 0.1 * t)
            data[place : place + 3] = np.where(kinds > 2.5, plane.T, clamp.T)
    return sample.like({**sample.data, "q": q, "constants": data})


def rotated(vectors, axes, angles):
    """Return vectors rotated about perpendicular axes."""
    return vectors * np.cos(angles) + np.cross(axes, vectors) * np.sin(angles)


@pytest.mark.parametrize("name", cases(name for name in SHELLS if name not in FLAT))
def test_derivatives_agree_at_sharp_folds(device, name):
    """Reverse mode, differences and the hand-derived Jacobian agree at folds of 90 to 170 degrees."""
    sample = folded(name, device)
    if sample.measure.name in ("hinge_angle", "edge_tilt"):
        halved = (sample.measure.name == "edge_tilt") & (sample.data["constants"][0] > 2.5)
        size = np.degrees(np.abs(sample.strains()[0])) * np.where(halved, 2.0, 1.0)
        assert size.min() > 89.0 and size.max() < 171.0
    for check in ("gradient", "hessian", "symmetry", "factor"):
        row = derivative_checks.row(sample, check)
        assert row["passed"], row


@pytest.mark.parametrize("kind", [1, 2])
def test_curvature_grows_with_the_fold(device, kind):
    """c = -2 h phi of an edge of height 0.5, phi half the dihedral angle or the angle to the clamp's normal, to 175 degrees."""
    angles = np.radians([-175.0, -135.0, -91.0, -1.0, 30.0, 91.0, 135.0, 175.0])
    zero, nodes = np.zeros_like(angles), np.zeros((COUNT, 6, 3))
    # edge 2, from node 0 to node 1, is folded; the others are free, their angles zero
    nodes[:, 1], nodes[:, 2] = [1.0, 0.0, 0.0], [0.4, 0.5, 0.0]
    nodes[:, 3], nodes[:, 4] = [1.4, 0.5, 0.0], [1.4, 1.0, 0.0]
    nodes[:, 5] = np.stack([0.3 + zero, -0.7 * np.cos(angles), -0.7 * np.sin(angles)], -1)
    normal = np.stack([zero, -np.sin(angles), np.cos(angles)], -1)
    data = np.concatenate([np.tile([0.0, 0.0, kind], (8, 1)), np.zeros((8, 6)), normal, np.ones((8, 3))], 1)
    expected = -2.0 * 0.5 * angles * (0.5 if kind == 1 else 1.0)
    measured = strains("shell_bend_dof", device, nodes, angles=3, data=data)
    np.testing.assert_allclose(measured, np.outer(expected, [0.0, 0.0, 1.0]), atol=1e-14)


@pytest.mark.parametrize("name", cases(["shell_stretch", "shell_stretch_damped"]))
def test_tension_completes_the_hessian(device, name):
    """F^T F + C, compression included, with the blocks c_ij I is the exact Hessian of the membrane."""
    sample = sample_of(name, device)
    assert derivative_checks.relative(sample.evaluate(exact=True)[0], sample.hessian()) < 1e-13


@pytest.mark.parametrize("precision", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", cases(SHELLS))
def test_degenerate_triangles_stay_finite(device, name, precision):
    """Triangles without area, folded onto each other or inverted give finite values; edges keep their length."""
    sample = sample_of(name, device, precision)
    q, (first, second, corner, *opposite) = sample.data["q"].copy(), sample.slots[: sample.measure.nodes]
    q[corner[:2]] = 0.5 * (q[first[:2]] + q[second[:2]])  # on the edge
    q[corner[2:4]] = 2.0 * q[first[2:4]] - q[corner[2:4]]  # inverted
    if opposite:
        q[opposite[-1][4:6]] = q[corner[4:6]]  # folded: both opposite corners coincide
        q[opposite[-1][6:8]] = 0.5 * (q[first[6:8]] + q[second[6:8]])  # a neighbour without area
    sample = sample.like({**sample.data, "q": q})
    for values in (sample.energy(sample.real), sample.gradient(sample.real), *sample.strains(), *sample.evaluate()):
        assert np.isfinite(values).all()


@pytest.mark.parametrize(("kind", "vector"), [(2, (0.0, 0.0, 1.0)), (3, (0.0, 1.0, 0.0))])
def test_tilt_is_half_the_mirrored_hinge(device, kind, vector):
    """A triangle rises by the angle b from an edge along x: alpha = -b at a clamp to z, -b at the plane y = 0."""
    b = 0.3
    nodes = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.4, np.cos(b), np.sin(b)], [0.4, -np.cos(b), np.sin(b)]]
    tilt = strains("shell_tilt", device, [nodes[:3]], data=[[kind, *vector]])
    hinge = strains("shell_hinge_damped", device, [nodes])
    np.testing.assert_allclose(tilt, -b, atol=1e-15)
    np.testing.assert_allclose(hinge, -2.0 * b, atol=1e-15)
