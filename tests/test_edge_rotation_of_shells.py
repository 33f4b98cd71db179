"""Rotating clamps of shells in statics and dynamics, past full revolutions, and support reactions."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scene.equilibrium_path import StopCriterion
from ddg_warp.solve.equilibrium.continuation import Continuation
from ddg_warp.solve.equilibrium.statics import solve
from ddg_warp.solve.equilibrium.tangent import Tangent

SCHEMES = ("implicit_euler", "implicit_midpoint")
RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
TURNED = pytest.mark.parametrize("model", ["midedge_dof", "midedge", "hinge", "curved"])
AXIS, PIVOT = (1.0, 2.0, 0.5), (0.1, 0.2, 0.3)


def strip(cells, size, bending="midedge_dof", thickness=0.01, material=RUBBER, **options) -> ddg.Scene:
    """Return a flat sheet in the xy plane; `bending` "curved" is the curved membrane."""
    points, triangles = meshes.rectangle(*cells, size, "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), **options)
    curved = {"membrane": "curved"} if bending == "curved" else {"bending": bending}
    scene.add_shell(points, triangles, thickness=thickness, material=material, **curved)
    return scene


def end(scene, extreme="min", axis=0) -> np.ndarray:
    along = scene.shells[0].points[:, axis]
    return np.flatnonzero(along == getattr(along, extreme)())


def steps(model, count, dt, scheme="implicit_euler", state=None, **options):
    integrator = ddg.Integrator(model, scheme, **options)
    state = model.state() if state is None else state
    for _ in range(count):
        state = integrator.step(state, dt)
    return state


def elastic(model, state) -> float:
    return sum(value for name, value in model.energies(state).items() if name not in ("kinetic", "gravity"))


def normals(state) -> np.ndarray:
    """Return the prescribed normals of rotating clamps (n, 3), as elements read them."""
    parts_of_data = []
    for index, data in state.coupled.data.items():
        element, row, _ = state.model.coupled.sets[index].turning.T
        parts_of_data.append(data.numpy()[row[:, None] + np.arange(3), element[:, None]])
    return np.concatenate(parts_of_data)


@pytest.mark.parametrize(
    "model",
    ["hinge", *(pytest.param(model, marks=pytest.mark.slow) for model in ("midedge_dof", "midedge", "curved"))],
)
def test_clamp_rotates_a_sheet_by_three_revolutions(device, model):
    """Statics move vertices and normals rigidly with the clamp, without energy."""
    scene = strip((3, 2), (1.0, 0.6), model)
    motion = ddg.Motion(lambda t: (t, 0.0, -t), lambda t: 6.0 * np.pi * t + 0.4 * t, AXIS, PIVOT)
    scene.clamp_boundary(0, end(scene), motion=motion)
    built = scene.build(device, "float64")
    state = solve(built, load_steps=40)
    np.testing.assert_allclose(state.points(), motion.place(1.0, scene.shells[0].points), atol=1e-8)
    assert elastic(built, state) < 1e-15
    normal = motion.rotation(0.4) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(normals(state), np.tile(normal, (len(normals(state)), 1)), atol=1e-12)


def test_sheet_without_free_vertices_follows_its_motion(device):
    scene = strip((2, 2), (1.0, 1.0))
    motion = ddg.Motion(angle=lambda t: 7.0 * t, axis=AXIS, pivot=PIVOT)
    scene.clamp_boundary(0, range(9), motion=motion)
    built = scene.build(device, "float64")
    for state in (solve(built), steps(built, 1, 1.0)):
        np.testing.assert_allclose(state.points(), motion.place(1.0, scene.shells[0].points), atol=1e-14)
        assert elastic(built, state) < 1e-20


@pytest.mark.parametrize("model", ["midedge_dof", "hinge"])
def test_a_spinning_sheet_stretches(device, model):
    """A sheet clamped on the axis spins at a constant rate: N' = -rho h w^2 r, so it grows by rho w^2 L^3 / (3 E).

    nu = 0; n cells with half the mass at either end grow by 1 + 1 / (2 n^2) times that. Implicit Euler lags by the
    angle a of a step: its acceleration is (2 sin(a / 2) / h)^2 r, rotated by a.
    """
    rate, length, cells, step_angle = 1.5, 1.0, 4, 0.05
    material = ddg.Material(1e6, 0.0, 1000.0, viscosity=0.02)
    scene = strip((cells, 1), (length, 0.4), model, thickness=0.1, material=material)
    points = scene.shells[0].points
    pivot = np.array([points[:, 0].min(), points[:, 1].mean(), 0.0])
    motion = ddg.Motion(angle=lambda t: rate * t, pivot=tuple(pivot))
    scene.clamp_boundary(0, end(scene), motion=motion)
    built = scene.build(device, "float64")
    start = built.state(velocities=np.cross([0.0, 0.0, rate], points - pivot))
    state = steps(built, int(6.5 * np.pi / step_angle), step_angle / rate, state=start, rtol=1e-7)
    rotation = rate * state.time
    assert rotation > 6.0 * np.pi
    corotated = (state.points() - motion.place(state.time, points)) @ motion.rotation(rotation)
    euler = (2.0 * np.sin(0.5 * step_angle) / step_angle) ** 2 * np.cos(step_angle)
    expected = 1000.0 * rate**2 * length**3 / (3.0 * 1e6) * (1.0 + 0.5 / cells**2) * euler
    assert corotated[end(scene, "max"), 0].mean() == pytest.approx(expected, rel=2e-3)
    assert np.abs(corotated[:, 2]).max() < 1e-9


def twisted(device, angle, length=1.0, cells=20, across=4, ramp=None, **options):
    """Return a strip 0.1 m wide and 0.01 m thick with clamped ends, one rotated about the middle line."""
    scene = strip((cells, across), (length, 0.1), **options)
    scene.clamp_boundary(0, end(scene))
    middle = tuple(scene.shells[0].points.mean(0))
    motion = ddg.Motion(angle=ramp or (lambda t: angle * t), axis=(1.0, 0.0, 0.0), pivot=middle)
    scene.clamp_boundary(0, end(scene, "max"), motion=motion)
    return scene.build(device, "float64"), middle


def test_torsion_of_a_strip(device):
    """Saint-Venant: T = G b h^3 / 3 times the rate of twist of a thin plate.

    Clamps that keep the ends flat shorten strips of any length equally (Reissner and Stein 1951). Two lengths therefore
    give G b h^3 / 3 = (L2 - L1) / (phi / T2 - phi / T1).
    """
    angle, compliance = 0.01, []
    for length, cells in ((0.5, 20), (1.0, 40)):
        model, middle = twisted(device, angle, length, cells)
        state = solve(model)
        fixed, rotated = model.reactions(state, point=middle)
        np.testing.assert_allclose(fixed.moment, -rotated.moment, atol=1e-9 * abs(rotated.moment[0]))
        assert rotated.moment[0] * angle == pytest.approx(2.0 * elastic(model, state), rel=1e-3)
        compliance.append(angle / rotated.moment[0])
    stiffness = RUBBER.young / 2.6 * 0.1 * 0.01**3 / 3.0
    assert 0.5 / (compliance[1] - compliance[0]) == pytest.approx(stiffness, rel=0.02)


@pytest.mark.parametrize(
    ("bending", "angle", "load_steps"),
    [
        pytest.param("midedge_dof", 0.6, 2, marks=pytest.mark.slow),
        ("hinge", 0.6, 2),
        pytest.param("midedge_dof", np.deg2rad(420.0), 12, marks=pytest.mark.slow),
    ],
    ids=["twisted", "hinge", "wound"],
)
def test_a_slow_motion_ends_in_the_static_solution(device, bending, angle, load_steps):
    """A strip twisted in 2 s comes to rest in the static solution; wound by 420 degrees it is a helicoid, b12 = -phi / L."""
    model, middle = twisted(device, angle, cells=16, bending=bending)
    static = solve(model, load_steps=load_steps)
    ramp = lambda t: angle * min(1.0, 0.5 * t)  # noqa: E731
    moved, _ = twisted(device, angle, cells=16, bending=bending, ramp=ramp, mass_damping=20.0)
    state = steps(moved, 50, 0.09, rtol=1e-9)
    np.testing.assert_allclose(state.points(), static.points(), atol=1e-9)
    energies = elastic(moved, state), elastic(model, static)
    assert energies[0] == pytest.approx(energies[1], rel=1e-9)
    pairs = zip(moved.reactions(state, point=middle), model.reactions(static, point=middle), strict=True)
    for slow, still in pairs:
        np.testing.assert_allclose(slow.moment, still.moment, atol=1e-7 * np.abs(still.moment).max())
        np.testing.assert_allclose(slow.force, still.force, atol=1e-7 * np.abs(still.force).max())
    if bending == "midedge_dof":
        stiffness = RUBBER.young / 2.6 * 0.1 * 0.01**3 / 3.0
        bent = moved.energies(state)["shell_bend_dof"]
        assert bent == pytest.approx(0.5 * stiffness * angle**2, rel=0.05)


@pytest.mark.parametrize("bending", [pytest.param("midedge_dof", marks=pytest.mark.slow), "midedge_boundary"])
def test_sliding_clamp_bends_a_strip_into_an_arc(device, bending):
    """The clamp normal rotates by 4 rad, vertices slide in the bending plane: M = E h^3 b / 12 * 4 / L, no force, nu = 0."""
    scene = strip((24, 2), (1.0, 0.1), bending, material=ddg.Material(1e6, 0.0, 1000.0))
    scene.clamp_boundary(0, end(scene))
    motion = ddg.Motion(angle=lambda t: 4.0 * t, axis=(0.0, 1.0, 0.0))
    scene.clamp_boundary(0, end(scene, "max"), "y", motion=motion)
    model = scene.build(device, "float64")
    state = solve(model, load_steps=10)
    fixed, rotated = model.reactions(state)
    moment = 1e6 * 0.01**3 * 0.1 / 12.0 * 4.0
    np.testing.assert_allclose(rotated.moment, [0.0, moment, 0.0], atol=5e-3 * moment)
    np.testing.assert_allclose(fixed.moment, -rotated.moment, atol=1e-7 * moment)
    np.testing.assert_allclose(fixed.force, 0.0, atol=1e-7 * moment)
    tip = state.points()[end(scene, "max")] - state.points()[end(scene)]
    np.testing.assert_allclose(tip[:, [0, 2]], np.tile([np.sin(4.0), np.cos(4.0) - 1.0], (3, 1)) / 4.0, atol=2e-3)


@TURNED
def test_reactions_balance(device, model):
    """Rotating supports, supports of one element, symmetry, weight and pressure: forces and moments sum to zero."""
    scene = strip((4, 4), (1.0, 1.0), model, thickness=0.05)
    scene.gravity = (0.3, 0.0, -1.0)
    points = scene.shells[0].points
    motion = ddg.Motion(lambda t: (0.05 * t, 0.0, 0.0), lambda t: 0.3 * t, (0.0, 1.0, 0.3), tuple(points.min(0)))
    scene.clamp_boundary(0, end(scene), motion=motion)
    free = end(scene, "max", 1)[1:]
    scene.clamp_boundary(
        0, free, motion=ddg.Motion(angle=lambda t: -0.2 * t, axis=(1.0, 0.0, 0.0), pivot=(0.0, 1.0, 0.0))
    )
    scene.symmetry(0, end(scene, "min", 1)[1:], "y")
    scene.add_pressure(0, 40.0)
    built = scene.build(device, "float64")
    state = solve(built, load_steps=3)
    tangent = Tangent(built)
    q = tangent.dofs(state)
    host, x = built.coupled.host, q.reshape(-1, 3)[: built.coupled.host.nodes]
    load = tangent.loads(1.0, q).reshape(-1, 3)[: host.nodes]
    pole = np.array([0.2, -0.1, 0.4])
    reactions = built.reactions(state, point=pole)
    scale = np.abs(load).sum()
    np.testing.assert_allclose(sum(r.force for r in reactions), -load.sum(0), atol=1e-8 * scale)
    np.testing.assert_allclose(sum(r.moment for r in reactions), -np.cross(x - pole, load).sum(0), atol=1e-8 * scale)
    assert min(np.linalg.norm(r.moment) for r in reactions) > 1e-3 * scale


@TURNED
def test_reaction_moment_is_the_energy_derivative(device, model):
    """Reaction moments about the axis equal derivatives of the energy by the angle, by central differences."""
    angles, energies = 0.5 + 1e-3 * np.array([-1.0, 0.0, 1.0]), []
    scene = strip((4, 2), (1.0, 0.5), model, thickness=0.05)
    scene.clamp_boundary(0, end(scene))
    axis = np.array([0.3, 1.0, -0.4])
    scene.clamp_boundary(0, end(scene, "max"), motion=ddg.Motion(angle=lambda t: t, axis=tuple(axis), pivot=PIVOT))
    built = scene.build(device, "float64")
    for angle in angles:
        state = solve(built, end=angle)
        energies.append(elastic(built, state))
        if angle == angles[1]:
            moment = built.reactions(state, point=PIVOT)[1].moment @ axis / np.linalg.norm(axis)
    assert moment == pytest.approx((energies[2] - energies[0]) / (angles[2] - angles[0]), rel=1e-5)


def test_continuation_with_a_rotating_clamp(device):
    """Arc length and load steps reach one equilibrium; the rate of the normals enters the tangent of the path."""
    model, _ = twisted(device, 0.4, cells=8, across=2)
    path = Continuation(model, step=0.05, max_step=0.4).trace(stop=StopCriterion(load=(-1.0, 1.0)))
    np.testing.assert_allclose(path.points[-1].state.points(), solve(model).points(), atol=1e-9)
    assert max(point.iterations for point in path.points[1:]) < 7


@pytest.mark.parametrize("scheme", SCHEMES)
def test_normals_belong_to_the_state(device, scheme):
    """A run continues bitwise from a snapshot; a failed world keeps its normals while the other rotates."""
    scene = strip((4, 2), (1.0, 0.5), material=ddg.Material(1e6, 0.3, 1000.0, viscosity=0.01))
    scene.clamp_boundary(0, end(scene), motion=ddg.Motion(angle=lambda t: 2.0 * t, axis=AXIS, pivot=PIVOT))
    model = scene.build(device, "float64", worlds=2)
    points = np.array(model.state().points())
    points[0, 7] = points[0, 6]  # a triangle without area
    integrator = ddg.Integrator(model, scheme, check_every=10**9)
    state = integrator.step(model.state(points=points), 0.02)
    saved = state.snapshot()
    second_integrator = ddg.Integrator(model, scheme, check_every=10**9)
    second_integrator.step(model.state(points=points), 0.02)
    again = model.restore(saved)
    for _ in range(4):
        state, again = integrator.step(state, 0.02), second_integrator.step(again, 0.02)
    for name, values in state.snapshot().items():
        np.testing.assert_array_equal(values, again.snapshot()[name], err_msg=name)
    single = scene.build(device, "float64")
    single_state = steps(single, 5, 0.02, scheme)
    same = np.testing.assert_array_equal if device == "cpu" else np.testing.assert_allclose
    same(state.points()[1], single_state.points())
    (given_up,), (data,) = (list(s.coupled.data.values()) for s in (state, single_state))
    half = data.shape[1]
    np.testing.assert_array_equal(given_up.numpy()[:, half:], data.numpy())
    np.testing.assert_array_equal(given_up.numpy()[:, :half], next(iter(single.state().coupled.data.values())).numpy())


def test_retried_steps_rotate_along_the_arc(device):
    """Supports lie on the circle in every substep, not on the chord."""
    scene = strip((3, 2), (1.0, 0.6))
    motion = ddg.Motion(angle=lambda t: 2.0 * t, axis=AXIS, pivot=PIVOT)
    scene.clamp_boundary(0, end(scene), motion=motion)
    model = scene.build(device, "float64")
    rate = 2.0 * np.asarray(AXIS) / np.linalg.norm(AXIS)
    start = model.state(velocities=np.cross(rate, scene.shells[0].points - PIVOT))
    integrator = ddg.Integrator(model, max_iterations=4)
    state = integrator.step(start, 0.5)
    assert integrator.statistics()["retries"] > 0
    np.testing.assert_allclose(
        state.points()[end(scene)], motion.place(0.5, scene.shells[0].points[end(scene)]), atol=1e-12
    )
    np.testing.assert_allclose(normals(state)[0], motion.rotation(1.0) @ [0.0, 0.0, 1.0], atol=1e-12)


def test_two_motions_of_one_vertex(device):
    """Motions of different components combine; two motions of one component are refused with point and axis."""
    scene = strip((2, 2), (1.0, 1.0))
    corner = [int(np.argmin(scene.shells[0].points.sum(1)))]
    scene.hold(0, corner, "x", ddg.Motion(translation=lambda t: (t, 9.0, 9.0)))
    scene.hold(0, corner, "z", ddg.Motion(translation=lambda t: (9.0, 9.0, -2.0 * t)))
    scene.hold(0, corner, "y")
    model = scene.build(device, "float64")
    moved = model.state().points()[corner] + [0.04, 0.0, -0.08]
    np.testing.assert_allclose(steps(model, 2, 0.02).points()[corner], moved, atol=1e-14)
    scene.hold(0, corner, "z", ddg.Motion(translation=lambda t: (0.0, 0.0, t)))
    with pytest.raises(ddg.SceneError, match=r"the point at \(.*\) m has two motions along z"):
        scene.build(device)
