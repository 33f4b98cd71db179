"""Growth through rest shapes: bilayers against Timoshenko and Ashwell, and ripples of a grown edge."""

import numpy as np
import pytest
from convergence import equilibrium, order
from scipy.fft import dct

from ddg_warp.scenes import bilayer_strip, leaf
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions

KAPPA = 1.5 * 4e-3 / bilayer_strip.THICKNESS  # of equal layers (Timoshenko 1925), mismatch 4e-3


def curvature(device, width: float, cells: int, mesh: str) -> float:
    """Return the curvature along the strip [1/m]."""
    return bilayer_strip.curvature(*equilibrium(bilayer_strip.build(4e-3, width, cells, mesh), device))


def test_ashwell_has_timoshenko_and_the_plate_as_limits():
    assert bilayer_strip.exact(4e-3, 1e-3) == pytest.approx(KAPPA, rel=1e-6)
    # wide: (1 + nu) kappa, with an edge effect of h^(1/2) / (kappa^(1/2) W)
    errors = [bilayer_strip.exact(4e-3, width) / (1.3 * KAPPA) - 1.0 for width in (10.0, 20.0)]
    assert abs(errors[1]) < 1e-2
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize(
    ("mesh", "cells"), [("right", 2), pytest.param("right", 4, marks=pytest.mark.slow), ("jittered", 4)]
)
def test_narrow_strip_has_timoshenko_curvature(device, mesh, cells):
    """kappa W^2 / h = 0.15."""
    assert curvature(device, 0.02, cells, mesh) == pytest.approx(KAPPA, rel=2e-3)


@pytest.mark.slow
def test_intermediate_strip_has_ashwell_curvature(device):
    """The cross-section flattens where stretched at kappa W^2 / h = 3.75, and the strip bends by less than kappa."""
    cells, reference = (4, 8), bilayer_strip.exact(4e-3, 0.1)
    assert reference < 0.91 * KAPPA
    errors = [curvature(device, 0.1, n, "crossed") / reference - 1.0 for n in cells]
    assert abs(errors[-1]) < 0.003
    assert order(cells, errors) == pytest.approx(2.0, abs=0.2)


def test_wide_strip_rolls_up_as_a_plate(device):
    """The curvature at kappa W^2 / h = 60 is close to (1 + nu) kappa."""
    reference = bilayer_strip.exact(4e-3, 0.4)
    assert reference > 1.2 * KAPPA
    assert curvature(device, 0.4, 16, "right") == pytest.approx(reference, rel=0.01)


def energies(device, thickness: float) -> tuple[float, float, float, float]:
    """Return the energies of the rippled and the flat leaf [J], the edge strain, and the grown edge strain."""
    model, state = equilibrium(leaf.build(0.2, thickness, 4, 24), device)
    return *(sum(model.energies(s).values()) for s in (state, leaf.flat_state(model))), *leaf.strains(state)


@pytest.mark.slow
def test_leaf_ripples_to_follow_its_metric(device):
    """The flat leaf has stretching energy proportional to h; the rippled energy is far smaller and falls faster."""
    (thick, flat, *_), (thin, flat_thin, strain, rest) = energies(device, 0.01), energies(device, 0.005)
    assert flat / flat_thin == pytest.approx(2.0, rel=1e-9)
    assert thin < 0.05 * flat_thin
    assert thick / thin > 3.0
    assert strain == pytest.approx(rest, rel=0.05)


def half_waves(device, thickness: float) -> int:
    """Return the number of half waves along the edge of the most unstable mode of the flat state at small growth."""
    model = leaf.build(0.02, thickness, 4, 48).build(device, "float64")
    state = flat_equilibrium(model)
    lowest = spectrum(model, state, 1, "unit")
    assert lowest.negative > 0
    edge = model.scene.shells[0].points[:, 1] > leaf.WIDTH - 1e-9
    ripple = lowest.modes[:, 0].reshape(-1, 3)[: len(edge)][edge, 2]
    return int(np.argmax(np.abs(dct(ripple, type=1))))


def flat_equilibrium(model):
    """Return the flat, unstable equilibrium."""
    return Equilibrium(model, StaticsOptions(mode="follow")).load(leaf.flat_state(model), 1)


def test_ripple_wavelength_scales_with_thickness(device):
    """Growth stresses times E h act against D k^4: the most unstable k^2 ~ E h / D, so the wavelength scales with h."""
    counts = [half_waves(device, thickness) for thickness in (0.02, 0.01)]
    assert counts[1] / counts[0] == pytest.approx(2.0, abs=0.3)
