"""Measures of shells of revolution: derivatives against automatic differentiation and differences, exact shapes, pressure."""

import numpy as np
import pytest
from first_terms import first_of_their_kind
from shell_cases import TERMS, Elements, differences, error

import ddg_warp as ddg
from ddg_warp.compile.axisymmetric import NetBand
from ddg_warp.kernels.terms import AXISYMMETRIC
from ddg_warp.solve.tangent import Tangent

PRECISIONS = {"float64": 1e-13, "float32": 2e-5}
COUNT = 8
STATIC = [name for name in AXISYMMETRIC if "damped" not in name]
FIRST = first_of_their_kind(AXISYMMETRIC)
# Each has kernels of its own in each precision: every day those of every measure and density in float64.
EVERY_TERM = pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(name, precision, marks=() if precision == "float64" and name in FIRST else pytest.mark.slow)
        for precision in PRECISIONS
        for name in AXISYMMETRIC
    ],
)


def sample(name: str) -> Elements:
    """Random elements at which no dof that counts, no strain that can be other, and no parameter is zero; exact in float32."""
    term, random = AXISYMMETRIC[name], np.random.default_rng(7)
    measure = term.measure
    edges = [1.0, 0.3, -0.7, 0.8, 0.2, 0.9][: 3 * len(measure.edges)]
    q = np.concatenate([edges, [2.0, 0.1, 0.5][: 3 * measure.points]]) + 0.15 * random.normal(
        size=(COUNT, measure.size)
    )
    s = random.uniform(0.6, 1.4, size=(COUNT, max(1, measure.data_size)))
    if measure.name == "axisymmetric_rim":
        angle = random.uniform(0.0, 0.3, COUNT)
        s[:, 0], s[:, 2] = np.cos(angle), np.sin(angle)
    p = random.uniform(0.6, 1.4, size=(COUNT, term.density.parameter_size(3)))
    for i, parameter in enumerate(term.density.parameters(3)):
        p[:, i] *= 0.4 if parameter.family == "rest" else {"poisson": 0.3, "metric_12": 0.3}.get(parameter.name, 1.0)
    w = random.uniform(0.6, 1.4, size=COUNT)
    q, s, w, p = (values.astype(np.float32).astype(float) for values in (q, s, w, p))
    if measure.name == "axisymmetric_rim":
        s[:, :3:2] /= np.linalg.norm(s[:, :3:2], axis=1, keepdims=True)
    return Elements(name, q, s, w, p)


@EVERY_TERM
def test_gradient(device, name, precision):
    """w J^T psi' = reverse mode of the energy = central differences of it; heights alone and y have no say."""
    elements = sample(name)
    exact, at = elements.evaluate(device=device), elements.evaluate(precision, device)
    reverse = elements.reverse(device=device)
    assert error(at["gradient"], reverse) < PRECISIONS[precision]
    assert error(exact["gradient"], differences(elements, "energy", device)[:, 0]) < 1e-9
    silent = [i for i in range(elements.q.shape[1]) if i % 3 == 1] + [5] * TERMS[name].measure.points
    felt = np.setdiff1d(np.arange(elements.q.shape[1]), silent)
    assert not exact["gradient"][:, silent].any()
    assert np.abs(exact["gradient"][:, felt]).min() > 1e-5 * np.abs(exact["gradient"]).max()


@pytest.mark.parametrize("name", STATIC)
def test_jacobian(device, name):
    """Rows of J = central differences of the strains."""
    elements = sample(name)
    at, reference = elements.evaluate(device=device), differences(elements, "strain", device)
    for strain in (0, 2):
        assert error(at["jacobian"][:, strain], reference[:, strain]) < 1e-9
    assert not at["jacobian"][:, 1].any()


@EVERY_TERM
def test_hessian(device, name, precision):
    """Reverse mode of the gradient = central differences of it, and symmetric."""
    elements = sample(name)
    hessian = elements.hessian(precision, device)
    assert error(hessian, differences(elements, "gradient", device)) < (1e-8 if precision == "float64" else 1e-4)
    assert error(hessian, hessian.swapaxes(1, 2)) < 10.0 * PRECISIONS[precision]


def test_tension_completes_the_hessian(device):
    """w J^T (psi'' + diag(shift)) J + c I on the edge is the exact Hessian of the membrane; y, which is held, left out."""
    elements = sample("axisymmetric_stretch")
    at = elements.evaluate(device=device)
    radius = elements.q[:, 3] + 0.5 * elements.q[:, 0]
    curvature = np.einsum("kli,klj->kij", at["root"], at["root"])
    curvature[:, 2, 2] += at["stress"][:, 2] / radius**2
    whole = np.einsum("k,kmi,kmn,knj->kij", elements.w, at["jacobian"], curvature, at["jacobian"])
    for i in (0, 2):
        whole[:, i, i] += elements.w * at["stress"][:, 0]
    assert error(whole, elements.hessian(device=device)) < 1e-13


def test_curvatures_of_a_sphere(device):
    """At nodes of a sphere of radius 2, both 1/2 but for the order of the chords: 2 tan(d/2) / chord and cos(d/2) / 2."""
    d, start = 0.1, 0.6
    angle = start + d * np.arange(3)
    x = 2.0 * np.column_stack([np.sin(angle), 0.0 * angle, -np.cos(angle)])
    chord = 4.0 * np.sin(0.5 * d)
    node = Elements(
        "axisymmetric_bend", np.diff(x, axis=0).reshape(1, 6), np.array([[chord, x[1, 0]]]), np.ones(1), np.ones((1, 8))
    )
    strain = node.evaluate(device=device)["strain"][0]
    np.testing.assert_allclose(strain, [0.5 / np.cos(0.5 * d), 0.0, 0.5 * np.cos(0.5 * d)], rtol=1e-13)


def cap(reverse, device):
    """A unit sphere's cap of 1 rad from pole to rim, or from rim to pole, under weight and a pressure of 7 Pa from outside."""
    angle = np.linspace(0.0, 1.0, 9)
    points = np.column_stack([np.sin(angle), np.cos(angle)])[:: -1 if reverse else 1]
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    material = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
    shell = scene.add_axisymmetric_shell(points, thickness=0.01, material=material)
    scene.hold_ring(shell, [0 if reverse else -1], "z")
    scene.add_axisymmetric_pressure(shell, 7.0 if reverse else -7.0)
    return points, scene.build(device, "float64")


def test_poles_rims_and_direction(device):
    """Run from pole to rim or back: curvatures and the side of pressure change sign, energies and forces do not."""
    seen = []
    for reverse in (False, True):
        points, model = cap(reverse, device)
        tangent, state = Tangent(model), model.state()
        shell = model.net.host.meridians[0]
        assert shell.kind == (("free", "pole") if reverse else ("pole", "free"))
        np.testing.assert_allclose(shell.curvature, 1.0 if reverse else -1.0, rtol=0.01)
        assert all(abs(model.energies(state)[name]) < 1e-20 for name in STATIC)
        moved = state.points()
        moved[:, 2] += 0.1 * np.cos(3.0 * moved[:, 0])
        moved[:, 0] *= 1.05
        other = model.state(points=moved)
        slope = tangent.gradient(other).reshape(-1, 3)[:: -1 if reverse else 1]
        seen.append((np.array([model.energies(other)[name] for name in STATIC]), slope))
        # cones of surface A: weight rho g h A; axial force of pressure p on the projected disc, p pi r^2
        forces, r = tangent.loads(1.0, tangent.dofs(state)).reshape(-1, 3), np.sin(1.0)
        surface = np.pi * ((points[1:, 0] + points[:-1, 0]) * np.linalg.norm(np.diff(points, axis=0), axis=1)).sum()
        assert forces[:, 2].sum() == pytest.approx(-98.1 * surface - 7.0 * np.pi * r**2, rel=1e-12)
    (energy, slope), (same_energy, same_slope) = seen
    assert energy.min() > 0.0
    np.testing.assert_allclose(same_energy, energy, rtol=1e-12)
    np.testing.assert_allclose(same_slope, slope, atol=1e-12 * np.abs(slope).max())


def test_pressure_follows_with_its_exact_derivative():
    """d(forces)/dx = central differences; between held rims the forces derive from the enclosed volume of the cones."""
    random = np.random.default_rng(3)
    x = np.column_stack([1.0 + random.random(6), np.zeros(6), np.arange(6.0)]) + 0.1 * random.normal(size=(6, 3))
    ends = np.column_stack([np.arange(5), np.arange(1, 6)])
    band = NetBand(ends, random.uniform(1.0, 2.0, 5), None)
    analytic, step = band.derivative(x[ends]), 1e-6
    for j in range(2):
        for d in range(3):
            shift = np.zeros((1, 2, 3))
            shift[0, j, d] = step
            column = (band.forces(x[ends] + shift) - band.forces(x[ends] - shift)) / (2.0 * step)
            np.testing.assert_allclose(analytic[..., j, d], column, atol=1e-8)
    even = NetBand(ends, np.ones(5), None)
    total = np.zeros((6, 3))
    np.add.at(total, ends, even.forces(x[ends]))

    def volume(x):  # -pi int r^2 dz of cones, with the normal to the left
        r0, r1 = x[:-1, 0], x[1:, 0]
        return -np.pi / 3.0 * ((r0**2 + r0 * r1 + r1**2) * np.diff(x[:, 2])).sum()

    for node in range(1, 5):
        for d in (0, 2):
            shift = np.zeros((6, 3))
            shift[node, d] = step
            assert total[node, d] == pytest.approx((volume(x + shift) - volume(x - shift)) / (2.0 * step), abs=1e-8)
