"""Shells of revolution beyond the derivative table (test_terms): the exact Hessian of the membrane, exact shapes, pressure."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.compile.axisymmetric import BandPressure
from ddg_warp.kernels.terms import AXISYMMETRIC
from ddg_warp.run.derivative_checks import relative, samples_of
from ddg_warp.solve.equilibrium.tangent import Tangent

STATIC = [name for name in AXISYMMETRIC if "damped" not in name]


def test_tension_completes_the_hessian(device):
    """The hoop stress s adds w s / r^2 times the square of d(r^2 / 2), and makes the Hessian exact; the fixed y is left out."""
    (sample,) = samples_of(AXISYMMETRIC["axisymmetric_stretch"], device=device)
    whole, radial = sample.evaluate(exact=True)[0], [0, 3]  # r is the mean of both nodes'
    whole[np.ix_(radial, radial)] += 0.25 * sample.data["buffer"][0] * sample.strains()[1][2]
    read = np.ix_([0, 2, 3, 5], [0, 2, 3, 5])
    assert relative(whole[read], sample.hessian()[read]) < 1e-13


def test_curvatures_of_a_sphere(device):
    """Curvatures of a sphere of radius 2 are 1/2 but for the order of chords: 2 tan(d/2) / chord and cos(d/2) / 2."""
    d, start = 0.1, 0.6
    angle = start + d * np.arange(3)
    x = 2.0 * np.column_stack([np.sin(angle), 0.0 * angle, -np.cos(angle)])
    chord = 4.0 * np.sin(0.5 * d)
    (sample,) = samples_of(AXISYMMETRIC["axisymmetric_bend"], device=device)
    constants = np.repeat([[chord], [x[1, 0]]], 8, axis=1)
    strain = sample.strains(q=np.repeat(x, 8, axis=0), constants=constants)[0]
    np.testing.assert_allclose(strain[:, 0], [0.5 / np.cos(0.5 * d), 0.0, 0.5 * np.cos(0.5 * d)], rtol=1e-13)


def cap(reverse, device):
    """Return the points and the model of a unit sphere's cap of 1 rad, from pole to rim or back.

    Weight and a pressure of 7 Pa from outside act on the cap.
    """
    angle = np.linspace(0.0, 1.0, 9)
    points = np.column_stack([np.sin(angle), np.cos(angle)])[:: -1 if reverse else 1]
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    material = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
    shell = scene.add_axisymmetric_shell(points, thickness=0.01, material=material)
    scene.hold_ring(shell, [0 if reverse else -1], "z")
    scene.add_axisymmetric_pressure(shell, 7.0 if reverse else -7.0)
    return points, scene.build(device, "float64")


def test_energies_do_not_depend_on_the_direction_of_a_meridian(device):
    """A reversed meridian changes the sign of curvatures and the side of pressure, not energies and forces."""
    results = []
    for reverse in (False, True):
        points, model = cap(reverse, device)
        tangent, state = Tangent(model), model.state()
        shell = model.coupled.host.meridians[0]
        assert shell.kind == (("free", "pole") if reverse else ("pole", "free"))
        np.testing.assert_allclose(shell.curvature, 1.0 if reverse else -1.0, rtol=0.01)
        assert all(abs(model.energies(state)[name]) < 1e-20 for name in STATIC)
        moved = state.points()
        moved[:, 2] += 0.1 * np.cos(3.0 * moved[:, 0])
        moved[:, 0] *= 1.05
        displaced = model.state(points=moved)
        slope = tangent.gradient(displaced).reshape(-1, 3)[:: -1 if reverse else 1]
        results.append((np.array([model.energies(displaced)[name] for name in STATIC]), slope))
        # cones of surface A: weight rho g h A; axial force of pressure p on the projected disc, p pi r^2
        forces, r = tangent.loads(1.0, tangent.dofs(state)).reshape(-1, 3), np.sin(1.0)
        surface = np.pi * ((points[1:, 0] + points[:-1, 0]) * np.linalg.norm(np.diff(points, axis=0), axis=1)).sum()
        assert forces[:, 2].sum() == pytest.approx(-98.1 * surface - 7.0 * np.pi * r**2, rel=1e-12)
    (energy, slope), (same_energy, same_slope) = results
    assert energy.min() > 0.0
    np.testing.assert_allclose(same_energy, energy, rtol=1e-12)
    np.testing.assert_allclose(same_slope, slope, atol=1e-12 * np.abs(slope).max())


def test_pressure_forces_and_derivatives_are_exact():
    """Derivatives of forces equal central differences; forces between fixed rims derive from the enclosed volume of the cones."""
    random = np.random.default_rng(3)
    x = np.column_stack([1.0 + random.random(6), np.zeros(6), np.arange(6.0)]) + 0.1 * random.normal(size=(6, 3))
    ends = np.column_stack([np.arange(5), np.arange(1, 6)])
    band = BandPressure(ends, random.uniform(1.0, 2.0, 5))
    analytic, step = band.derivative(x[ends]), 1e-6
    for j in range(2):
        for d in range(3):
            shift = np.zeros((1, 2, 3))
            shift[0, j, d] = step
            column = (band.forces(x[ends] + shift) - band.forces(x[ends] - shift)) / (2.0 * step)
            np.testing.assert_allclose(analytic[..., j, d], column, atol=1e-8)
    even = BandPressure(ends, np.ones(5))
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
