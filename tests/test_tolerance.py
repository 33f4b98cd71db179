"""A tolerance means the same error in position however many rods share a net and however fine a sheet is.

And nothing that is out of balance at the start has converged there: a smooth residual is small at every node of a fine mesh.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.compile.tolerance import FAN, outer_forces
from ddg_warp.geometry import meshes
from ddg_warp.solve.chains.newton import NewtonOptions
from ddg_warp.solve.statics import Equilibrium, StaticsOptions

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import bench_rods
import bench_tolerance as bench

RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
FACTOR = 3.0


def errors(study: bench.Study, device, rtol: float, steps: int) -> list[float]:
    return [row["error"] for row in bench.rows_of(study, wp.get_device(device), (rtol,), steps)]


@pytest.mark.parametrize("rtol", [1e-4, 1e-6])
def test_rods_alone_and_in_a_net(device, rtol):
    """One rod, and 1 and 100 in one net; the error is far above rounding and no larger than rtol's share of the fall."""
    steps = 10
    found = errors(bench.Study("rods", lambda n: bench.rods(n, False), (1,)), device, rtol, steps)
    found += errors(bench.Study("rods in a net", lambda n: bench.rods(n, True), (1, 100)), device, rtol, steps)
    assert max(found) <= FACTOR * min(found)
    fall = 0.5 * 9.81 * (steps * bench.DT) ** 2
    assert 1e-12 < max(found) < 10.0 * rtol * fall


@pytest.mark.parametrize("nodes", [121, pytest.param(961, marks=pytest.mark.slow)])
@pytest.mark.parametrize("island", [False, True], ids=["alone", "island"])
def test_long_rods_of_many_nodes(device, island, nodes):
    """Rods of 1 cm edges that have fallen for 64 steps are off by less than rtol of their length, and by less the less it is."""
    case = bench_rods.Case(
        "", 3, nodes, length=0.01 * (nodes - 1), precision="mixed", island=island, blocks=1, block=54
    )
    on, found = wp.get_device(device), {}
    for rtol in (8e-7, 1e-8):
        found[rtol] = bench_rods.run(replace(case, rtol=rtol), on)[1]
    alone = replace(case, rods=1, island=False, solver="sweep", precision="float64", rtol=bench_rods.EXACT_RTOL)
    exact = bench_rods.run(alone, on)[1]
    fall = np.ptp(exact[..., 2])
    assert fall > 0.2
    for rtol, points in found.items():
        assert np.linalg.norm(points - exact, axis=2).max() < rtol * case.length


@pytest.mark.parametrize(
    ("sizes", "steps"), [((6, 12, 24), 12), pytest.param((32, 64, 128), 20, marks=pytest.mark.slow)]
)
def test_sheets_of_any_fineness(device, sizes, steps):
    """Errors follow rtol, not the size of a cell: in the mean of their logarithms, as a last iterate lies anywhere below its limit."""
    fall = 0.5 * 9.81 * (steps * bench.DT) ** 2
    rtols = np.array([1e-5, 1e-6, 1e-7])
    found = np.array([errors(bench.Study("sheet", bench.sheet, sizes), device, rtol, steps) for rtol in rtols])
    mean = np.exp(np.log(found / rtols[:, None]).mean(0))
    assert mean.max() <= FACTOR * mean.min(), found
    assert (found > 1e-12).all() and (found < 10.0 * fall * rtols[:, None]).all()
    assert (found[2] < 0.1 * found[0]).all()


def dropped(kind: str) -> ddg.Scene:
    """Things of so many nodes that the weight of one is less than `rtol` of the whole, at rest in the air but for a support."""
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
    [("rods", solver) for solver in ("sweep", "partitioned", "chain", "projective")]
    + [("net", "auto"), ("sheet", "auto")],
)
def test_no_start_out_of_balance_has_converged(device, kind, solver):
    """Free fall from rest, s = g h^2 in a step of implicit Euler, with a tolerance above the share of a node."""
    options = {"solver": solver} if solver == "projective" else {"linear": solver}
    model = dropped(kind).build(device, "float64")
    integrator, dt = ddg.Integrator(model, rtol=0.02, **options), 1e-3
    start = model.state()
    state = integrator.step(start, dt)
    fallen = (start.points() - state.points())[:, 2]
    assert np.median(fallen) == pytest.approx(9.81 * dt**2, rel=0.05)
    assert integrator.statistics()["newton_iterations"]["mean"] >= 1.0


@pytest.mark.parametrize(
    ("kind", "solver"), [("rods", "direct"), ("net", "direct"), pytest.param("sheet", "pcg", marks=pytest.mark.slow)]
)
def test_no_load_is_overlooked_at_rest(device, kind, solver):
    """A loose tolerance does not leave a hanging thing unloaded: its supports carry its weight to 2 %, m g in the sum."""
    scene = dropped(kind)
    if kind == "sheet":
        scene.hold(0, np.arange(41))  # along one side
    model = scene.build(device, "float64")
    search = Equilibrium(model, StaticsOptions(solver=solver, rtol=0.02))
    state = search.load(model.state(), 4)
    assert search.iterations > 0
    weight = 9.81 * (RUBBER.density * 1e-3 if kind == "sheet" else sum(_masses(model)))
    carried = sum(reaction.force[2] for reaction in model.reactions(state))
    assert carried == pytest.approx(weight, rel=0.05)


def _masses(model) -> list[float]:
    parts = [group.host.mass for group in model.groups] + ([model.net.host.mass[:, 2]] if model.net else [])
    return [float(mass.sum()) for mass in parts]


def test_parts_of_a_net(device):
    """Every node is in one part of each size; shares of a sheet add up to one, limits go with their roots."""
    model = dropped("sheet").build(device, "float64")
    host = model.net.host
    bodies = host.bodies
    assert bodies.count == 1
    inside = bodies.levels[0].items
    assert sorted(inside) == list(range(41**2))
    assert [len(level.weight) for level in bodies.levels] == [-(-(41**2) // FAN**k) for k in range(1, 5)]
    # weight = sqrt(area share) of single nodes and of eight: squares add up to 1; of large parts it is a tenth
    assert (bodies.levels[0].weight ** 2).sum() == pytest.approx(1.0)
    assert bodies.levels[-1].weight == pytest.approx([0.1])
    assert (bodies.limits(np.ones(1))[: host.nodes] ** 2).sum() == pytest.approx(1.0)
    assert bodies.loads(np.full(host.blocks, 2.0)) == pytest.approx([2.0 * host.blocks])


def test_a_body_is_judged_by_its_own_load(device):
    """The weight of a heavy rod of the same net excuses nothing; what hangs on others is compared with their mean at least."""
    scene = dropped("net")
    points = np.linspace([0.0, 5.0, 0.0], [1.0, 5.0, 0.0], 81)
    heavy = scene.add_rod(points, section=ddg.Circle(0.1), material=RUBBER)
    other = scene.add_rod(points[-1] + points - points[0], section=ddg.Circle(0.1), material=RUBBER)
    scene.clamp(heavy, edges=[0])
    scene.join([(heavy, -1), (other, 0)])
    model = scene.build(device, "float64")
    bodies = model.net.host.bodies
    weight = [9.81 * 1000.0 * np.pi * radius**2 for radius in (0.01, 0.01, 0.01, 0.1, 0.1)]
    force = 9.81 * model.net.host.mass[:, 2] * (np.arange(model.net.host.blocks) < model.net.host.nodes)
    assert bodies.loads(force) == pytest.approx(weight, rel=0.02)
    force[model.net.host.rods[0].nodes] = 0.0
    mean = sum(bodies.loads(force)[1:3]) / 3
    assert bodies.loads(force)[0] == pytest.approx(mean, rel=0.02)


@pytest.mark.parametrize("twist", [True, False])
@pytest.mark.parametrize("joined", [False, True])
def test_a_couple_counts_as_a_force_over_the_rod(device, joined, twist):
    """|M| / L of the rod, alone or joined, in a coarse mesh or a fine one."""
    for nodes in (11, 81):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        section = ddg.Stiffness(EA=1e3, EI1=0.5, GJ=0.4, mass_per_length=0.6, rotary_inertia=0.01)
        rod = scene.add_rod(np.linspace((0, 0, 0), (2.0, 0, 0), nodes), section=section, twist=twist)
        scene.add_couple(rod, nodes // 2, (0.1, -0.3, 0.2))
        if joined:
            other = scene.add_rod(np.linspace((-1.0, 0, 0), (0, 0, 0), 5), section=section, twist=twist)
            scene.join([(rod, 0), (other, -1)], rigid=False)
        model = scene.build(device, "float64")
        if joined:
            found = outer_forces(model.net.host, np.zeros(3)).sum()
        else:
            found = model.groups[0].outer.numpy()[0]
        assert found == pytest.approx(0.6 / 2.0)


def test_rtol_says_what_it_is_compared_with():
    assert "tolerance" in NewtonOptions.__doc__ and "tolerance" in StaticsOptions.__doc__
