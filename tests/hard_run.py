"""Run of a hard case, in which no failed attempt counts as converged."""

import numpy as np

import ddg_warp as ddg

DONE = ("converged", "converged_to_rounding", "lost_in_rounding")


def attempt(scene, device, dt, count, names, start=None, precision="float64", fails=(), lossy=False, **options):
    """Take steps from the rest state or from points `start`, and check properties of every run.

    Args:
        fails: the only outcomes by which the run may end early; none by default.
        lossy: allow float32 to lose the motion in rounding.

    Returns:
        Model, last state, total energy after every step with the start first [J], statistics, and an error or None.
        The error ended the run; its message has the outcome and all of `names`.
    """
    model = scene.build(device, precision, allow_rounding=lossy)
    state, integrator, error = model.state(points=start), ddg.Integrator(model, check_every=1, **options), None
    energy = [sum(model.energies(state).values())]
    for _ in range(count):
        try:
            state = integrator.step(state, dt)
        except ddg.SolverError as raised:
            assert raised.outcome in fails, raised
            error, state = raised, raised.state
            break
        assert np.isfinite(state.points()).all()
        energy.append(sum(model.energies(state).values()))
    statistics = integrator.statistics()
    failed = {k: v for k, v in statistics["outcomes"].items() if k not in DONE}
    assert sum(failed.values()) == statistics["retries"]  # no failed attempt counts as converged
    assert np.isfinite(state.points()).all()
    assert np.isfinite(state.velocities()).all()
    if error:
        assert error.outcome in failed
        for word in (error.outcome, *names):
            assert word in str(error)
    return model, state, np.array(energy), statistics, error
