"""Ribbons as rods: energy that a rod lacks compared with a plate, and a ring with the half twist of a Moebius band.

The plate's counterpart, a flat sheet on a cylinder in any direction, is `test_bending_energy_of_cylinders`.
"""

import numpy as np
import pytest
from convergence import order

import ddg_warp as ddg
from ddg_warp.scenes import michell_ring
from ddg_warp.solve.equilibrium import stability, statics

POISSON, WIDTH, LENGTH = 0.3, 0.1, 1.0


def rod_energy(device, edges: int, angle: float) -> float:
    """Return 2 E / (D W L) of a straight Kirchhoff rod on the helix, EI = D W and GJ = 2 (1 - nu) D W."""
    s, c, t = np.linspace(0.0, LENGTH, edges + 1), np.cos(angle), np.sin(angle)
    stiffness = ddg.Stiffness(EA=1e6, EI1=WIDTH, EI2=1e4, GJ=2.0 * (1.0 - POISSON) * WIDTH)
    points = np.stack([np.cos(s * c), np.sin(s * c), s * t], -1)  # on a cylinder of radius 1 m
    middle = 0.5 * (s[1:] + s[:-1])
    normals = np.stack([np.cos(middle * c), np.sin(middle * c), 0.0 * middle], -1)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rod(points, section=stiffness, natural="straight", director=normals)
    scene.fix(0, range(edges + 1))
    scene.fix_twist(0, range(edges))
    model = scene.build(device, "float64")
    bending = model.energies(model.state())["rod_bend_twist"]
    return 2.0 * bending / (WIDTH * LENGTH * (1.0 - 1.0 / edges))  # vertex cells omit half an edge at each end


# kappa^2 + 2 (1 - nu) tau^2 with kappa = cos^2(angle), tau = sin(angle) cos(angle): 1, 0.9580127019, 0.825, 0.6. The strip itself is
# isometric to the cylinder, with (kappa^2 + tau^2)^2 / kappa^2 = 1 at any angle (Sadowsky 1930).
@pytest.mark.parametrize(("degrees", "exact"), [(0.0, 1.0), (15.0, 0.9580127019), (30.0, 0.825), (45.0, 0.6)])
def test_rod_energy_on_a_cylinder(device, degrees, exact):
    edges = (20, 40, 80)
    errors = [rod_energy(device, n, np.radians(degrees)) / exact - 1.0 for n in edges]
    assert abs(errors[-1]) < 1e-3
    assert order(edges, errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("ratio", [1.0, 2.0 / 3.0, 3.0])
def test_circle_is_stable_with_half_a_twist(device, ratio):
    """Tw = pi < 2 pi sqrt(3) B / C if C / B < 2 sqrt(3) (Michell 1889); another full twist is unstable at C / B = 3."""
    for twist, stable in ((np.pi, True), (3.0 * np.pi, ratio < 1.1)):
        model = michell_ring.build(twist / michell_ring.exact(ratio), ratio, 120).build(device, "float64")
        state = statics.solve(model, mode="follow")
        assert np.abs(state.points()[:, 2]).max() < 1e-9
        assert (stability.spectrum(model, state, 1, "unit").negative == 0) == stable
