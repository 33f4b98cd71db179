"""Single precision dominated by rounding: warning at build, named refusal, or named outcome if allowed."""

import warnings

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.compile.precision import FLOAT32_LIMIT, FLOAT32_LOST, lost_in_rounding, rounding
from ddg_warp.errors import SolverError
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.equilibrium.continuation import Continuation
from ddg_warp.solve.equilibrium.stability import spectrum

STEEL = ddg.Material(young=2e11, poisson=0.3, density=7800.0)
RUBBER = ddg.Material(young=1e6, poisson=0.4, density=1000.0)
pytestmark = pytest.mark.filterwarnings("ignore:.*precision 'float32' (leaves|rounding)")


def wire(scene, nodes=101):
    """Add a steel wire 1 m long and 2 mm thick, clamped at the first edge."""
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], nodes)
    scene.clamp(scene.add_rod(points, section=ddg.Circle(2e-3), material=STEEL, name="wire"), edges=[0])


def fine(scene):
    wire(scene, 401)


def joined(scene):
    points = np.linspace([0.0, 0.0, 0.0], [0.5, 0.0, 0.0], 51)
    first, second = (
        scene.add_rod(points + [x, 0.0, 0.0], section=ddg.Circle(2e-3), material=STEEL, name="half") for x in (0.0, 0.5)
    )
    scene.clamp(first, edges=[0])
    scene.join([(first, -1), (second, 0)])


def foil(scene, material=STEEL):
    """Add a steel foil of 0.05 mm, 1 m wide, fixed along one side."""
    points, triangles = meshes.rectangle(40, 40)
    shell = scene.add_shell(points, triangles, thickness=5e-5, material=material, bending="hinge", name="foil")
    scene.hold(shell, np.flatnonzero(points[:, 0] == points[:, 0].min()))


THINGS = {
    "rod": (wire, "rod 0 \\('wire'\\)"),
    "net": (joined, "rod . \\('half'\\)"),
    "shell": (foil, "shell 0 \\('foil'\\)"),
}
# The rod stands for all in daily tests: coupled systems and shells have separate kernels in each precision.
DAILY_THE_ROD = pytest.mark.parametrize(
    "name", ["rod", *(pytest.param(name, marks=pytest.mark.slow) for name in THINGS if name != "rod")]
)


def scene_of(build, dt=0.01, **options) -> ddg.Scene:
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81), analysis=ddg.Dynamics(dt=dt), **options)
    build(scene)
    return scene


def fall(model, dt: float, steps: int):
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    return state, integrator.statistics()["outcomes"]


@DAILY_THE_ROD
def test_motion_dominated_by_rounding_is_refused(device, name):
    """The error names object, outcome and remedies after a warning at build; other precisions and short steps pass."""
    build, where = THINGS[name]
    with pytest.warns(UserWarning, match=f"{where}: precision 'float32' leaves a relative error"):
        model = scene_of(build).build(device, "float32")
    with pytest.raises(
        SolverError, match=f"{where}.*over 0.01 s.*'mixed' or 'float64'.*lost_in_rounding.*allow_rounding"
    ) as caught:
        ddg.Integrator(model).step(model.state(), 0.01)
    assert caught.value.outcome == "lost_in_rounding"
    assert caught.value.state.points().shape == model.state().points().shape
    for precision in ("mixed", "float64"):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            fall(scene_of(build).build(device, precision), 0.01, 1)
    short = 0.01
    while rounding(model, short)[0] > 0.5 * FLOAT32_LIMIT:
        short *= 0.5
    state, outcomes = fall(model, short, 1)
    assert "lost_in_rounding" not in outcomes
    with pytest.raises(SolverError, match="lost_in_rounding"):
        integrator = ddg.Integrator(model)
        integrator.step(integrator.step(state, short), 0.01)


@DAILY_THE_ROD
def test_allowed_rounding_is_counted_by_its_name(device, name):
    """Allowed rounding has an outcome name distinct from convergence; on fine meshes the error exceeds that of mixed."""
    build, _ = THINGS[name]
    state, outcomes = fall(scene_of(build).build(device, "float32", allow_rounding=True), 0.01, 20)
    assert outcomes.get("lost_in_rounding", 0) > 0 == outcomes.get("converged_to_rounding", 0)
    assert np.isfinite(state.points()).all()
    if name == "rod":
        exact, state, mixed = (
            fall(scene_of(fine).build(device, precision, allow_rounding=True), 0.01, 5)[0]
            for precision in ("float64", "float32", "mixed")
        )
        moved = np.abs(exact.points() - exact.model.state().points()).max()
        assert np.abs(state.points() - exact.points()).max() > 1e-3 * moved
        assert np.abs(mixed.points() - exact.points()).max() < 1e-6 * moved


@pytest.mark.slow
def test_soft_objects_pass_without_warning(device):
    """Rubber rods and sheets have errors below the bound: no warning, and float64 motion up to that error."""
    for build in (wire_of_rubber, lambda scene: foil(scene, RUBBER)):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            model = scene_of(build, dt=0.005).build(device, "float32")
            state, outcomes = fall(model, 0.005, 10)
        exact, _ = fall(scene_of(build, dt=0.005).build(device, "float64"), 0.005, 10)
        moved = np.abs(exact.points() - model.state().points()).max()
        assert np.abs(state.points() - exact.points()).max() < FLOAT32_LIMIT * moved
        assert set(outcomes) <= {"converged", "converged_to_rounding"}


def wire_of_rubber(scene):
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 31)
    scene.clamp(scene.add_rod(points, section=ddg.Circle(0.02), material=RUBBER), edges=[0])


def strut(scene):
    """Add a strut clamped at one end and compressed by 1 % at the other, about twice the critical strain."""
    points = np.linspace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 101)
    rod = scene.add_rod(points, section=ddg.Circle(2e-3), material=STEEL, name="strut")
    scene.clamp(rod, edges=[0])
    scene.clamp(rod, edges=[-1], motion=ddg.Motion(translation=lambda t: (0.0, 0.0, -0.01 * t)))


def test_equilibria_dominated_by_rounding_are_refused(device):
    """Equilibria, paths and spectra are refused, also under prescribed displacements, where no load reveals it."""
    scene = scene_of(strut)
    scene.gravity = (0.0, 0.0, 0.0)
    model = scene.build(device, "float32")
    for solve in (
        lambda: statics.solve(model),
        lambda: Continuation(model, {}).trace(model.state()),
        lambda: spectrum(model, model.state()),
    ):
        with pytest.raises(SolverError, match=r"rod 0 \('strut'\).*at rest.*lost_in_rounding") as caught:
            solve()
        assert caught.value.outcome == "lost_in_rounding"
    assert lost_in_rounding(scene.build(device, "float32", allow_rounding=True))


def test_rounding_bound_of_a_wire(device):
    """Half a rounding unit times EA / l over m / s^2 + EI l (pi / L)^4, l = L / n; m = rho A l averaged over n + 1 nodes."""
    model = scene_of(wire).build(device, "float32", allow_rounding=True)
    n, r, s = 100, 2e-3, 0.01
    stiff = 2e11 * np.pi * r**2 * n
    soft = 7800.0 * np.pi * r**2 / (n + 1) / s**2 + 2e11 * np.pi * r**4 / 4.0 / n * np.pi**4
    assert rounding(model, s)[0] == pytest.approx(2.0**-24 * stiff / soft, rel=1e-6)
    assert rounding(model, s)[0] > FLOAT32_LOST > FLOAT32_LIMIT


def test_changed_solver_drops_compression(device):
    """A column buckles in one long step, after a short step in float32: the new solver acts as if used from the start."""
    results = {}
    for precision in ("mixed", "float64"):
        scene = ddg.Scene(gravity=(0.0, 0.0, -1e-3))
        points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 12)
        section = ddg.Stiffness(EA=1e6, EI1=1.0, GJ=1.0, mass_per_length=1e-6, rotary_inertia=1e-9)
        rod = scene.add_rod(points, section=section)
        scene.clamp_end(rod)
        scene.add_force(rod, -1, (-50.0, 0.0, 0.0))  # twenty times Euler's load
        integrator = ddg.Integrator(scene.build(device, precision), psd="gauss_newton")
        bent = points * [0.9999, 1.0, 1.0] + [0.0, 0.0, 1e-4] * np.arange(12)[:, None] ** 2
        state = integrator.step(integrator.model.state(points=bent), 1e-7)
        assert integrator.statistics()["linear"] == ["float32" if precision == "mixed" else "float64"]
        state = integrator.step(state, 1.0)
        statistics = integrator.statistics()
        assert statistics["linear"] == ["float32 with tensions" if precision == "mixed" else "float64"]
        assert set(statistics["outcomes"]) <= {"converged", "converged_to_rounding"}
        assert integrator._rod_steps[0].newton.islands.drop_compression.numpy().tolist() == [1]
        results[precision] = statistics["newton_iterations"]["max"], np.abs(state.points()[-1])
    assert results["mixed"][0] <= 1.5 * results["float64"][0]
    np.testing.assert_allclose(results["mixed"][1], results["float64"][1], atol=1e-6)


def loaded(device, precision: str, size: float, joined: bool):
    """Return relative points of a soft cantilever of `size` metres, 50 steps after a tip load, and the integrator.

    Load, radius and steps make all sizes and precisions move alike.
    """
    section, material = ddg.Circle(0.01 * size), ddg.Material(1e6, density=1000.0)
    stiffness = section.stiffness(material)
    points = np.linspace([0.0, 0.0, 0.0], [size, 0.0, 0.0], 21)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    parts = (points[:11], points[10:]) if joined else (points,)
    rods = [scene.add_rod(part, section=section, material=material) for part in parts]
    if joined:
        scene.join([(rods[0], -1), (rods[1], 0)])
    scene.clamp_end(rods[0])
    scene.add_force(rods[-1], -1, (0.0, 0.0, -2.0 * stiffness.EI1 / size**2))
    period = size**2 * np.sqrt(stiffness.mass_per_length / stiffness.EI1)
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model), model.state()
    for _ in range(50):
        state = integrator.step(state, 0.05 * period)
    return state.points() / size, integrator


@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
def test_single_precision_converges_to_its_rounding(device, joined):
    """Rounding of stretch is 40 % of the load, but does not affect bending: iterations end without a warning when nothing moves."""
    exact, _ = loaded(device, "float64", 1.0, joined)
    for size in (1.0, 1e-6, 1e5):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", message=".*precision 'float32' leaves")
            points, integrator = loaded(device, "float32", size, joined)
        np.testing.assert_allclose(points, exact, atol=2e-5)
        assert set(integrator.statistics()["outcomes"]) <= {"converged", "converged_to_rounding"}


def test_rounding_warning_is_given_once(device):
    """Rounding moves the nodes of a fine steel wire in every iteration, with residuals above 1e-4 of the weight."""
    model = scene_of(fine).build(device, "float32", allow_rounding=True)
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        integrator, state = ddg.Integrator(model, check_every=1), model.state()
        for _ in range(5):
            state = integrator.step(state, 0.01)
    messages = [str(each.message) for each in messages if "rounding has ended steps" in str(each.message)]
    assert len(messages) == 1
    assert "rod 0 ('wire')" in messages[0]
