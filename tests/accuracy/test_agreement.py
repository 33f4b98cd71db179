"""Agreement with published numbers of the same discretisation: cantilever and steel wire, step by step, to the digits printed.

The reference solves the same discrete equations (nodes 0 and 1 and the first angle held, released straight) to rounding, so that
nothing but the digits of its table limits the comparison in float64. What "mixed" and "float32" lose is measured and bounded;
float32 does not carry the wire at all, whose every rounding unit of stretch weighs more than the wire.
"""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.scenes import cantilever, steel_wire
from ddg_warp.solve.statics import solve

DIGITS = 1.0e-5  # m

# The same table, continued: implicit midpoint at 0.01 s, and the equilibrium; nodes -> tip (x, z) [m].
MIDPOINT = {0.1: (0.997576, -0.048744), 0.5: (0.231836, -0.859117), 1.0: (0.838515, -0.513456)}
STATIC = {50: (0.6756422, -0.6804289), 100: (0.6689071, -0.6882507)}


def tips(scene, device: str, precision: str, times, scheme: str = "implicit_euler") -> dict[float, np.ndarray]:
    """Tip (x, z) [m] of the first rod at some times [s], in steps of 0.01 s."""
    model = scene.build(device=device, precision=precision)
    integrator, state, found = ddg.Integrator(model, scheme), model.state(), {}
    for k in range(1, round(100 * max(times)) + 1):
        state = integrator.step(state, 0.01)
        if any(k == round(100 * t) for t in times):
            found[k / 100] = state.points()[model.curves.counts[0] - 1, [0, 2]]
    integrator.check(state)
    return found


def largest_error(found: dict, reference: dict) -> float:
    """Largest difference of coordinates [m]; a reference may give z alone."""
    return max(np.abs(found[t][-np.size(tip) :] - tip).max() for t, tip in reference.items())


# In float32 a stretch of one rounding unit is a force as large as the weight of a node, so that steps end early; measured: 65 and
# 208 mm at 50 and 100 nodes, which is good for looking at, and for nothing else.
LOOKS = {50: 0.1, 100: 0.3}  # m


@pytest.mark.parametrize(
    "precision", ["float64", *(pytest.param(precision, marks=pytest.mark.slow) for precision in ("mixed", "float32"))]
)
@pytest.mark.parametrize("n", sorted(cantilever.TIP))
def test_cantilever_by_implicit_euler(n, precision, device):
    found = tips(cantilever.build(n), device, precision, cantilever.TIP[n])
    error = largest_error(found, cantilever.TIP[n])
    print(f"cantilever n={n} {precision}: {error:.3g}")
    assert error <= (LOOKS[n] if precision == "float32" else DIGITS)


@pytest.mark.parametrize(
    ("precision", "tolerance"),
    [
        ("float64", DIGITS),
        pytest.param("mixed", DIGITS, marks=pytest.mark.slow),
        pytest.param("float32", 1.0e-3, marks=pytest.mark.slow),
    ],
)
def test_cantilever_by_implicit_midpoint(precision, tolerance, device):
    found = tips(cantilever.build(50), device, precision, MIDPOINT, "implicit_midpoint")
    error = largest_error(found, MIDPOINT)
    print(f"midpoint {precision}: {error:.3g}")
    assert error <= tolerance


@pytest.mark.parametrize("n", sorted(STATIC))
def test_cantilever_at_rest(n, device):
    model = cantilever.build(n).build(device=device, precision="float64")
    tip = solve(model, load_steps=4).points()[n - 1, [0, 2]]
    print(f"static n={n}: {np.abs(tip - STATIC[n]).max():.3g}")
    assert np.abs(tip - STATIC[n]).max() <= 1.0e-7  # printed to seven digits


@pytest.mark.parametrize(
    ("precision", "tolerance"), [("float64", DIGITS), pytest.param("mixed", DIGITS, marks=pytest.mark.slow)]
)
def test_steel_wire(precision, tolerance, device):
    found = tips(steel_wire.build(100), device, precision, steel_wire.TIP[100])
    error = largest_error(found, steel_wire.TIP[100])
    print(f"wire {precision}: {error:.3g}")
    assert error <= tolerance
