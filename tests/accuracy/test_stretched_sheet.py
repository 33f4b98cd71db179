"""Wrinkles of a stretched sheet (Cerda and Mahadevan, Phys. Rev. Lett. 90, 2003, 074302): lambda = 2 sqrt(pi) L^(1/2) (D / T)^(1/4).

A wrinkle w = A cos(k y) sin(pi x / L) takes up the width A^2 k^2 at a cost of D k^2 + T (pi / L)^2 / k^2. The minimum is at
k^4 = (T / D) (pi / L)^2: bending against tension along the wrinkles. A transverse compression works on the width taken up, so
this is the buckling mode of a sheet under tension T and transverse compression.

One half-wave of the sheet is modelled between symmetry planes, a quarter by symmetry, with hinged ends. Its width b is varied, and
the wavelength is that of the width that buckles first. The stress before buckling is uniform. A sheet between clamps, compressed
by Poisson's contraction, reaches this limit only far above the wrinkling strain.
"""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium import stability
from ddg_warp.solve.equilibrium.statics import Equilibrium

LENGTH, POISSON, STRAIN = 1.0, 0.3, 1e-3


def wavelength(thickness: float) -> float:
    """Return Cerda and Mahadevan's wavelength [m], with T = E h STRAIN, D = E h^3 / (12 (1 - nu^2))."""
    return 2.0 * np.sqrt(np.pi * LENGTH) * (thickness**2 / (12.0 * (1.0 - POISSON**2) * STRAIN)) ** 0.25


def critical(device, thickness: float, width: float, along: int, across: int) -> float:
    """Return the buckling compression of a half-wave of a width, over 2 pi sqrt(D T) / L, the least one."""
    points, triangles = meshes.rectangle(along, across, (0.5 * LENGTH, width), "crossed")
    young = 12.0 * (1.0 - POISSON**2) / thickness**3  # D = 1 N m
    tension = young * thickness * STRAIN
    compression = 2.0 * np.pi * np.sqrt(tension) / LENGTH

    def displacement(t):
        """Return edge stretches minus one, of Green's strains: tension at t = 1, compression added at t = 2."""
        nx, ny = tension * min(t, 1.0), -compression * max(t - 1.0, 0.0)
        strains = np.array([nx - POISSON * ny, ny - POISSON * nx]) / (young * thickness)
        return np.sqrt(1.0 + 2.0 * strains) - 1.0

    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    sheet = scene.add_shell(points, triangles, thickness=thickness, material=ddg.Material(young, POISSON))
    x, y = points[:, 0] / (0.5 * LENGTH), points[:, 1] / width
    end, side = x > 1.0 - 1e-9, y > 1.0 - 1e-9
    scene.symmetry(sheet, np.flatnonzero(x < 1e-9), "x")
    scene.symmetry(sheet, np.flatnonzero(y < 1e-9), "y")
    scene.hold(sheet, np.flatnonzero(end), "z")
    pull = ddg.Motion(translation=lambda t: (0.5 * LENGTH * displacement(t)[0], 0.0, 0.0))
    press = ddg.Motion(translation=lambda t: (0.0, width * displacement(t)[1], 0.0))
    scene.hold(sheet, np.flatnonzero(end), "x", motion=pull)
    scene.symmetry(sheet, np.flatnonzero(side), "y", motion=press)
    model = scene.build(device, "float64")
    solver = Equilibrium(model)
    stretched = solver.load(model.state(), 1, 0.0, 1.0)
    return stability.buckling(model, stretched, solver.load(stretched, 1, 1.0, 2.0))[0]


def first_buckling(device, thickness: float, along: int, across: int) -> tuple[float, float]:
    """Return the wavelength over Cerda and Mahadevan's, and the critical compression: the minimum of a cubic in log b."""
    ratios = np.array([0.85, 0.95, 1.05, 1.15])
    loads = [critical(device, thickness, 0.5 * r * wavelength(thickness), along, across) for r in ratios]
    curve = np.polynomial.Polynomial.fit(np.log(ratios), loads, 3)
    roots = curve.deriv().roots()
    least = roots[np.argmin(np.abs(roots))].real
    assert np.log(ratios[0]) < least < np.log(ratios[-1])
    return float(np.exp(least)), float(curve(least))


@pytest.mark.slow
def test_wavelength_and_exponent(device):
    """Within 15 % in the wavelength and 0.02 in the exponent of (D / T)^(1/4), over a factor of 4 in thickness, 12 cells a wave."""
    thickness = np.array([4e-4, 2e-4, 1e-4])
    results = [first_buckling(device, h, along, 6) for h, along in zip(thickness, (20, 28, 40), strict=True)]
    ratios = np.array(results)[:, 0]
    assert ratios == pytest.approx(np.ones(3), abs=0.15)
    waves = np.array([wavelength(h) for h in thickness])
    exponent = np.polyfit(np.log(waves), np.log(ratios * waves), 1)[0]  # wavelength() is (D / T)^(1/4) times a number
    assert exponent == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_wavelength_and_load_converge(device):
    """Doubled cells halve the error or better, and give the load of the plate, (D (k^2 + q^2)^2 + T q^2) / k^2."""
    coarse, fine = (first_buckling(device, 4e-4, n * 10, n * 3) for n in (2, 4))
    assert abs(fine[0] - 1.0) < 0.02
    assert abs(fine[0] - 1.0) < 0.5 * abs(coarse[0] - 1.0)
    plate = 1.0 + (0.5 * wavelength(4e-4) / LENGTH) ** 2
    assert fine[1] == pytest.approx(plate, rel=0.03)


def test_buckling_load_of_the_wave(device):
    """A wave of Cerda and Mahadevan's length buckles at the load of the plate.

    At D k^4 = T q^2 the load is 1 + (q / k)^2 + (q / k)^4 / 2 times 2 q sqrt(D T), with the width pi / k and the length pi / q.
    """
    width = 0.5 * wavelength(4e-4)
    assert critical(device, 4e-4, width, 40, 12) == pytest.approx(1.0 + (width / LENGTH) ** 2, rel=0.03)
