"""Equilibria: modes, load stepping, failures with the last good state, and the spectrum of the tangent."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import linalg

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.simulate import simulate
from ddg_warp.run.summary import summary
from ddg_warp.solve.equilibrium import stability
from ddg_warp.solve.equilibrium.continuation import Continuation, Displacement, StopCriterion
from ddg_warp.solve.equilibrium.dynamic_relaxation import relax
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions, solve
from ddg_warp.solve.equilibrium.tangent import Tangent

SECTION = ddg.Stiffness(EA=1e4, EI1=1.0, EI2=1.5, GJ=0.8, mass_per_length=0.5, rotary_inertia=1e-3)


def straight(nodes: int, axis: int = 0) -> np.ndarray:
    points = np.zeros((nodes, 3))
    points[:, axis] = np.linspace(0.0, 1.0, nodes)
    return points


def column(device, load: float):
    """Return a clamped planar column of EI = L = 1 under an axial load; it buckles at pi^2 / 4 = 2.467."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    rod = scene.add_rod(straight(31, 2), section=ddg.Stiffness(EA=1e5, EI1=1.0, mass_per_length=1.0))
    scene.clamp_end(rod)
    scene.add_force(rod, -1, (0.0, 0.0, -load))
    return scene.build(device, "float64")


def cantilever(device, nodes: int = 31, gravity: float = 9.81, **options):
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity))
    rod = scene.add_rod(straight(nodes), section=SECTION, **options)
    scene.clamp_end(rod)
    return scene.build(device, "float64")


def residual(model, state) -> float:
    """Return the largest residual of a free dof [N]."""
    tangent = Tangent(model)
    return np.abs((tangent.loads(1.0, tangent.dofs(state)) - tangent.gradient(state))[tangent.free]).max()


# Elastica at P / P_cr = 1.2: the tip of the buckled column is at about 0.69 L.
def test_follow_finds_the_saddle_and_minimise_the_minimum(device):
    """A slightly bent column at 1.2 times the critical load is the start of both modes."""
    model = column(device, 1.2 * np.pi**2 / 4.0)
    bent = straight(31, 2)
    bent[:, 0] = 1e-3 * bent[:, 2] ** 2
    start = model.state(points=bent)
    straight_state = Equilibrium(model, StaticsOptions(mode="follow")).load(start, 1, 1.0, 1.0)
    buckled = Equilibrium(model, StaticsOptions(mode="minimise")).load(start, 1, 1.0, 1.0)
    for state in (straight_state, buckled):
        assert residual(model, state) < 1e-6
    assert np.abs(straight_state.points()[:, 0]).max() < 1e-6
    assert spectrum(model, straight_state).negative == 1
    assert abs(buckled.points()[-1, 0]) > 0.3
    assert spectrum(model, buckled).stable
    tip = model.energies(buckled)["planar_bend"]
    work = 1.2 * np.pi**2 / 4.0 * (1.0 - buckled.points()[-1, 2])
    assert tip < work  # total energy below that of the straight column


# Straight clamped column of EI = L = 1 under 2 P_cr and 10 P_cr = 24.7; critical loads below are P_cr and 9 P_cr =
# 22.2.
@pytest.mark.parametrize(("factor", "negative"), [(2.0, 1), (10.0, 2)])
def test_minimise_leaves_a_saddle(device, factor, negative):
    """A solve that symmetry leads to the straight column continues to the buckled one; mode "follow" keeps the saddle."""
    model = column(device, factor * np.pi**2 / 4.0)
    saddle, buckled = solve(model, mode="follow"), solve(model)
    assert np.abs(saddle.points()[:, 0]).max() == 0.0
    assert saddle.stable is False
    assert spectrum(model, saddle).negative == negative
    assert buckled.stable is True
    assert spectrum(model, buckled).stable
    assert np.abs(buckled.points()[:, 0]).max() > 0.4
    assert residual(model, buckled) < 1e-6
    np.testing.assert_array_equal(solve(model).points(), buckled.points())
    in_steps = solve(model, load_steps=5)
    np.testing.assert_allclose(np.abs(in_steps.points()), np.abs(buckled.points()), atol=1e-6)


def test_minimise_leaves_a_saddle_of_a_compressed_plate(device):
    """The mixed Newton of a shell sees the tangent at rest alone: a strip at 2 P_cr."""
    points, triangles = meshes.rectangle(10, 2, (1.0, 0.1))
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    strip = scene.add_shell(points, triangles, thickness=0.01, material=ddg.Material(young=1e9, poisson=0.0))
    scene.clamp_boundary(strip, np.flatnonzero(points[:, 0] < 1e-9))
    tip = np.flatnonzero(points[:, 0] > 1.0 - 1e-9)
    bending = 1e9 * 0.1 * 0.01**3 / 12.0
    scene.add_vertex_force(strip, tip, (-2.0 * np.pi**2 / 4.0 * bending / len(tip), 0.0, 0.0))
    model = scene.build(device, "float64")
    saddle, buckled = solve(model, mode="follow"), solve(model)
    assert (saddle.stable, buckled.stable) == (False, True)
    assert np.abs(saddle.points()[:, 2]).max() == 0.0
    assert np.abs(buckled.points()[:, 2]).max() > 0.5
    by_gradients = solve(model, solver="pcg")
    assert by_gradients.stable in (False, None)  # PCG does not prove that the strip is stable
    assert model.state().stable is None


def test_stability_belongs_to_a_state(device):
    """Copies keep stability, states assigned from another have none; loads without a potential leave it undetermined."""
    model = column(device, 1.0)
    state = solve(model)
    assert state.stable is True
    assert state.copy().stable is True
    assigned = model.state()
    assigned.assign(state)
    assert assigned.stable is None
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(straight(11), section=SECTION)
    scene.clamp_end(rod)
    scene.add_couple(rod, -1, (0.3, 1.0, 0.2))
    assert solve(scene.build(device, "float64"), load_steps=2).stable is None


@pytest.mark.parametrize(("mode", "stable"), [("minimise", True), ("follow", False)])
def test_the_summary_of_a_run_says_whether_its_end_is_stable(device, mode, stable):
    scene = column(device, 2.0 * np.pi**2 / 4.0).scene
    scene.analysis = ddg.Statics(load_steps=1)
    result = simulate(scene, device=device, precision="float64", options={"mode": mode}, progress=False)
    assert summary("column", {}, result, [])["stable"] is stable


def test_free_spin_is_no_instability(device):
    """A rod between two hinges spins freely and is stable for either sign of that zero eigenvalue."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    section = ddg.Stiffness(EA=1e4, EI1=1.0, GJ=0.8, mass_per_length=0.5, rotary_inertia=1e-3)
    rod = scene.add_rod(straight(21), section=section)
    scene.fix(rod, [0, -1])
    model = scene.build(device, "float64")
    assert spectrum(model, solve(model)).rigid == 1
    for mode in ("minimise", "follow"):
        assert solve(model, mode=mode).stable is True


def test_follow_passes_the_critical_load(device):
    """The exactly straight column loaded from zero stays an equilibrium, with one negative eigenvalue past the critical load."""
    model = column(device, 4.0)
    solver = Equilibrium(model, StaticsOptions(mode="follow"))
    state, before = model.state(), 0.0
    for load_factor, negative in ((0.5, 0), (0.6, 0), (0.65, 1), (1.0, 1)):
        state, before = solver.load(state, 2, before, load_factor), load_factor
        assert state.time == load_factor
        assert spectrum(model, state).negative == negative
    np.testing.assert_allclose(state.points()[-1], (0.0, 0.0, 1.0 - 4.0 / 1e5), atol=1e-9)


def test_increments_are_halved(device, monkeypatch):
    """Few iterations cannot take the whole load at once; halved increments reach the same equilibrium."""
    model = cantilever(device)
    tried, taken = [], []
    search = Equilibrium.solve

    def recorded(self, state, before, load_factor):
        tried.append((before, load_factor))
        result = search(self, state, before, load_factor)
        taken.append((before, load_factor))
        return result

    monkeypatch.setattr(Equilibrium, "solve", recorded)
    state = solve(model, max_iterations=4)
    assert tried[:2] == [(0.0, 1.0), (0.0, 0.5)]
    assert len(taken) > 1
    assert taken[0][0] == 0.0
    assert taken[-1][1] == 1.0
    assert all(a[1] == b[0] for a, b in pairwise(taken))  # without gaps
    np.testing.assert_allclose(state.points(), solve(model, load_steps=8).points(), atol=1e-8)


def test_increments_grow_again(device, monkeypatch):
    """One difficult load needs short increments, later ones grow again; the second half is one increment."""
    model, taken = cantilever(device), []

    def picky(self, state, before, load_factor):
        if before < 0.1 and load_factor - before > 0.01:
            raise ddg.SolverError("too far", state=state, outcome="max_iterations")
        taken.append(load_factor - before)
        return state

    monkeypatch.setattr(Equilibrium, "solve", picky)
    solve(model, load_steps=2)
    assert len(taken) < 40
    assert max(taken) > 0.3
    assert sum(taken) == pytest.approx(1.0)


def compressed_bow(device, distance: float, rotation: float = 0.0, dimension: int = 2):
    """Return a bow of 40 edges with a last end that is moved towards the first, and rotated, by the load parameter."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension)
    angle = np.linspace(-0.6, 0.6, 41)
    points = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle) - np.cos(0.6)], axis=1) / 1.2
    rod = scene.add_rod(points, section=SECTION)
    motion = ddg.Motion(
        translation=lambda t: (-distance * t, 0.0, 0.0),
        angle=lambda t: rotation * t,
        axis=(1.0, 0.3, 0.0) if dimension == 3 else (0.0, 1.0, 0.0),
        pivot=points[-1],
    )
    scene.clamp_end(rod, "first")
    scene.clamp_end(rod, "last", motion=motion) if rotation else scene.fix(rod, [-1], motion=motion)
    return scene.build(device, "float64")


# An edge is 0.025 long: moved alone, the last node would lie twelve edges below, and its edge would point backwards.
@pytest.mark.parametrize(("rotation", "dimension"), [(0.0, 2), (0.0, 3), (0.7, 3)], ids=["plane", "space", "turned"])
def test_large_support_increment_moves_the_whole_rod(device, rotation, dimension):
    """An increment of twelve edge lengths at a support is taken at once, to the state of small increments."""
    model = compressed_bow(device, 0.3, rotation, dimension)
    solver = Equilibrium(model)
    whole = solver.load(model.state(), 1)
    assert solver.iterations < 15  # 40, 337 and 42 if the supports move alone
    small = solve(model, load_steps=40)
    np.testing.assert_allclose(whole.points(), small.points(), atol=1e-7)
    if dimension == 3:
        np.testing.assert_allclose(whole.directors(), small.directors(), atol=1e-6)
    assert whole.points()[-1, 0] == pytest.approx(np.sin(0.6) / 1.2 - 0.3, abs=1e-12)
    assert whole.points()[20, 2] > model.state().points()[20, 2] + 0.05


def test_failure_keeps_the_last_good_state(device):
    """A load jumps by more than iterations and halvings allow: the error holds the state before the jump."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(straight(31), section=SECTION)
    scene.clamp_end(rod)
    scene.add_force(rod, -1, (0.0, 0.0, -1.0), amplitude=lambda t: t if t <= 0.5 else 500.0)
    model = scene.build(device, "float64")
    with pytest.raises(
        ddg.SolverError, match=r"max_iterations.*node \d+ of rod 0.*2 increments halved.*larger max_iterations"
    ) as caught:
        solve(model, load_steps=8, max_iterations=6, max_cuts=2)
    good = caught.value.state
    assert caught.value.outcome == "max_iterations"
    assert good.time == 0.5
    tangent = Tangent(model)
    residuals = tangent.loads(0.5, tangent.dofs(good)) - tangent.gradient(good)
    assert np.abs(residuals[tangent.free]).max() < 1e-7
    np.testing.assert_allclose(good.points(), solve(model, end=0.5).points(), atol=1e-8)
    assert good.points()[-1, 2] < -0.1


def test_failure_by_one_iteration(device):
    model = cantilever(device)
    with pytest.raises(ddg.SolverError, match="max_iterations") as caught:
        solve(model, max_iterations=1, max_cuts=2)
    np.testing.assert_array_equal(
        caught.value.state.points(), model.state().points()
    )  # the start is the only good state


@pytest.mark.parametrize("mode", ["minimise", "follow"])
def test_reaction_is_the_weight_and_the_start_is_kept(device, mode):
    model = cantilever(device)
    state = model.state()
    before = state.snapshot()
    equilibrium = solve(model, state, load_steps=4, mode=mode)
    for name, value in state.snapshot().items():
        np.testing.assert_array_equal(value, before[name])
    assert equilibrium.points()[-1, 2] < -0.3
    assert residual(model, equilibrium) < 1e-7
    (reaction,) = model.reactions(equilibrium)
    np.testing.assert_allclose(reaction.force, (0.0, 0.0, 0.5 * 9.81), atol=1e-7)
    again = solve(model, equilibrium, start=1.0, mode=mode)
    np.testing.assert_allclose(again.points(), equilibrium.points(), atol=1e-9)


@pytest.mark.parametrize("search", ["solve", "conjugate gradients", "trace", "relax"])
def test_a_viscous_structure_rests_in_equilibrium(device, search):
    """Take a first step from an equilibrium under gravity: strains do not change, so strain-rate damping gives no force.

    Without the strains of the equilibrium the damping force would be that of the whole deflection within one step.
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    rod = scene.add_rod(
        straight(9), section=ddg.Circle(0.01), material=ddg.Material(1e7, density=1000.0, viscosity=0.05)
    )
    scene.clamp(rod)
    if search == "conjugate gradients":  # of coupled systems
        scene.join([(rod, -1), (scene.add_rod(straight(5) + [1.0, 0.0, 0.0], section=SECTION), 0)])
    model = scene.build(device, "float64")
    if search == "trace":
        state = (
            Continuation(model, {"drop": Displacement.of(8, "z", -1.0)})
            .trace(stop=StopCriterion(steps=3))
            .points[-1]
            .state
        )
    elif search == "relax":
        state = relax(model)
    else:
        state = solve(model, load_steps=2, rtol=1e-10, solver="pcg" if search == "conjugate gradients" else "auto")
    expected = state.copy()
    model.update_strains(expected)
    for name, array in state.arrays().items():
        np.testing.assert_array_equal(array.numpy(), expected.arrays()[name].numpy(), name)
    if search != "trace":  # it ends at another load parameter
        after = ddg.Integrator(model).step(state, 0.01)
        deflection = np.abs(state.points() - model.state().points()).max()
        assert np.abs(after.points() - state.points()).max() < 1e-6 * deflection


# Every node in equilibrium: the horizontal force is constant, the vertical force grows by the weight of a node.
def test_hanging_chain_from_its_straight_rest_shape(device):
    """Springs without bending have no lateral stiffness at rest."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    rod = scene.add_rod(straight(21), section=ddg.Stiffness(EA=1e3, mass_per_length=2.0), bend=False)
    scene.fix(rod, [0, -1])
    model = scene.build(device, "float64")
    state = solve(model)
    edges = np.diff(state.points(), axis=0)
    lengths = np.linalg.norm(edges, axis=1, keepdims=True)
    force = 1e3 * (lengths / 0.05 - 1.0) * edges / lengths
    np.testing.assert_allclose(force[:, 0], force[0, 0], rtol=1e-7)
    np.testing.assert_allclose(np.diff(force[:, 2]), 0.1 * 9.81, rtol=1e-6)
    np.testing.assert_allclose(edges[:, 1], 0.0, atol=1e-9)
    assert state.points()[10, 2] < -0.05
    assert spectrum(model, state).stable


def test_hanging_chain_by_one_end(device):
    """Every edge carries the weight below, from a rest shape along the weight."""
    scene = ddg.Scene(gravity=(9.81, 0.0, 0.0))
    rod = scene.add_rod(straight(11), section=ddg.Stiffness(EA=1e3, mass_per_length=2.0), bend=False)
    scene.fix(rod, [0])
    state = solve(scene.build(device, "float64"))
    below = 0.2 * 9.81 * (np.arange(10, 0, -1) - 0.5)
    np.testing.assert_allclose(state.points()[1:, 0], np.cumsum(0.1 * (1.0 + below / 1e3)), rtol=1e-9)
    np.testing.assert_allclose(state.points()[:, 1:], 0.0, atol=1e-9)


def compressed_rod(device, nodes: int = 31, load: float = 60.0, slide: bool = False):
    """Return a clamped rod in space, straight under an axial load far above critical, and its equilibrium."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(straight(nodes), section=SECTION)
    scene.clamp_end(rod)
    if slide:
        scene.clamp_end(rod, "last", components="yz")
    scene.add_force(rod, -1, (-load, 0.0, 0.0))
    model = scene.build(device, "float64")
    return model, solve(model, mode="follow")


def dense(model, state):
    """Return tangent and mass of the free dofs, dense."""
    tangent = Tangent(model)
    free = np.flatnonzero(tangent.free)
    return tangent.hessian(state).toarray()[np.ix_(free, free)], tangent.mass[free], tangent


@pytest.mark.parametrize("metric", ["mass", "unit"])
def test_inertia_is_the_count_of_negative_eigenvalues(device, monkeypatch, metric):
    """Dense and sparse counts equal the eigenvalues of the dense tangent; by Sylvester's law the metric is irrelevant."""
    model, state = compressed_rod(device)
    matrix, mass, tangent = dense(model, state)
    values = np.linalg.eigvalsh(matrix)
    # Clamped-free: P_k = (2 k - 1)^2 pi^2 EI / 4 L^2: below 60 lie 2.47, 22.2 (EI 1), 3.7, 33.3 (EI 1.5).
    assert (values < 0.0).sum() == 4
    weights = mass if metric == "mass" else np.where(tangent.angle[tangent.free], tangent.edge_length() ** 2, 1.0)
    exact = linalg.eigh(matrix, np.diag(weights), eigvals_only=True)
    spectra = {}
    for name, limit in (("dense", 10**6), ("sparse", 1)):
        monkeypatch.setattr(stability, "DENSE", limit)
        spectra[name] = spectrum(model, state, 6, metric)
        assert spectra[name].negative == 4
        assert not spectra[name].stable
        np.testing.assert_allclose(spectra[name].eigenvalues, exact[:6], rtol=1e-6)
        modes = spectra[name].modes
        assert (modes[~tangent.free] == 0.0).all()
        overlap = modes[tangent.free].T @ (weights[:, None] * modes[tangent.free])
        np.testing.assert_allclose(overlap, np.eye(6), atol=1e-6)
    np.testing.assert_allclose(spectra["sparse"].eigenvalues, spectra["dense"].eigenvalues, rtol=1e-6)
    same = np.abs(np.sum(spectra["sparse"].modes * spectra["dense"].modes * tangent.mass[:, None], 0))
    if metric == "mass":
        np.testing.assert_allclose(same, 1.0, atol=1e-5)


@pytest.mark.parametrize("limit", [1, 10**6], ids=["sparse", "dense"])
def test_massless_ghost_nodes_are_condensed(device, monkeypatch, limit):
    """The ghost node of a sliding clamp is a free massless dof, which follows in equilibrium."""
    monkeypatch.setattr(stability, "DENSE", limit)
    model, state = compressed_rod(device, load=5.0, slide=True)
    matrix, mass, _ = dense(model, state)
    massless = mass == 0.0
    assert massless.any()
    a, b, c = (matrix[np.ix_(i, j)] for i, j in ((~massless, ~massless), (~massless, massless), (massless, massless)))
    exact = linalg.eigh(a - b @ np.linalg.solve(c, b.T), np.diag(mass[~massless]), eigvals_only=True)
    modes = spectrum(model, state, 5)
    np.testing.assert_allclose(modes.eigenvalues, exact[:5], rtol=1e-6)
    np.testing.assert_allclose(modes.frequencies**2, modes.eigenvalues)
    assert modes.stable


def test_lowest_frequency_of_a_cantilever(device):
    """1.8751^2 sqrt(EI / (rho A L^4)), EI = 1: the first eigenvalue is a squared frequency."""
    model = cantilever(device, 61)
    modes = spectrum(model, model.state(), 2)
    assert modes.frequencies[0] == pytest.approx(1.87510407**2 / np.sqrt(0.5), rel=1e-3)
    assert modes.frequencies[1] == pytest.approx(1.87510407**2 * np.sqrt(1.5 / 0.5), rel=1e-3)


def test_frequencies_need_masses(device):
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_rod(np.eye(3), section=ddg.Stiffness(EA=1.0, EI1=1.0, GJ=1.0))
    scene.clamp(0, edges=[0])
    model = scene.build(device, "float64")
    with pytest.raises(ddg.SceneError, match="metric='unit'"):
        spectrum(model, model.state())
    assert spectrum(model, model.state(), metric="unit").eigenvalues[0] > 0.0


def test_unsymmetric_spectrum(device, monkeypatch):
    """A couple about a fixed axis has no potential; iterated eigenvalues agree with the dense matrix."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), analysis=ddg.Statics(load_steps=2))
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 21)
    section = ddg.Stiffness(EA=1e4, EI1=1.0, EI2=1.5, GJ=0.8, mass_per_length=1.0, rotary_inertia=0.01)
    rod = scene.add_rod(points, section=section)
    scene.clamp(rod, edges=[0])
    scene.add_couple(rod, -1, (0.3, 1.0, 0.2))
    model = scene.build(device, "float64")
    state = solve(model, load_steps=2)
    dense_modes = spectrum(model, state, 6)
    monkeypatch.setattr(stability, "DENSE", 10)
    sparse_modes = spectrum(model, state, 6)
    assert dense_modes.stable
    assert sparse_modes.negative == 0
    np.testing.assert_allclose(sparse_modes.eigenvalues, dense_modes.eigenvalues, rtol=1e-7)
    without = spectrum(model, state, 6, load=0.0)
    assert np.abs(without.eigenvalues / dense_modes.eigenvalues - 1.0).max() > 1e-3


def test_a_hinged_rod_is_pulled_straight(device):
    """A hinge permits rotation: the equilibrium lies along the load, longer by F L / EA."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(straight(5), section=ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0))
    scene.fix(rod, [0])
    scene.add_force(rod, -1, (0.0, 1.0, 0.0))
    state = solve(scene.build(device, "float64"))
    np.testing.assert_allclose(state.points()[-1], (0.0, 1.0 + 1.0 / 1e3, 0.0), atol=1e-8)


def test_spectrum_of_free_rods(device):
    """A free rod has no equilibrium under weight, but six rigid-body modes and a spin."""
    scene = ddg.Scene()
    for nodes in (7, 5):
        scene.add_rod(straight(nodes), section=SECTION)
    model = scene.build(device, "float64")
    assert spectrum(model, model.state(), 14).eigenvalues[:12] == pytest.approx(np.zeros(12), abs=1e-6)
