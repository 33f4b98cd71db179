"""Residual tolerance: equal position errors for any number of coupled rods and any mesh size.

No unbalanced start counts as converged: a smooth residual is small at every node of a fine mesh.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.compile.residual_tolerance import FAN, outer_forces
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from tests.pairwise import chosen

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import bench_rods
import bench_tolerance as bench

RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
FACTOR = 3.0


def errors(study: bench.Study, device, rtol: float, steps: int) -> list[float]:
    return [row["error"] for row in bench.rows_of(study, wp.get_device(device), (rtol,), steps)]


@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_error_of_uncoupled_and_coupled_rods(device, rtol):
    """One rod, and 1 and 100 coupled rods: the error is far above rounding and at most rtol times the fall."""
    steps = 10
    position_errors = errors(bench.Study("rods", lambda n: bench.rods(n, False), (1,)), device, rtol, steps)
    position_errors += errors(
        bench.Study("rods in a net", lambda n: bench.rods(n, True), (1, 100)), device, rtol, steps
    )
    assert max(position_errors) <= FACTOR * min(position_errors)
    fall = 0.5 * 9.81 * (steps * bench.DT) ** 2
    assert 1e-12 < max(position_errors) < 10.0 * rtol * fall


@chosen([(True, 121)], island=(False, True), nodes=(121, 961))
def test_long_rods_of_many_nodes(device, island, nodes):
    """Rods of 1 cm edges are off by less than rtol times length after 64 steps, and by less for smaller rtol."""
    case = bench_rods.Case(
        "", 3, nodes, length=0.01 * (nodes - 1), precision="mixed", island=island, blocks=1, block=54
    )
    on, results = wp.get_device(device), {}
    for rtol in (8e-7, 1e-8):
        results[rtol] = bench_rods.run(replace(case, rtol=rtol), on)[1]
    single = replace(case, rods=1, island=False, solver="sweep", precision="float64", rtol=bench_rods.EXACT_RTOL)
    exact = bench_rods.run(single, on)[1]
    fall = np.ptp(exact[..., 2])
    assert fall > 0.2
    for rtol, points in results.items():
        assert np.linalg.norm(points - exact, axis=2).max() < rtol * case.length


@pytest.mark.parametrize(
    ("sizes", "steps"), [((6, 12, 24), 12), pytest.param((32, 64, 128), 20, marks=pytest.mark.slow)]
)
def test_error_is_independent_of_mesh_size(device, sizes, steps):
    """Errors follow rtol, not the cell size, in the logarithmic mean, as last iterates lie anywhere below the limit."""
    fall = 0.5 * 9.81 * (steps * bench.DT) ** 2
    rtols = np.array([1e-5, 1e-6, 1e-7])
    position_errors = np.array(
        [errors(bench.Study("sheet", bench.sheet, sizes), device, rtol, steps) for rtol in rtols]
    )
    mean = np.exp(np.log(position_errors / rtols[:, None]).mean(0))
    assert mean.max() <= FACTOR * mean.min(), position_errors
    assert (position_errors > 1e-12).all() and (position_errors < 10.0 * fall * rtols[:, None]).all()
    assert (position_errors[2] < 0.1 * position_errors[0]).all()


def scene_of_many_nodes(kind: str) -> ddg.Scene:
    """Return objects of so many nodes that one node weighs less than `rtol` of the whole, at rest but for a support."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    if kind == "sheet":
        points, triangles = meshes.rectangle(40, 40)
        scene.hold(scene.add_shell(points, triangles, thickness=1e-3, material=RUBBER, bending="hinge"), [0])
        return scene
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 200)
    rods = [scene.add_rod(points + [0.0, y, 0.0], section=ddg.Circle(0.01), material=RUBBER) for y in (0.0, 1.0)]
    scene.clamp(rods[0], edges=[0])
    scene.clamp(rods[1], edges=[0])
    if kind == "net":
        beam = np.linspace([1.0, 0.0, 0.0], [1.0, 1.0, 0.0], 41)
        cross = scene.add_rod(beam, section=ddg.Circle(0.01), material=RUBBER)
        scene.join([(rods[0], -1), (cross, 0)])
        scene.join([(rods[1], -1), (cross, -1)])
    return scene


@pytest.mark.parametrize(
    ("kind", "solver"),
    [("rods", solver) for solver in ("sweep", "cyclic_reduction", "projective")] + [("net", "auto"), ("sheet", "auto")],
)
def test_unbalanced_start_is_not_converged(device, kind, solver):
    """Free fall from rest, s = g h^2 in a step of implicit Euler, with a tolerance above the weight of a node."""
    options = {"solver": solver} if solver == "projective" else {"linear": solver}
    model = scene_of_many_nodes(kind).build(device, "float64")
    integrator, dt = ddg.Integrator(model, rtol=0.02, **options), 1e-3
    start = model.state()
    state = integrator.step(start, dt)
    fallen = (start.points() - state.points())[:, 2]
    assert np.median(fallen) == pytest.approx(9.81 * dt**2, rel=0.05)
    assert integrator.statistics()["newton_iterations"]["mean"] >= 1.0


@pytest.mark.parametrize(
    ("kind", "solver"), [("rods", "direct"), ("net", "direct"), pytest.param("sheet", "pcg", marks=pytest.mark.slow)]
)
def test_loose_tolerance_carries_the_weight(device, kind, solver):
    """Supports of hanging objects carry the weight to 2 %, in the sum m g, despite a loose tolerance."""
    scene = scene_of_many_nodes(kind)
    if kind == "sheet":
        scene.hold(0, np.arange(41))  # along one side
    model = scene.build(device, "float64")
    search = Equilibrium(model, StaticsOptions(solver=solver, rtol=0.02))
    state = search.load(model.state(), 4)
    assert search.iterations > 0
    weight = 9.81 * (RUBBER.density * 1e-3 if kind == "sheet" else sum(_masses(model)))
    support_force = sum(reaction.force[2] for reaction in model.reactions(state))
    assert support_force == pytest.approx(weight, rel=0.05)


def _masses(model) -> list[float]:
    parts = [group.host.mass for group in model.groups] + ([model.coupled.host.mass[:, 2]] if model.coupled else [])
    return [float(mass.sum()) for mass in parts]


def test_clusters_of_the_subset_residual_test(device):
    """Every node is in one cluster of each size; area fractions of a sheet sum to one, limits follow their roots."""
    model = scene_of_many_nodes("sheet").build(device, "float64")
    host = model.coupled.host
    bodies = host.bodies
    assert bodies.count == 1
    inside = bodies.levels[0].items
    assert sorted(inside) == list(range(41**2))
    assert [len(level.weight) for level in bodies.levels] == [-(-(41**2) // FAN**k) for k in range(1, 5)]
    # weight = sqrt(area fraction) of single nodes and of eight: squares sum to 1; of large clusters it is a tenth
    assert (bodies.levels[0].weight ** 2).sum() == pytest.approx(1.0)
    assert bodies.levels[-1].weight == pytest.approx([0.1])
    assert (bodies.limits(np.ones(1))[: host.nodes] ** 2).sum() == pytest.approx(1.0)
    assert bodies.loads(np.full(host.blocks, 2.0)) == pytest.approx([2.0 * host.blocks])


def test_load_scale_is_per_body(device):
    """A heavy rod of the same system does not loosen other bodies; unloaded bodies use the mean load at least."""
    scene = scene_of_many_nodes("net")
    points = np.linspace([0.0, 5.0, 0.0], [1.0, 5.0, 0.0], 81)
    heavy = scene.add_rod(points, section=ddg.Circle(0.1), material=RUBBER)
    second_heavy = scene.add_rod(points[-1] + points - points[0], section=ddg.Circle(0.1), material=RUBBER)
    scene.clamp(heavy, edges=[0])
    scene.join([(heavy, -1), (second_heavy, 0)])
    model = scene.build(device, "float64")
    bodies = model.coupled.host.bodies
    weight = [9.81 * 1000.0 * np.pi * radius**2 for radius in (0.01, 0.01, 0.01, 0.1, 0.1)]
    force = 9.81 * model.coupled.host.mass[:, 2] * (np.arange(model.coupled.host.blocks) < model.coupled.host.nodes)
    assert bodies.loads(force) == pytest.approx(weight, rel=0.02)
    force[model.coupled.host.rods[0].nodes] = 0.0
    mean = sum(bodies.loads(force)[1:3]) / 3
    assert bodies.loads(force)[0] == pytest.approx(mean, rel=0.02)


@pytest.mark.parametrize("twist", [True, False])
@pytest.mark.parametrize("joined", [False, True])
def test_load_scale_of_a_couple(device, joined, twist):
    """Couples count as |M| / L of the rod, uncoupled or joined, in coarse and fine meshes."""
    for nodes in (11, 81):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        section = ddg.Stiffness(EA=1e3, EI1=0.5, GJ=0.4, mass_per_length=0.6, rotary_inertia=0.01)
        rod = scene.add_rod(np.linspace((0, 0, 0), (2.0, 0, 0), nodes), section=section, twist=twist)
        scene.add_couple(rod, nodes // 2, (0.1, -0.3, 0.2))
        if joined:
            second = scene.add_rod(np.linspace((-1.0, 0, 0), (0, 0, 0), 5), section=section, twist=twist)
            scene.join([(rod, 0), (second, -1)], rigid=False)
        model = scene.build(device, "float64")
        if joined:
            load = outer_forces(model.coupled.host, np.zeros(3)).sum()
        else:
            load = model.groups[0].outer.numpy()[0]
        assert load == pytest.approx(0.6 / 2.0)


def test_rtol_says_what_it_is_compared_with():
    assert "tolerance" in NewtonOptions.__doc__ and "tolerance" in StaticsOptions.__doc__
