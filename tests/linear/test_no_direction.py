"""Conjugate gradients that float32 leaves without a direction: said by name, never taken for rounding."""

import numpy as np
import warp as wp

import ddg_warp as ddg
from ddg_warp.kernels.solve import krylov
from ddg_warp.scenes import gridshell_dome
from ddg_warp.solve import step


def test_solves_without_a_direction_are_noted(device):
    """By r . z that is not positive, or no number, at the start of a solve; later, by more than what is asked for."""
    _, _, begin, *_, test = krylov.solver_kernels(wp.float32)
    first = [1.0, 0.0, -1.0, np.nan, np.inf, 1.0]

    def put(values, dtype=wp.float32):
        return wp.array(np.broadcast_to(values, 6).copy(), dtype=dtype, device=device)

    wanted, negative, iterations, busy = (put(v, int) for v in ([1, 1, 1, 1, 1, 0], 0, 0, 0))
    rho, start = put(0.0), put(0.0)
    wp.launch(begin, 6, [put(first), wanted], [rho, start, iterations, negative, busy], device=device)
    assert wanted.numpy().tolist() == [1, 3, 3, 3, 3, 0]
    assert negative.numpy().tolist() == [0, 1, 1, 1, 1, 0]
    left = [1e-3, 1e-5, -1e-5, -1e-3, np.nan, 0.0]  # of 1; 1e-4 are asked for
    wanted, negative = put(1, int), put(0, int)
    given = [put(left), put(1.0), put(1.0), put(1e-2), 100]
    wp.launch(test, 6, given, [put(1.0), iterations, negative, wanted, busy], device=device)
    assert wanted.numpy().tolist() == [1, 2, 2, 3, 3, 2]
    assert negative.numpy().tolist() == [0, 0, 0, 1, 1, 0]


def test_where_there_is_no_direction_second_derivatives_are_left_out(device, monkeypatch):
    """A slack gridshell, EA L^2 / EI = 1e8, whose exact Hessian overflows float32: all of its steps converge, as in float64."""
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
    monkeypatch.setattr(step, "suited", lambda *_: step.Means(wp.float32, True, False))  # whatever suits
    found, mixed = advanced("mixed")
    assert mixed["linear"] == ["float32"]
    assert mixed["outcomes"] == {"converged": 4}
    assert np.abs(found - exact).max() < 1e-7 * np.ptp(exact, axis=0).max()
