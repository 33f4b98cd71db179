"""Large deflections of thin shells: the benchmarks of Sze, Liu and Lo, Finite Elem. Anal. Des. 40 (2004) 1551-1569.

References are the tables of Abaqus S4R in that paper, with digits as quoted in public codes, good to about 0.3 %. For the plate
the reference is the elastica, for the pinched cylinder the linear solution of Lindberg, Olson and Cowper (1969).
"""

import numpy as np
import pytest
from convergence import equilibrium, order

from ddg_warp.scenes import cantilever_plate_shear, hinged_roof, pinched_cylinder, pullout_cylinder, slit_annulus
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions


def path(module, device, steps, **parameters):
    """Return observed values by load parameter, of a scene with a number of load steps, and the solver."""
    scene = module.build(steps=steps, **parameters)
    model = scene.build(device, "float64")
    solver, state, values = Equilibrium(model, StaticsOptions(rtol=1e-8)), model.state(), {}
    for k in range(steps):
        state = solver.load(state, 1, k / steps, (k + 1) / steps)
        values[round((k + 1) / steps, 6)] = module.observe(model, state)
    return values, solver


@pytest.mark.slow
@pytest.mark.parametrize("membrane", ["flat", "curved"])
def test_cantilever_plate_matches_elastica(device, membrane):
    """Elastica of P L^2 / EI = 4: order 2 in the cell length, and 0.02 % of the length at 64 cells."""
    cells, errors = (16, 32, 64), []
    for n in cells:
        scene = cantilever_plate_shear.build(n, pattern="alternating", membrane=membrane, steps=3)
        tip = cantilever_plate_shear.observe(*equilibrium(scene, device))
        errors.append(np.hypot(*(np.array([tip["inwards"], tip["along"]]) - cantilever_plate_shear.exact(1.0))))
    assert errors[-1] < 2e-4 * cantilever_plate_shear.LENGTH
    assert order(cells, errors) == pytest.approx(2.0, abs=0.15)


@pytest.mark.slow
def test_slit_annulus_does_not_lock(device):
    """Six cells across, thirty around: flat facets lift the lip 4 to 6 % too little, curved sides 1.5 %."""
    inner, outer = slit_annulus.TABLE[1.0]
    errors = {}
    for membrane in ("flat", "curved"):
        values, _ = path(slit_annulus, device, 10, radial=6, around=30, pattern="alternating", membrane=membrane)
        errors[membrane] = np.array([values[1.0]["inner"] / inner, values[1.0]["outer"] / outer]) - 1.0
    assert np.abs(errors["curved"]).max() < 0.02
    assert np.all(errors["flat"] < -0.04)


@pytest.mark.slow
def test_slit_annulus_path_converges(device):
    """The path at 40, 60 and 90 cells around: errors fall along the whole path, to 0.65 % at most."""
    cells, errors = (40, 60, 90), []
    for n in cells:
        values, _ = path(slit_annulus, device, 20, radial=n // 10, around=n)
        errors.append([values[load]["inner"] / reference[0] - 1.0 for load, reference in slit_annulus.TABLE.items()])
    assert np.abs(errors[-1]).max() < 0.0065
    assert np.all(np.diff(np.abs(errors), axis=0) < 0.0)
    assert np.all(order(cells, errors) > 1.0)


@pytest.mark.slow
def test_slit_annulus_error_on_unstructured_mesh(device):
    """A Delaunay mesh with 10 cells across is 2 % off."""
    values, _ = path(slit_annulus, device, 20, radial=10, around=50, pattern="jittered")
    inner, outer = slit_annulus.TABLE[1.0]
    assert values[1.0]["inner"] == pytest.approx(inner, rel=0.02)
    assert values[1.0]["outer"] == pytest.approx(outer, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "tolerance"), [(8, 0.015), (24, 0.006)])
def test_pullout_cylinder_matches_reference(device, n, tolerance):
    values, _ = path(pullout_cylinder, device, 20, n=n)
    for load, (radial,) in pullout_cylinder.TABLE.items():
        assert values[load]["radial"] == pytest.approx(radial, rel=tolerance), load


def test_pinched_cylinder_is_linear_at_small_load(device):
    """w E h / P = 164.24 on graded meshes: order 1.5 or more (a point force on a plate), below 2 % at 24 cells."""
    cells = (8, 12, 16, 24)
    models = [pinched_cylinder.build(n).build(device, "float64") for n in cells]
    errors = [pinched_cylinder.compliance(model) / pinched_cylinder.LINEAR - 1.0 for model in models]
    assert abs(errors[-1]) < 0.02
    assert order(cells, errors) > 1.5


@pytest.mark.slow
def test_pinched_cylinder_reaches_the_full_load(device):
    """The full load is reached, with deflections that grow in every step."""
    values, _ = path(pinched_cylinder, device, 40)
    inwards = np.array([value["inwards"] for value in values.values()])
    assert np.all(np.diff(inwards) > 0.0)
    assert inwards[-1] > 0.7 * pinched_cylinder.RADIUS


@pytest.mark.parametrize(
    ("thickness", "cells", "tolerance"),
    [
        pytest.param(12.7, (3, 6, 12), 0.006, marks=pytest.mark.slow),
        pytest.param(12.7, (4, 8, 16), 0.003, marks=pytest.mark.slow),
        pytest.param(6.35, (4, 8, 16), 0.005, marks=pytest.mark.slow),
    ],
)
def test_hinged_roof_limit_load_converges(device, thickness, cells, tolerance):
    """First limit load: order 2 in the cell length, 0.3 or 0.5 % at 16 cells, and 0.3 % extrapolated."""
    loads = []
    for n in cells:
        values, _ = path(hinged_roof, device, 16, thickness=thickness, n=n, membrane="flat")
        series = {name: [0.0, *(value[name] for value in values.values())] for name in ("drop", "force")}
        loads.append(hinged_roof.limit(series)[0])
    assert loads[2] == pytest.approx(hinged_roof.LIMIT[thickness], rel=tolerance)
    assert np.log2((loads[1] - loads[0]) / (loads[2] - loads[1])) == pytest.approx(2.0, abs=0.25)
    assert (4.0 * loads[2] - loads[1]) / 3.0 == pytest.approx(hinged_roof.LIMIT[thickness], rel=3e-3)


@pytest.mark.slow
def test_mixed_newton_needs_few_iterations(device):
    """Each solver takes at most five iterations per rotation of 13 degrees; line search uses stresses of the last step."""
    scene = cantilever_plate_shear.build(16, membrane="flat")
    model = scene.build(device, "float64")
    counts = []
    for mixed in (True, False):
        solver = Equilibrium(model)
        solver.mixed = mixed
        state = solver.load(model.state(), 10)
        counts.append((solver.iterations, cantilever_plate_shear.observe(model, state)["along"]))
    assert max(count for count, _ in counts) <= 50
    assert counts[0][1] == pytest.approx(counts[1][1], abs=1e-7)


@pytest.mark.slow
def test_line_search_replaces_failed_mixed_newton(device):
    """One load step is too long for mixed Newton at the stiffness jump; line search still finds the minimum."""
    model = pullout_cylinder.build(6, membrane="flat").build(device, "float64")
    solver = Equilibrium(model)
    state = solver.load(model.state(), 1)
    residual = solver.tangent.loads(1.0, solver.tangent.dofs(state)) - solver.tangent.gradient(state)
    assert np.abs(residual[solver.tangent.free]).max() < 1e-5 * pullout_cylinder.FORCE
    steps = Equilibrium(model)
    stepped = steps.load(model.state(), 10)
    assert np.abs(stepped.points() - state.points()).max() < 1e-6
