"""Mixed axial-force formulation of direct solvers: directions equal the plain ones; float32 errors are independent of EA."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.scenes import hair as curled
from ddg_warp.solve.linear import solver_selection
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.newton.rod_newton_parallel import RodNewtonParallel
from ddg_warp.solve.stepping.rod_step import DIRECT

KINDS = {"twist": {}, "untwisted": {"twist": False}, "planar": {"dimension": 2}}
EVERY_KIND = pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "twist" else pytest.mark.slow) for name in KINDS]
)
EVERY_SOLVER = pytest.mark.parametrize("solver", list(DIRECT))


def rods(name: str, axial: float, supports: str = "many", natural: str = "straight") -> ddg.Scene:
    """Build rough rods.

    `supports`: "many" (ends, middle and single axes), "root" (a clamp each) or "none".
    """
    options = {"dimension": 3} | KINDS[name]
    dimension = options.pop("dimension")
    across = 1.0 if dimension == 3 else 0.0
    random, scene = np.random.default_rng(5), ddg.Scene(gravity=(0.3, -0.5 * across, -2.0), dimension=dimension)
    section = ddg.Stiffness(EA=axial, EI1=0.6, GJ=0.5, mass_per_length=0.7, **({"EI2": 0.9} if name == "twist" else {}))
    for nodes in (3, 4, 17, 40):
        points = np.cumsum(np.array([1.0, 0.0, 0.2]) + 0.2 * random.normal(size=(nodes, 3)), axis=0)
        points[:, 1] *= across
        rod = scene.add_rod(points, section=section, natural=natural, **options)
        if supports != "none":
            scene.clamp(rod, edges=[0])
        if supports == "many" and nodes > 3:
            scene.fix(rod, [nodes - 2], components="z")
            if nodes > 16:
                scene.fix(rod, [11])
    return scene


def directions(
    scene: ddg.Scene,
    device,
    linear,
    carried: float | None,
    psd: str = "gauss_newton",
    kept: bool = False,
    solver: str = "sweep",
) -> list:
    """Return (first Newton direction (dofs, nodes, rods), edges, node counts) of every rod group, from a rough iterate.

    `kept`: edges of the iterate have their rest lengths, from the first node on.
    """
    random, results = np.random.default_rng(11), []
    model = scene.build(device, "float64")
    for group, state in zip(model.groups, model.state().groups, strict=True):
        newton = DIRECT[solver](model, group, NewtonOptions(psd=psd), linear, mixed_axial=carried is not None)
        x = device_arrays.download(state.x)
        rounding_error = 1e-3 * random.normal(size=x.shape)
        mask = (device_arrays.download(group.fixed)[..., None] >> np.arange(group.kind.dim)) & 1
        iterate = x + rounding_error * (mask == 0)
        if kept:
            edges = np.diff(iterate, axis=0)
            size = np.linalg.norm(np.diff(x, axis=0), axis=-1, keepdims=True)
            edges *= size / np.maximum(np.linalg.norm(edges, axis=-1, keepdims=True), 1e-300)
            iterate[1:] = iterate[0] + np.cumsum(edges, axis=0)
        device_arrays.assign(newton.iterates.x, iterate)
        device_arrays.assign(newton.iterates.target, x)
        if group.kind.twist:
            wp.copy(newton.iterates.frame, state.frame)
        newton.islands.inertia_coefficient.fill_(2.0 if psd == "gauss_newton" else 100.0)
        newton.islands.inverse_step.fill_(1.0)
        if carried is not None:
            newton.islands.max_edge_stiffness.fill_(carried)
        edges = np.diff(device_arrays.download(newton.iterates.x), axis=0)
        for _ in range(2):  # a second one for rods with an indefinite matrix under compression
            newton.iterate(state.last)
            if newton.islands.iteration.numpy().all():
                break
        inside = np.arange(group.nodes)[:, None] < group.host.count
        results.append((device_arrays.download(newton.direction).astype(float) * inside, edges, group.host.count))
    return results


def error(direction: np.ndarray, exact: np.ndarray) -> float:
    """Return the largest error of a rod, relative to its largest displacement."""
    return float((np.abs(direction - exact).max((0, 1)) / np.abs(exact).max((0, 1))).max())


@EVERY_KIND
@pytest.mark.parametrize("supports", ["many", "none"])
@pytest.mark.parametrize(
    ("psd", "solver"),
    [
        ("gauss_newton", "sweep"),
        ("gauss_newton", "cyclic_reduction"),
        pytest.param("none", "sweep", marks=pytest.mark.slow),  # refused by cyclic reduction
    ],
)
def test_directions_match_full_matrix(device, name, supports, psd, solver):
    """H + r^T r / s is the Schur complement of [H r^T; r -s], for any fraction of axial stiffness kept in H."""
    scene = rods(
        name, 9.0, supports, "shape" if psd == "none" and name != "untwisted" else "straight"
    )  # near the rest shape the exact Hessian is definite
    exact = directions(scene, device, wp.float64, None, psd)
    for carried in (1e-3, 1.0, 5.0, 1e3):  # axial stiffness is about 9: the last leaves no mixed edge
        for (mixed, edges, count), (expected, *_) in zip(
            directions(scene, device, wp.float64, carried, psd, solver=solver), exact, strict=True
        ):
            assert error(mixed[:-1], expected) < 1e-9
            dim = edges.shape[2]
            steps = np.diff(np.moveaxis(mixed[:dim], 0, -1), axis=0)
            along = np.sum(edges * steps, -1) / np.linalg.norm(edges, axis=-1)
            inside = np.arange(len(along))[:, None] < count - 1
            # lengthening of edges, the last row
            np.testing.assert_allclose(mixed[-1, :-1][inside], along[inside], rtol=0, atol=1e-9 * np.abs(steps).max())


@EVERY_SOLVER
def test_float32_error_is_independent_of_axial_stiffness(device, solver):
    """Errors of mixed directions do not grow with EA; without mixed tensions they grow in proportion."""
    errors = {True: [], False: []}
    for axial in (1e2, 1e4, 1e6, 1e8):
        scene = rods("twist", axial, "root")
        exact = directions(scene, device, wp.float64, None, kept=True)
        for mixed_axial, error_list in errors.items():
            inexact = directions(scene, device, wp.float32, 1e2 if mixed_axial else None, kept=True, solver=solver)
            error_list.append(max(error(a[: b.shape[0]], b) for (a, *_), (b, *_) in zip(inexact, exact, strict=True)))
    assert max(errors[True]) < 1e-3
    assert errors[False][-1] > 1e2 * errors[True][-1]


def mixed_wavy_rod(nodes: int, axial: float, device) -> RodNewtonParallel:
    """Return a mixed solver by cyclic reduction after one iteration, of a wavy rod of 1 m fixed at ends and inner nodes."""
    along = np.linspace(0.0, 1.0, nodes)
    points = np.stack([along, 0.05 * np.sin(20.0 * along), 0.05 * np.cos(14.0 * along)], axis=1)
    scene = ddg.Scene()
    section = ddg.Stiffness(EA=axial, EI1=1.0, EI2=1.2, GJ=0.7, mass_per_length=1.0, rotary_inertia=1e-4)
    rod = scene.add_rod(points, section=section)
    scene.clamp(rod, edges=[0, nodes - 2])
    scene.fix(rod, [30, 101, 103])
    scene.fix(rod, [72], components="y")
    model = scene.build(device, "mixed")
    group, state = model.groups[0], model.state().groups[0]
    newton = RodNewtonParallel(model, group, NewtonOptions(), mixed_axial=True)
    for array in (newton.iterates.x, newton.iterates.target):
        wp.copy(array, state.x)
    wp.copy(newton.iterates.frame, state.frame)
    newton.islands.inertia_coefficient.fill_(2.5e5)
    newton.islands.inverse_step.fill_(500.0)
    newton.islands.max_edge_stiffness.fill_(2e5)
    newton.iterate(state.last)
    assert (newton.islands.lost_pivots_total.numpy() == 0).all()
    return newton


def dense(newton: RodNewtonParallel) -> tuple[np.ndarray, np.ndarray]:
    """Solve [H r^T, r -s] in float64 from the same blocks, rows and slacks; return (nodes, dofs) and lengthenings."""
    kind, n = newton.group.kind, newton.group.nodes
    nb = kind.block
    blocks = device_arrays.download(newton.blocks)[..., 0].astype(float).reshape(3, nb, nb, n)
    factor = device_arrays.download(newton.elements.factor)[..., 0].astype(float)
    fixed = (device_arrays.download(newton.group.fixed)[:, :1] >> np.arange(nb)) & 1
    slack, H, rows = factor[-1, :-1], np.zeros((n, nb, n, nb)), np.zeros((n - 1, n, nb))
    for k in range(n):
        for offset in range(min(3, n - k)):
            H[k, :, k + offset] = blocks[offset, ..., k]
            H[k + offset, :, k] = blocks[offset, ..., k].T
    first = kind.vertex_strains * kind.window
    for k in range(n - 1):
        rows[k, k, : kind.dim] = -factor[first : first + kind.dim, k]
        rows[k, k + 1, : kind.dim] = factor[first : first + kind.dim, k]
    rows *= fixed == 0
    H, rows = H.reshape(n * nb, n * nb), rows.reshape(n - 1, n * nb)
    rhs = np.concatenate([device_arrays.download(newton.rhs)[..., 0].astype(float).T.ravel(), np.zeros(n - 1)])
    solution = np.linalg.solve(np.block([[H, rows.T], [rows, -np.diag(slack)]]), rhs)
    return solution[: n * nb].reshape(n, nb), slack * solution[n * nb :] / np.sqrt(
        newton.islands.max_edge_stiffness.numpy()[0]
    )


@pytest.mark.parametrize("axial", [1e4, 1e6, 1e8, 1e10, 1e12])  # EA L^2 / EI
def test_cyclic_reduction_matches_dense_solve(device, axial):
    """Float32 with 150 nodes, one in 15 at or next to a support: within a thousandth at any EA."""
    newton = mixed_wavy_rod(150, axial, device)
    direction = device_arrays.download(newton.direction)[..., 0].T
    expected, longer = dense(newton)
    np.testing.assert_allclose(direction[:, :-1], expected, rtol=0, atol=1e-3 * np.abs(expected).max())
    np.testing.assert_allclose(direction[:-1, -1], longer, rtol=0, atol=1e-3 * np.abs(longer).max())


def hair(nodes: int) -> ddg.Scene:
    """Build four curled hairs of 40 um on shaken roots."""
    return curled.build(strands=4, nodes=nodes)


def advance(scene: ddg.Scene, device, precision: str, dt: float, steps: int, **options):
    """Return the points after some steps, and the statistics."""
    model = scene.build(device, precision)
    integrator, state = ddg.Integrator(model, **options), model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    integrator.check(state)
    return state.points(), integrator.statistics()


@pytest.mark.parametrize(
    ("nodes", "dt", "scheme"),
    [
        (32, 1.0 / 240.0, "implicit_euler"),
        (32, 1.0 / 60.0, "implicit_euler"),
        pytest.param(64, 1.0 / 60.0, "implicit_euler", marks=pytest.mark.slow),
        pytest.param(128, 1.0 / 60.0, "implicit_euler", marks=pytest.mark.slow),
        pytest.param(32, 1.0 / 120.0, "implicit_midpoint", marks=pytest.mark.slow),
    ],
)
@EVERY_SOLVER
def test_hair_matches_float64(device, nodes, dt, scheme, solver):
    """Within 1e-6 m of float64 at rtol 1e-10, in as many iterations, and without retries."""
    steps = round(0.25 / dt)
    options = {"scheme": scheme, "linear": solver} | ({"energy_bound": None} if scheme == "implicit_midpoint" else {})
    exact, tight = advance(hair(nodes), device, "float64", dt, steps, rtol=1e-10, **options)
    usual, plain = advance(hair(nodes), device, "float64", dt, steps, **options)
    points, mixed = advance(hair(nodes), device, "mixed", dt, steps, **options)
    assert tight["linear"] == ["float64"]
    assert mixed["linear"] == ["float32 with tensions"]
    assert np.abs(points - exact).max() < max(1e-6, 2.0 * np.abs(usual - exact).max())
    assert mixed["newton_iterations"]["mean"] < 1.1 * plain["newton_iterations"]["mean"]
    assert mixed["newton_iterations"]["max"] <= 10
    assert mixed["retries"] == 0


@pytest.mark.slow
def test_long_cable_matches_float64(device):
    """A steel cable of 10 m and 640 nodes swings between clamps; plain float32 cannot resolve its stretching."""
    runs = {}
    for precision in ("float64", "mixed"):
        scene = ddg.Scene(gravity=(0.0, -3.0, -9.81))
        points = np.linspace([0.0, 0.0, 0.0], [9.0, 0.0, 0.0], 640)
        points[:, 2] = -2.0 * np.sin(np.pi * points[:, 0] / 9.0)
        rod = scene.add_rod(
            points, section=ddg.Circle(1e-3), material=ddg.Material(young=2e11, poisson=0.3, density=7800.0)
        )
        scene.clamp(rod, edges=[0, 638])
        runs[precision] = advance(scene, device, precision, 1.0 / 240.0, 60, linear="cyclic_reduction")
    (exact, one), (x, two) = runs["float64"], runs["mixed"]
    assert two["linear"] == ["float32 with tensions"]
    assert np.abs(exact - points).max() > 0.05
    assert np.abs(x - exact).max() < 1e-6
    assert two["newton_iterations"]["mean"] < 1.1 * one["newton_iterations"]["mean"]
    assert one["retries"] == two["retries"] == 0


def test_bending_beyond_float32_is_solved_in_float64(device):
    """Steel of 256 edges at 0.1 s: bending of a node between its neighbours is too stiff for float32, too."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    points = np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 257)
    rod = scene.add_rod(
        points, section=ddg.Circle(2e-3), material=ddg.Material(young=2e11, poisson=0.3, density=7800.0)
    )
    scene.clamp(rod)
    _, statistics = advance(scene, device, "mixed", 0.1, 2)
    assert statistics["linear"] == ["float64"]


def test_report_names_linear_algebra_of_steps(device, monkeypatch):
    """The report names float32, float32 with tensions or float64 for the steps of the scene's analysis."""
    prefix = "over steps of 0.0166667 s: edge-rotation update, exact Hessian"
    for solver, reduced in (("block LDL^T sweep", False), ("cyclic reduction", True)):
        monkeypatch.setattr(solver_selection, "long_and_few", lambda *_arguments, reduced=reduced: reduced)
        for precision, linear in (("mixed", ", linear algebra in float32 with tensions"), ("float64", "")):
            report = hair(32).build(device, precision).report()
            assert prefix + linear + "\n" in report
            assert f"solver: {solver}" in report
    soft = ddg.Scene(analysis=ddg.Dynamics(dt=1.0 / 240.0, duration=1.0))
    rod = soft.add_rod(
        np.linspace([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], 32), section=ddg.Circle(2e-3), material=ddg.Material(1e7)
    )
    soft.clamp(rod)
    assert "over steps" not in soft.build(device, "mixed").report()
