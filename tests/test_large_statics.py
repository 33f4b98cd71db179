"""Equilibria by conjugate gradients on the device: agreement with factors, repeats, worlds, failures, choice by size."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.simulate import simulate
from ddg_warp.scenes import gridshell_dome
from ddg_warp.solve.equilibrium.continuation import Continuation
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions, solve
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.linear import solver_selection

RUBBER = ddg.Material(young=1e7, poisson=0.3, density=1000.0)
THICKNESS = 0.01  # m
STRETCHING = 1e5 / (1.0 - 0.3**2)  # E h / (1 - nu^2) [N/m]


def sheet(cells: int, gravity: float = 0.0, **options):
    """Return a square of 1 m, its points, and masks of vertices at the ends of x and y (2, V, 2)."""
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity), **options)
    scene.add_shell(points, triangles, thickness=THICKNESS, material=RUBBER, bending="midedge_dof")
    return scene, points, np.stack([points == points.min(0), points == points.max(0)])[..., :2]


def plate(cells: int, pressure: float = 2e3):
    """Return a plate clamped all around; 2 kPa deflect it by eight thicknesses."""
    scene, _, ends = sheet(cells)
    scene.clamp_boundary(0, np.flatnonzero(ends.any((0, 2))))
    scene.add_pressure(0, pressure)
    return scene


def hanging(cells: int, analysis=None):
    """Return a sheet pinned at the corners, under its weight."""
    scene, _, ends = sheet(cells, gravity=9.81, **({"analysis": analysis} if analysis else {}))
    scene.hold(0, np.flatnonzero(ends.any(0).all(1)))
    return scene


def moved(cells: int, motion: ddg.Motion):
    """Return a heavy sheet with one fixed side and one clamped side in motion."""
    scene, _, ends = sheet(cells, gravity=9.81)
    scene.hold(0, np.flatnonzero(ends[0, :, 0]))
    scene.clamp_boundary(0, np.flatnonzero(ends[1, :, 0]), "xyz", motion)
    return scene


def wrung(cells: int):
    """Return a sheet stretched, lifted and rotated at one side."""
    motion = ddg.Motion(lambda t: (0.05 * t, 0.0, 0.1 * t), lambda t: 0.4 * t, (1.0, 0.0, 0.0), (0.0, 0.5, 0.0))
    return moved(cells, motion)


def compressed(cells: int):
    """Return a sheet with an approaching and rising side: it buckles and has several stable equilibria."""
    return moved(cells, ddg.Motion(lambda t: (-0.2 * t, 0.0, 0.1 * t)))


def stiffened(cells: int):
    """Return a clamped plate with a rod along the middle, which a couple bends."""
    scene, points, ends = sheet(cells)
    scene.clamp_boundary(0, np.flatnonzero(ends.any((0, 2))))
    scene.add_pressure(0, 500.0, dead=True)
    spine = np.flatnonzero(points[:, 1] == np.sort(np.unique(points[:, 1]))[cells // 2])
    spine = spine[np.argsort(points[spine, 0])]
    rod = scene.add_rod(points[spine], section=ddg.Circle(0.015), material=RUBBER)
    scene.attach(rod, range(len(spine)), 0, spine)
    scene.add_couple(rod, cells // 4, (0.0, 0.2, 0.0))
    return scene


SCENES = {
    "plate": (plate, 10, 32),
    "hanging": (hanging, 10, 32),
    "wrung": (wrung, 10, 32),
    "stiffened": (stiffened, 8, 32),
    "dome": (lambda rods: gridshell_dome.build(rods=rods, load=1e4), 3, 9),
}
CASES = [(name, size) for name, (_, size, _) in SCENES.items()]
CASES += [pytest.param(name, size, marks=pytest.mark.slow) for name, (_, _, size) in SCENES.items()]


@pytest.mark.parametrize(("name", "size"), CASES)
def test_same_equilibrium(device, name, size):
    """PCG and direct solves find one equilibrium, to the tolerance; 32 cells are 2,048 triangles."""
    model = SCENES[name][0](size).build(device, "float64")
    start = model.state()
    searches = [Equilibrium(model, StaticsOptions(solver=solver)) for solver in ("pcg", "direct")]
    points, expected = (search.load(start, 2).points() for search in searches)
    moved = np.abs(expected - start.points()).max()
    assert moved > 1e-3
    assert np.abs(points - expected).max() < 1e-6 * moved
    assert searches[0].pcg_iterations > 0 == searches[1].pcg_iterations
    assert searches[0].outcome in ("converged", "converged_to_rounding")


@pytest.mark.parametrize("build", [plate, compressed])
def test_converged_is_balanced_and_stable(device, build):
    """The residual of every free dof, by host forces, is below rtol times the load scale; moments times a length."""
    model = build(8).build(device, "float64")
    search = Equilibrium(model, StaticsOptions(solver="pcg", rtol=1e-9))
    state = search.load(model.state(), 2)
    assert search.outcome == "converged"
    assert spectrum(model, state).negative == 0
    tangent = search.tangent
    outer, gradient = tangent.loads(1.0, tangent.dofs(state)), tangent.gradient(state)
    residual = np.abs(outer - gradient)[tangent.free]
    limit = 1e-9 * search.residuals.allowed(search.residuals.load_scale(outer, gradient))
    assert (residual <= limit[tangent.free]).all()


def test_supports_carry_the_weight(device):
    """Reactions of the corners sum to the weight, rho h g over 1 m^2."""
    model = hanging(10).build(device, "float64")
    reactions = model.reactions(solve(model, load_steps=2, solver="pcg"))
    weight = RUBBER.density * THICKNESS * 9.81
    assert sum(reaction.force[2] for reaction in reactions) == pytest.approx(weight, rel=1e-7)


def test_pressure_follows_and_does_its_work(device):
    """Device forces equal host forces; the work of a step is that of the mean end force, (f0 + f1) . u / 2."""
    model = plate(6).build(device, "float64")
    search, tangent = Equilibrium(model, StaticsOptions(solver="pcg")), Tangent(model)
    q0, random = tangent.dofs(model.state()), np.random.default_rng(1)
    q0 = q0 + 0.02 * random.normal(size=q0.shape)
    q1 = q0 + 0.02 * random.normal(size=q0.shape)
    solver = search.coupled.newton
    solver.begin(q1, tangent.parts[-1].dead_loads(0.7), 0.7, np.ones(1))
    solver.iterates.base.assign(q0.reshape(-1, 3))
    solver.balance()  # no element is evaluated, so internal forces are zero
    first, second = tangent.loads(0.7, q0), tangent.loads(0.7, q1)
    expected = np.where(tangent.free, second, 0.0)
    np.testing.assert_allclose(solver.system.rhs.numpy().ravel(), expected, atol=1e-12 * np.abs(second).max())
    work = 0.5 * (first + second) @ (q1 - q0)
    assert abs(work) > 0.1
    assert solver.norms.change.numpy().sum() == pytest.approx(-work, rel=1e-12)


def test_repeats_bitwise(device):
    model = compressed(8).build(device, "float64")
    runs = [solve(model, load_steps=2, solver="pcg").snapshot() for _ in range(2)]
    for name, values in runs[0].items():
        np.testing.assert_array_equal(values, runs[1][name], err_msg=name)


def test_worlds_and_changed_parameters(device):
    """Worlds of different stiffness find separate equilibria, also when captured data change."""
    names = ("shell_stretch", "stiffness")
    single = plate(6).build(device, "float64")
    together = plate(6).build(device, "float64", worlds=2)
    searches = [Equilibrium(model, StaticsOptions(solver="pcg")) for model in (single, together)]
    searches[1].load(together.state(), 1)
    stiffness = np.array([1.0, 3.0]) * STRETCHING
    together.set_parameter(*names, stiffness)
    points = searches[1].load(together.state(), 1).points()
    for world in range(2):
        single.set_parameter(*names, stiffness[world])
        expected = searches[0].load(single.state(), 1).points()
        np.testing.assert_allclose(points[world], expected, atol=1e-9)
    assert np.abs(points[0] - points[1]).max() > 1e-4


def test_failure_is_named(device):
    """Too few iterations for any increment: the error has the outcome, the position and the last good state."""
    model = plate(6).build(device, "float64")
    with pytest.raises(ddg.SolverError, match=r"max_iterations, largest residual .* of shell 0") as caught:
        solve(model, solver="pcg", max_iterations=2, max_cuts=2)
    assert caught.value.outcome == "max_iterations"
    assert np.isfinite(caught.value.state.points()).all()


def test_options_that_need_factors_are_refused(device):
    with pytest.raises(ddg.SceneError, match="'follow' passes limit points by the inertia"):
        StaticsOptions(solver="pcg", mode="follow")
    with pytest.raises(ddg.SceneError, match="it is 'auto', 'direct' or 'pcg'"):
        StaticsOptions(solver="cholesky")
    scene = ddg.Scene()
    rod = scene.add_rod(np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5), section=ddg.Circle(0.01), material=RUBBER)
    scene.clamp_end(rod)
    with pytest.raises(ddg.SceneError, match="uncoupled rods"):
        solve(scene.build(device, "float64"), solver="pcg")


def test_choice_by_size(device, monkeypatch):
    """Small coupled systems take factors, large ones conjugate gradients; counting instabilities always takes factors."""
    scene = hanging(6, ddg.Statics(load_steps=2))
    model = scene.build(device, "float64")
    assert solver_selection.static_solver(model) == "direct"
    assert simulate(scene, device=device, progress=False).statistics["pcg_iterations"] == 0
    monkeypatch.setattr(solver_selection, "LARGE_STATIC", {False: 10, True: 10})
    assert solver_selection.static_solver(model) == "pcg"
    result = simulate(scene, device=device, precision="float64", progress=False)
    assert result.statistics["pcg_iterations"] > 0
    assert sum(result.statistics["outcomes"].values()) == 2
    assert Equilibrium(model, StaticsOptions(mode="follow")).coupled is None
    assert Continuation(model, {}).corrector.equilibrium.coupled is None
