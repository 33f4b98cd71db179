"""Conjugate gradients without a descent direction in float32: reported by name, never taken for rounding."""

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.kernels.linear import coupled_pcg
from ddg_warp.scenes import gridshell_dome
from ddg_warp.solve.linear.sparse_system import Sums
from ddg_warp.solve.stepping import step_driver


def test_solves_without_direction_are_flagged(device):
    """Flag r . z <= 0 or not finite at the start of a solve, and later beyond the tolerance."""
    _, _, begin, *_, test, _ = coupled_pcg.solver_kernels(wp.float32, serial=device_arrays.serial(device))
    first = [1.0, 0.0, -1.0, np.nan, np.inf, 1.0]

    def upload(values, dtype=wp.float32):
        return wp.array(np.broadcast_to(values, 6).copy(), dtype=dtype, device=device)

    wanted, negative, iterations, busy = (upload(v, int) for v in ([1, 1, 1, 1, 1, 0], 0, 0, 0))
    rho, start = upload(0.0), upload(0.0)
    wp.launch(begin, 6, [upload(first), wanted], [rho, start, iterations, negative, busy], device=device)
    assert wanted.numpy().tolist() == [1, 3, 3, 3, 3, 0]
    assert negative.numpy().tolist() == [0, 1, 1, 1, 1, 0]
    left = [1e-3, 1e-5, -1e-5, -1e-3, np.nan, 0.0]  # of 1; the tolerance is 1e-4
    wanted, negative = upload(1, int), upload(0, int)
    inputs = [upload(1.0), upload(1.0), upload(1e-2), 100]
    outputs = [upload(0.0), upload(1.0), upload(0.0), iterations, negative, wanted, busy]
    Sums(6, 1, wp.float32, device).launch(test, upload(left).reshape((6, 1)), inputs, outputs)
    assert wanted.numpy().tolist() == [1, 2, 2, 3, 3, 2]
    assert negative.numpy().tolist() == [0, 0, 0, 1, 1, 0]


def test_lost_direction_drops_second_derivatives(device, monkeypatch):
    """A slack gridshell, EA L^2 / EI = 1e8, whose exact Hessian overflows float32: all steps converge, as in float64."""
    scene = gridshell_dome.build(3, 16)
    for batch in scene.batches:
        axial = 1e8 / gridshell_dome.SPAN**2
        batch.section = ddg.Stiffness(EA=axial, EI1=1.0, EI2=1.0, GJ=0.8, mass_per_length=1.0, rotary_inertia=1e-6)
    scene.gravity = np.array([3.0, 1.0, -9.81])

    def advanced(precision: str, **options) -> tuple[np.ndarray, dict]:
        integrator = ddg.Integrator(model := scene.build(device, precision), **options)
        state = model.state()
        for _ in range(4):
            state = integrator.step(state, 1.0 / 15.0)
        return state.points(), integrator.statistics()

    exact, _ = advanced("float64", rtol=1e-10)
    monkeypatch.setattr(
        step_driver, "choose_solver", lambda *_: step_driver.LinearSolverChoice(wp.float32, True, False)
    )  # instead of the solver selection
    points, mixed = advanced("mixed")
    assert mixed["linear"] == ["float32"]
    assert mixed["outcomes"] == {"converged": 4}
    assert np.abs(points - exact).max() < 1e-7 * np.ptp(exact, axis=0).max()
