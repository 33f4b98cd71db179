"""Steps of coupled systems: edge rotations, frame updates and frozen Hessians as for uncoupled rods."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.compile.coupled.rod_ordering import rod_order
from ddg_warp.geometry import meshes
from ddg_warp.kernels.newton.rod_iterate import UPDATE_FRAMES
from ddg_warp.solve.newton.coupled_newton import CoupledNewton, NewtonOptions

RUBBER = ddg.Material(young=1e7, poisson=0.5, density=1000.0)
WIRE = ddg.Material(young=1e9, poisson=0.5, density=1000.0)


def line(start, end, nodes: int) -> np.ndarray:
    return np.linspace(start, end, nodes)


def cantilever(joined: bool, radius: float, material, natural="straight", points=None) -> ddg.Scene:
    """Return a rod with a clamped first edge; `joined` hinges its first node to a clamped stub."""
    scene = ddg.Scene(gravity=(0.0, -2.9, -9.81))
    points = line((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 32) if points is None else points
    options = {"section": ddg.Circle(radius), "material": material}
    rod = scene.add_rod(points, natural=natural, **options)
    scene.clamp(rod, edges=[0])
    if joined:
        back = points[0] - points[1]
        stub = scene.add_rod(points[0] + back * np.arange(3)[::-1, None], **options)
        scene.clamp(stub, edges=[0, 1])
        scene.join([(rod, 0), (stub, -1)], rigid=False)
    return scene


def curl() -> np.ndarray:
    t = np.linspace(0.0, 1.0, 32)
    return np.stack([0.1 * np.cos(6.0 * t) - 0.1, 0.1 * np.sin(6.0 * t), 0.1 * t], -1)


def advance(scene, device, dt, count, velocities=None, **options):
    """Return points after a number of steps, and the integrator's statistics."""
    model = scene.build(device, "float64")
    integrator, state = ddg.Integrator(model, **options), model.state(velocities=velocities)
    for _ in range(count):
        state = integrator.step(state, dt)
    return state.points(), integrator.statistics()


@pytest.mark.parametrize(
    ("radius", "material", "points", "dt", "count"),
    [
        (2e-3, RUBBER, None, 0.3, 6),  # straight updates take 15.8 iterations instead of 7.7
        (5e-4, WIRE, None, 0.1, 10),  # 27 instead of 11
        (1e-4, WIRE, curl(), 1.0 / 60.0, 20),
    ],
    ids=["rubber", "wire", "curl"],
)
def test_joined_rods_rotate_edges_as_uncoupled_rods(device, radius, material, points, dt, count):
    """Long steps of stiff, thin rods: equal motion in about as many iterations, without retries."""
    natural = "straight" if points is None else "shape"
    (uncoupled, uncoupled_counts), (is_coupled, coupled_counts) = (
        advance(cantilever(is_coupled, radius, material, natural, points), device, dt, count)
        for is_coupled in (False, True)
    )
    np.testing.assert_allclose(is_coupled[:32], uncoupled, atol=1e-7)
    assert np.abs(uncoupled - cantilever(False, radius, material, natural, points).batches[0].points[0]).max() > 0.1
    assert uncoupled_counts["retries"] == coupled_counts["retries"] == 0
    assert coupled_counts["newton_iterations"]["mean"] < 1.25 * uncoupled_counts["newton_iterations"]["mean"]


def test_joined_rods_converge_as_uncoupled_rods(device):
    """Exact elimination gives the same iterates up to rounding, whatever else the island contains."""
    (uncoupled, uncoupled_counts), (is_coupled, coupled_counts) = (
        advance(cantilever(is_coupled, 2e-3, RUBBER), device, 1.0 / 60.0, 20, rtol=1e-8) for is_coupled in (False, True)
    )
    # the stub adds a little weight to the load scale of the island: one step in twenty may end one iteration sooner
    assert (
        uncoupled_counts["newton_iterations"]["mean"] - 0.051
        < coupled_counts["newton_iterations"]["mean"]
        <= uncoupled_counts["newton_iterations"]["mean"]
    )
    assert 0 <= uncoupled_counts["newton_iterations"]["max"] - coupled_counts["newton_iterations"]["max"] <= 1
    np.testing.assert_allclose(is_coupled[:32], uncoupled, atol=1e-11)


def whip(joined: bool) -> ddg.Scene:
    return cantilever(joined, 2e-3, RUBBER)


def test_predictors_rotate_edges(device):
    """A rod that swings by 0.4 rad a step is predicted unstretched: the coupled system takes hardly more iterations."""
    rates = np.zeros((35, 3))
    rates[:32, 2] = 40.0 * np.linspace(0.0, 1.0, 32)
    (uncoupled, uncoupled_counts), (is_coupled, coupled_counts) = (
        advance(whip(is_coupled), device, 0.01, 3, rates[: 35 if is_coupled else 32]) for is_coupled in (False, True)
    )
    np.testing.assert_allclose(is_coupled[:32], uncoupled, atol=1e-6)
    assert coupled_counts["newton_iterations"]["mean"] <= 1.25 * uncoupled_counts["newton_iterations"]["mean"]


def tree() -> ddg.Scene:
    """Return rods of both orientations joined rigidly and by hinges at angles, twisted and curved at rest."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    options = {"section": ddg.Rectangle(6e-3, 4e-3), "material": RUBBER, "natural": (1.0, 0.5, 2.0)}
    trunk = scene.add_rod(line((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), 7), **options)
    one = scene.add_rod(line((0.5, 0.0, 0.0), (0.8, 0.3, 0.1), 5), **options)
    two = scene.add_rod(line((0.8, -0.2, 0.2), (0.5, 0.0, 0.0), 6), **options)
    three = scene.add_rod(line((0.8, 0.3, 0.1), (1.0, 0.3, 0.4), 4), **options)
    scene.join([(trunk, -1), (one, 0), (two, -1)], rigid=True)
    scene.join([(one, -1), (three, 0)], rigid=False)
    scene.clamp_end(trunk)
    return scene


@pytest.mark.parametrize("rotation", [0.3, 2.0])
def test_frame_update_keeps_strains(device, rotation):
    """Edges and joints rotate far within a solve: strains stay, and other worlds keep their frames.

    Lagged tangents then equal tangents of the iterate, up to rounding.
    """
    model = tree().build(device, "float64", worlds=2)
    coupled, state = model.coupled, model.coupled.rest()
    newton = CoupledNewton(model, NewtonOptions())
    random = np.random.default_rng(3)
    q = np.array(state.q.numpy().reshape(2, -1, 3), float)
    nodes, spins = coupled.host.nodes, coupled.host.spins
    # rotated about an axis by an angle that grows along x, with random twist angles and joint rotations
    angle = rotation * q[:, :nodes, :1]
    y, z = q[:, :nodes, 1:2] + 0.2, q[:, :nodes, 2:3]
    q[:, :nodes, 1:] = np.concatenate(
        [np.cos(angle) * y - np.sin(angle) * z, np.sin(angle) * y + np.cos(angle) * z], -1
    )
    q[:, nodes : -spins or None, 0] += random.normal(size=q[:, nodes : -spins or None, 0].shape)
    q[:, -spins:] = 0.3 * rotation * random.normal(size=(2, spins, 3))
    newton.iterates.q.assign(q.reshape(-1, 3))

    def energies():
        strains = []
        for i, element_set in enumerate(coupled.sets):
            strain = wp.zeros(
                (len(element_set.term.measure.strains), 2 * element_set.elements),
                dtype=coupled.real,
                device=coupled.device,
            )
            state.q.assign(newton.iterates.q)
            coupled.strains(state, i, strain)
            strains.append(strain.numpy())
        return np.concatenate([values.ravel() for values in strains])

    before, frames = energies(), state.frame.numpy().copy()
    actions = wp.array([UPDATE_FRAMES, 0], dtype=int, device=coupled.device)
    coupled.renew(state, newton.iterates.q, actions)
    after = energies()
    assert np.abs(before).max() > 1.0
    np.testing.assert_allclose(after, before, atol=1e-10 * np.abs(before).max())
    edges = coupled.edges
    np.testing.assert_array_equal(state.frame.numpy()[:, edges:], frames[:, edges:])
    first, second = coupled.host.ends.T
    tangent = q[0, second] - q[0, first]
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    np.testing.assert_allclose(state.frame.numpy()[3:, :edges].T, tangent, atol=1e-12)
    assert np.abs(frames[3:, :edges].T - tangent).max() > 0.1


def spun(joined: bool, rate: float) -> ddg.Scene:
    """Return an L-shaped rod with a root that rotates by some revolutions a second."""
    corner = np.array(
        [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2], [0.1, 0.0, 0.25], [0.2, 0.0, 0.25], [0.3, 0.0, 0.25]]
    )
    scene = cantilever(joined, 2e-2, RUBBER, "shape", corner)
    scene.supports.clear()
    motion = ddg.Motion(angle=lambda t: 2.0 * np.pi * rate * t, axis=(0.6, 0.0, 0.8))
    scene.clamp(0, edges=[0], motion=motion)
    if joined:
        scene.clamp(1, edges=[0, 1], motion=motion)
    return scene


def test_whipped_rods_move_as_uncoupled_rods(device):
    """Edges reverse within steps, which are halved.

    Measured: without frame updates the joined rod is off by 0.09 m.
    """
    s = np.linspace(0.0, 1.0, 32)
    rates = np.zeros((35, 3))
    rates[:32, 1:] = np.stack([50.0 * s, 60.0 * s**3 * np.sin(20.0 * s)], -1)
    (uncoupled, uncoupled_counts), (is_coupled, coupled_counts) = (
        advance(whip(is_coupled), device, 0.02, 5, rates[: 35 if is_coupled else 32]) for is_coupled in (False, True)
    )
    np.testing.assert_allclose(is_coupled[:32], uncoupled, atol=1e-6)
    assert coupled_counts["retries"] <= uncoupled_counts["retries"]


def test_joined_rods_rotate_by_more_than_a_right_angle_a_step(device):
    """Frames are updated within solves of 120 degrees a step: edges follow, and twist is kept."""
    (uncoupled, uncoupled_counts), (is_coupled, coupled_counts) = (
        advance(spun(is_coupled, 1.0 / 3.0), device, 1.0, 3) for is_coupled in (False, True)
    )
    np.testing.assert_allclose(is_coupled[:6], uncoupled, atol=1e-6)
    assert uncoupled_counts["retries"] == coupled_counts["retries"]


def frame() -> ddg.Scene:
    """Return a portal frame of rigid joints under a lateral force."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    options = {"section": ddg.Circle(5e-3), "material": RUBBER}
    left = scene.add_rod(line((0.0, 0.0, 0.0), (0.0, 0.0, 0.3), 8), **options)
    top = scene.add_rod(line((0.0, 0.0, 0.3), (0.3, 0.0, 0.3), 8), **options)
    right = scene.add_rod(line((0.3, 0.0, 0.0), (0.3, 0.0, 0.3), 8), **options)
    scene.join([(left, -1), (top, 0)], rigid=True)
    scene.join([(right, -1), (top, -1)], rigid=True)
    scene.clamp_end([left, right])
    scene.add_force(top, 4, (0.05, 0.02, 0.0))
    return scene


def sheet() -> ddg.Scene:
    points, triangles = meshes.rectangle(5, 5, (1.0, 1.0), "alternating")
    scene = ddg.Scene()
    scene.add_shell(points, triangles, thickness=1e-2, material=ddg.Material(1e6, 0.3, 1000.0))
    scene.hold(0, [0, 5])
    return scene


@pytest.mark.parametrize("linear", ["auto", "block_jacobi"])
@pytest.mark.parametrize("scene", [whip, frame, tree, sheet], ids=["stub", "frame", "tree", "sheet"])
def test_projective_converges_to_newtons_solution(device, scene, linear):
    """The frozen Hessian gives the same states in more iterations, since it converges linearly."""
    made = scene(True) if scene is whip else scene()
    options = {"rtol": 1e-9, "linear": linear}
    expected, newton = advance(made, device, 1.0 / 120.0, 10, **options)
    points, projective = advance(made, device, 1.0 / 120.0, 10, solver="projective", **options)
    np.testing.assert_allclose(points, expected, atol=1e-8)
    assert projective["retries"] == 0
    assert projective["newton_iterations"]["mean"] > newton["newton_iterations"]["mean"]


@pytest.mark.parametrize("scene", [frame, tree])
def test_exact_hessian_of_coupled_systems(device, scene):
    """psd 'none' gives the same states; without buckling it converges at least as fast as 'progressive'."""
    expected, progressive = advance(scene(), device, 1.0 / 120.0, 10, rtol=1e-9, psd="progressive")
    points, exact = advance(scene(), device, 1.0 / 120.0, 10, rtol=1e-9, psd="none")
    np.testing.assert_allclose(points, expected, atol=1e-8)
    assert exact["newton_iterations"]["mean"] <= progressive["newton_iterations"]["mean"]


def test_rod_order_visits_every_rod_once_from_the_supports():
    """A supported grid, a path hanging from it, and two free rods: levels, and anchored nodes of each rod."""
    grid = [np.array([0, 1, 2, 3]), np.array([4, 5, 6, 7]), np.array([8, 1, 5, 9]), np.array([10, 2, 6, 11])]
    hanging = [np.array([3, 12, 13]), np.array([14, 13])]
    free = [np.array([20, 21]), np.array([21, 22])]
    fixed = np.zeros(23, bool)
    fixed[[0, 4, 7, 8]] = True
    plan = rod_order([*grid, *hanging, *free], fixed)
    assert sorted(np.concatenate(plan.levels)) == list(range(8))
    level = {rod: i for i, rods in enumerate(plan.levels) for rod in rods}
    assert level[0] == level[1] == 0
    assert level[2] == level[3] == level[4] == 1
    assert level[5] == 2
    assert level[7] == level[6] + 1
    anchored = [set(plan.nodes[a:b][plan.anchored[a:b]]) for a, b in zip(plan.start, plan.start[1:], strict=False)]
    assert anchored == [{0}, {4, 7}, {8, 1, 5}, {2, 6}, {3}, {13}, set(), {21}]


@pytest.mark.parametrize("scene", [whip, frame, sheet], ids=["stub", "frame", "sheet"])
def test_report_states_the_linear_solver_of_a_coupled_system(device, scene):
    """The report states exact elimination; the memory of H is that of bands and of the remaining blocks."""
    model = (scene(True) if scene is whip else scene()).build(device, "float64")
    newton = ddg.Integrator(model)._coupled.newton
    lines = model.report()
    assert ("exact" in lines) == newton.exact
    bands = (
        3 * 16 * newton.substructuring.paths.longest * newton.substructuring.paths.columns
        if newton.substructuring
        else 0
    )
    assert f"{8 * (newton.system.matrix.size + bands) / 1e6:.3g} MB" in lines
    assert f"H: {newton.sparsity.entries} blocks" in lines
