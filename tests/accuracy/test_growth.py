"""Growth through rest forms: bilayers against Timoshenko and Ashwell, and the ripples of a grown edge."""

import pytest
from convergence import equilibrium, order

from ddg_warp.scenes import bilayer_strip

KAPPA = 1.5 * 4e-3 / bilayer_strip.THICKNESS  # of equal layers (Timoshenko 1925), mismatch 4e-3


def curvature(device, width: float, cells: int, mesh: str) -> float:
    """Curvature along the strip [1/m]."""
    return bilayer_strip.curvature(*equilibrium(bilayer_strip.build(4e-3, width, cells, mesh), device))


def test_ashwell_has_timoshenko_and_the_plate_as_limits():
    assert bilayer_strip.exact(4e-3, 1e-3) == pytest.approx(KAPPA, rel=1e-6)
    # wide: (1 + nu) kappa, but for the edges, h^(1/2) / (kappa^(1/2) W)
    errors = [bilayer_strip.exact(4e-3, width) / (1.3 * KAPPA) - 1.0 for width in (10.0, 20.0)]
    assert abs(errors[1]) < 1e-2
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize(("mesh", "cells"), [("right", 2), ("right", 4), ("jittered", 4)])
def test_narrow_strip_bends_as_timoshenko_says(device, mesh, cells):
    """kappa W^2 / h = 0.15."""
    assert curvature(device, 0.02, cells, mesh) == pytest.approx(KAPPA, rel=2e-3)


def test_strip_between_narrow_and_wide(device):
    """kappa W^2 / h = 3.75: the cross-section flattens where it is stretched, and the strip bends by less than kappa."""
    cells, reference = (4, 8), bilayer_strip.exact(4e-3, 0.1)
    assert reference < 0.91 * KAPPA
    errors = [curvature(device, 0.1, n, "crossed") / reference - 1.0 for n in cells]
    assert abs(errors[-1]) < 0.003
    assert order(cells, errors) == pytest.approx(2.0, abs=0.2)


def test_wide_strip_rolls_up_as_a_plate(device):
    """kappa W^2 / h = 60: on the way to (1 + nu) kappa."""
    reference = bilayer_strip.exact(4e-3, 0.4)
    assert reference > 1.2 * KAPPA
    assert curvature(device, 0.4, 16, "right") == pytest.approx(reference, rel=0.01)
