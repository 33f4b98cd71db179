"""Steps limited by contact: CCD cuts are not mistaken for rounding, and a knot that locks is reported."""

import numpy as np
import pytest
from eager_steps import step_without_capture

import ddg_warp as ddg
from ddg_warp.errors import SolverError
from ddg_warp.kernels.newton.coupled_newton import SUPPORTS_MOVING
from ddg_warp.scenes import overhand_knot
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.newton.contact_newton import NewtonContact


def test_steps_cut_by_ccd_converge(device):
    """A clamp draws a rod onto a floor almost in contact: CCD cuts the motion to nothing while residuals are large."""
    radius, gap, edges = 2e-3, 2e-5, 40
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    points = np.zeros((edges + 1, 3))
    points[:, 2] = np.linspace(1.0, 0.0, edges + 1) + radius + gap
    section = ddg.Stiffness(EA=1e6, EI1=1.0, GJ=1.0, mass_per_length=1e-3, rotary_inertia=1e-9, radius=radius)
    rod = scene.add_rod(points, section=section)
    scene.clamp_end(rod, "first", motion=ddg.Motion(translation=lambda t: (0.0, 0.0, -1e-3 * t)))
    scene.add_force(rod, edges // 2, (0.1, 0.0, 0.0))
    scene.add_obstacle(ddg.Plane())
    scene.contact(range=gap, stiffness=1e6)
    model = scene.build(device=device)
    integrator = ddg.Integrator(model)
    state = integrator.step(model.state(), 1.0)
    tangent = Tangent(model)
    residual = np.where(tangent.free, tangent.gradient(state) - tangent.loads(1.0, tangent.dofs(state)), 0.0)
    assert np.abs(residual).max() < 1e-5  # inertia is some 1e-6 N
    assert list(integrator.statistics()["outcomes"]) == ["converged"]


def test_whole_step_completes_the_prescribed_motion(device, monkeypatch):
    """A clamp draws a rod onto another, and CCD cuts the predictor: one whole step completes the prescribed motion, despite float32."""
    s = np.linspace(-0.05, 0.05, 13)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    about = {"section": ddg.Circle(2e-3), "material": ddg.Material(young=1e5, density=1000.0, poisson=0.5)}
    scene.add_rod(np.stack([0 * s - 0.046, s, 0 * s - 4.5e-3], 1), **about)
    drawn = scene.add_rod(np.stack([s, 0 * s, 0 * s], 1), **about)
    scene.clamp(drawn, edges=[0], motion=ddg.Motion(translation=lambda t: (0.0, 0.0, -0.1 * np.pi * t)))
    scene.contact(range=1e-3, friction=0.0)
    model = scene.build(device=device, precision="mixed")
    records, hold, place = [], NewtonContact.hold, NewtonContact.place

    def record(contact, islands):
        arrays = (contact.search.time, islands.step_length, islands.support_motion_pending)
        records.append([float(values.numpy()[0]) for values in arrays])

    def watched(method):
        return lambda contact, *state: (method(contact, *state), record(contact, state[-1]))

    monkeypatch.setattr(NewtonContact, "place", watched(place))
    monkeypatch.setattr(NewtonContact, "hold", watched(hold))
    step_without_capture(ddg.Integrator(model, rtol=1e-3), model.state(), 1 / 240)
    predictor, *steps = records
    assert predictor[0] < 1.0 and predictor[2] == SUPPORTS_MOVING
    whole = [driven for fraction, length, driven in steps if fraction == 1.0 and length == 1.0]
    assert whole and SUPPORTS_MOVING not in whole


@pytest.mark.slow
def test_knot_is_tightened_until_it_locks(device):
    """Every step far beyond the loose knot converges, until no room is left. The error names the edges; no rod crosses."""
    scene = overhand_knot.build(tighter=100.0, steps=200)
    model = scene.build(device=device)
    integrator, state = ddg.Integrator(model), scene.initial(model)
    locked = None
    for _ in range(200):
        try:
            state = integrator.step(state, scene.analysis.dt)
        except SolverError as error:
            locked = str(error)
            break
    observed = overhand_knot.observe(model, state)
    assert observed["radius"] < 20.0 * overhand_knot.RADIUS
    assert locked is None or ("no_room" in locked and "is between edge" in locked)
    contact = integrator.statistics()["contact"]
    assert contact["refused_crossings"] == 0
    assert contact["smallest_gap"] > 0.0
