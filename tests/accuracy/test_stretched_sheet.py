"""Wrinkles of a stretched sheet (Cerda and Mahadevan, Phys. Rev. Lett. 90, 2003, 074302): lambda = 2 sqrt(pi) L^(1/2) (D / T)^(1/4).

A wrinkle w = A cos(k y) sin(pi x / L) costs D k^2 + T (pi / L)^2 / k^2 for the width A^2 k^2 that it takes up, which is least at
k^4 = (T / D) (pi / L)^2: bending against the tension along the wrinkles. Taking up width is what a compression across does work on,
so this is the wave that a sheet under tension T takes when it is compressed across. One half-wave of the sheet is modelled between
symmetry planes, a quarter by symmetry, with hinged ends; its width b is varied, and the wave is the width that buckles first. The
stress before buckling is uniform. The sheet between clamps, where Poisson's contraction makes that compression, is not this limit
until the strain is far above that at which it wrinkles.
"""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve import stability
from ddg_warp.solve.statics import Equilibrium

LENGTH, POISSON, STRAIN = 1.0, 0.3, 1e-3


def wavelength(thickness: float) -> float:
    """Cerda and Mahadevan's [m], with T = E h STRAIN, D = E h^3 / (12 (1 - nu^2))."""
    return 2.0 * np.sqrt(np.pi * LENGTH) * (thickness**2 / (12.0 * (1.0 - POISSON**2) * STRAIN)) ** 0.25


def critical(device, thickness: float, width: float, along: int, across: int) -> float:
    """Compression across at which a half-wave of this width buckles, over 2 pi sqrt(D T) / L, the least one."""
    points, triangles = meshes.rectangle(along, across, (0.5 * LENGTH, width), "crossed")
    young = 12.0 * (1.0 - POISSON**2) / thickness**3  # D = 1 N m
    tension = young * thickness * STRAIN
    compression = 2.0 * np.pi * np.sqrt(tension) / LENGTH

    def displacement(t):
        """At t = 1 the tension, at t = 2 the compression too; of Green's strains, as stretches minus one."""
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


def measured(device, thickness: float, along: int, across: int) -> tuple[float, float]:
    """Wavelength over Cerda and Mahadevan's, and critical compression: the minimum of a cubic in log b."""
    ratios = np.array([0.85, 0.95, 1.05, 1.15])
    loads = [critical(device, thickness, 0.5 * r * wavelength(thickness), along, across) for r in ratios]
    curve = np.polynomial.Polynomial.fit(np.log(ratios), loads, 3)
    roots = curve.deriv().roots()
    least = roots[np.argmin(np.abs(roots))].real
    assert np.log(ratios[0]) < least < np.log(ratios[-1])
    return float(np.exp(least)), float(curve(least))


@pytest.mark.slow
def test_wavelength_and_exponent(device):
    """15 % in the wavelength and 0.02 in the exponent of (D / T)^(1/4) for a thickness that falls to a quarter, 12 cells a wave."""
    thickness = np.array([4e-4, 2e-4, 1e-4])
    found = [measured(device, h, along, 6) for h, along in zip(thickness, (20, 28, 40), strict=True)]
    ratios = np.array(found)[:, 0]
    assert ratios == pytest.approx(np.ones(3), abs=0.15)
    waves = np.array([wavelength(h) for h in thickness])
    exponent = np.polyfit(np.log(waves), np.log(ratios * waves), 1)[0]  # wavelength() is (D / T)^(1/4) times a number
    assert exponent == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_converges(device):
    """Twice as many cells both ways: half of the error or less, and the load of the plate, D (k^2 + q^2)^2 + T q^2 over k^2."""
    coarse, fine = (measured(device, 4e-4, n * 10, n * 3) for n in (2, 4))
    assert abs(fine[0] - 1.0) < 0.02
    assert abs(fine[0] - 1.0) < 0.5 * abs(coarse[0] - 1.0)
    plate = 1.0 + (0.5 * wavelength(4e-4) / LENGTH) ** 2
    assert fine[1] == pytest.approx(plate, rel=0.03)


def test_load_of_the_wave(device):
    """The wave of Cerda and Mahadevan's length, on the finer of those meshes, buckles at the load of the plate (above).

    Where D k^4 = T q^2 that is 1 + (q / k)^2 + (q / k)^4 / 2 of 2 q sqrt(D T), with the width pi / k and the length pi / q.
    """
    width = 0.5 * wavelength(4e-4)
    assert critical(device, 4e-4, width, 40, 12) == pytest.approx(1.0 + (width / LENGTH) ** 2, rel=0.03)
