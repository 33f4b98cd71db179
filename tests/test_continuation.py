"""Equilibrium paths: trusses in closed form, the elastica, limit points, bifurcations, branches, failures by name."""

import sys
from itertools import groupby
from pathlib import Path as FilePath

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.scene.equilibrium_path import Displacement, StopCriterion
from ddg_warp.scenes import lee_frame, post_buckling, roll_up
from ddg_warp.solve.equilibrium import stability
from ddg_warp.solve.equilibrium.continuation import Continuation
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions, solve
from ddg_warp.solve.equilibrium.tangent import Tangent

sys.path.append(str(FilePath(__file__).parent / "accuracy"))
from convergence import order


def truss(device, length: float, **options):
    """Return the continuation and height of a von Mises truss (1923): two bars of a length, EA = 1, under a load at
    the apex.

    Supports are at (-1, 0) and (1, 0); the load parameter acts downwards.
    """
    height = np.sqrt(length**2 - 1.0)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    points = [[-1.0, 0.0, 0.0], [0.0, 0.0, height], [1.0, 0.0, 0.0]]
    bars = scene.add_rod(points, section=ddg.Stiffness(EA=1.0, mass_per_length=1.0), bend=False)
    scene.fix(bars, [0, -1])
    scene.add_force(bars, 1, (0.0, 0.0, -1.0))
    watch = {"drop": Displacement.of(1, "z", -1.0), "sway": Displacement.of(1, "x")}
    return Continuation(
        scene.build(device, "float64"), watch, **{"load_scale": 0.3, "floor_factor": 1.0, **options}
    ), height


# P(z) = 2 EA z (1 / l - 1 / l0) with l^2 = 1 + z^2: two bars of force EA (l / l0 - 1) with slope z / l.
def exact_load(z, length):
    return 2.0 * z * (1.0 / np.sqrt(1.0 + z**2) - 1.0 / length)


def test_shallow_truss_snaps_through(device):
    """dP/dz = 0 at l^3 = l0; equilibria in between are unstable.

    The load falls below zero and comes back.
    """
    length = 1.1
    continuation, height = truss(device, length)
    path = continuation.trace(stop=StopCriterion(displacement=("drop", -1.0, 2.3 * height)))
    z = height - path.values("drop")
    np.testing.assert_allclose(path.load, exact_load(z, length), atol=1e-10)
    assert path.outcome == "displacement"
    assert path.values("drop")[-1] == pytest.approx(2.3 * height, rel=1e-12)
    assert np.abs(path.values("sway")).max() < 1e-12
    assert not path.bifurcations
    assert repr(path).startswith(f"<Path of {len(path)} equilibria from load 0 to ")
    assert repr(path.limit_points[0]).startswith("<Limit point at load ") and " m, " in repr(path.limit_points[0])
    limit = np.sqrt(length ** (2.0 / 3.0) - 1.0)
    assert [height - point.values["drop"] for point in path.limit_points] == pytest.approx([limit, -limit], abs=1e-7)
    loads = [point.load for point in path.limit_points]
    assert loads == pytest.approx([exact_load(limit, length), -exact_load(limit, length)], rel=1e-10)
    regular = [point for point in path.points if point.kind == "regular"]
    for point in regular:
        assert point.negative == int(abs(height - point.values["drop"]) < limit)
        assert point.stable == stability.spectrum(continuation.model, point.state).stable
    assert (np.diff(path.arclength) > 0.0).all()
    assert {point.state.time == point.load for point in path.points} == {True}


# The lateral stiffness 2 EA (1 / (l0 l^2) + (l - l0) z^2 / (l0 l^3)) vanishes where l^3 - l0 l^2 + l0 = 0.
def test_steep_truss_bifurcates_before_it_snaps(device):
    length = 3.0
    continuation, height = truss(device, length)
    path = continuation.trace(stop=StopCriterion(displacement=("drop", -1.0, height)))
    roots = np.sort(np.roots([1.0, -length, 0.0, length]).real)[:0:-1]
    assert roots == pytest.approx([2.532, 1.347], abs=1e-3)
    expected = [("bifurcation", roots[0]), ("limit point", length ** (1.0 / 3.0)), ("bifurcation", roots[1])]
    events = [point for point in path.points if point.kind != "regular"]
    assert [point.kind for point in events] == [kind for kind, _ in expected]
    for point, (_, bar) in zip(events, expected, strict=True):
        assert np.hypot(1.0, height - point.values["drop"]) == pytest.approx(bar, abs=1e-6)
    mode = events[0].mode.reshape(-1, 2)
    assert np.abs(mode[1, 1]) < 1e-9 * np.abs(mode[1, 0])  # sideways
    counts = [point.negative for point in path.points if point.kind == "regular"]
    assert [count for count, _ in groupby(counts)] == [0, 1, 2, 1]


def test_plot_tells_stable_from_unstable(device):
    """Lines have all points, full ones the stable points; special points are marked, and branches use the same axes."""
    pytest.importorskip("matplotlib")
    continuation, height = truss(device, 3.0)
    path = continuation.trace(stop=StopCriterion(displacement=("drop", -1.0, height)))
    axes = path.plot("drop")
    line, stable, limits, bifurcations = axes.lines
    np.testing.assert_array_equal(line.get_xydata(), np.stack([path.values("drop"), path.load], axis=1))
    np.testing.assert_array_equal(np.isfinite(stable.get_xdata()), path.stable)
    assert len(limits.get_xdata()) == len(path.limit_points) == 1
    assert len(bifurcations.get_xdata()) == len(path.bifurcations) == 2
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("drop [m]", "load parameter")
    assert path.plot("drop", axes) is axes
    assert len(axes.lines) == 8


def test_branch_of_the_truss(device):
    """Bars of different lengths are in equilibrium; the other side is the mirror image.

    The branch starts laterally.
    """
    length = 3.0
    continuation, height = truss(device, length)
    (point,) = continuation.trace(stop=StopCriterion(load=(-1.0, 0.5))).bifurcations
    sides = []
    for side in (1, -1):
        branch = continuation.switch(point, side=side, step=0.01, stop=StopCriterion(steps=25))
        x, z = branch.values("sway"), height - branch.values("drop")
        forces = np.zeros((len(branch), 2))
        for foot in (-1.0, 1.0):
            bar = np.stack([x - foot, z], axis=1)
            bar_length = np.linalg.norm(bar, axis=1, keepdims=True)
            forces += (bar_length / length - 1.0) * bar / bar_length
        np.testing.assert_allclose(forces[:, 0], 0.0, atol=1e-9)
        np.testing.assert_allclose(forces[:, 1], -branch.load, atol=1e-9)
        assert (np.diff(np.abs(x[:6])) > 0.0).all()
        assert np.abs(x).max() > 1.0
        sides.append((x, branch.load))
    np.testing.assert_allclose(sides[0][0], -sides[1][0], atol=1e-9)
    np.testing.assert_allclose(sides[0][1], sides[1][1], atol=1e-9)


def test_displacement_control_passes_a_limit_point(device):
    length = 1.1
    continuation, height = truss(device, length)
    drops = height * np.array([0.2, 0.5, 0.9, 1.0, 1.1, 1.8, 2.1, 1.0])  # and back again
    path = continuation.control("drop", drops)
    np.testing.assert_allclose(path.values("drop"), drops, rtol=1e-12)
    np.testing.assert_allclose(path.load, exact_load(height - drops, length), atol=1e-10)
    assert path.outcome == "values"
    assert path.negative.tolist() == [0, 1, 1, 1, 1, 0, 0, 1]


def strip(device, n: int, axial: float):
    """Return a simply supported column of EI = L = 1 along x, under an axial load by the load parameter."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), n + 1)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=axial, EI1=1.0, radius=0.01))
    scene.fix(rod, [0])
    scene.fix(rod, [-1], "z")
    scene.add_force(rod, -1, (-1.0, 0.0, 0.0))
    watch = {"shortening": Displacement.of(-1, "x", -1.0), "amplitude": Displacement.of(n // 2, "z")}
    return Continuation(scene.build(device, "float64"), watch, load_scale=10.0, floor_factor=1.0)


# Links of length h (1 - P / EA) with springs EI / h between them: P (1 - P / EA) = 4 EI sin(k pi / 2 n)^2 / h^2.
def test_pinned_column_bifurcates_at_eulers_loads(device):
    n, axial = 12, 5e3
    path = strip(device, n, axial).trace(stop=StopCriterion(load=(0.0, 45.0)))
    assert path.outcome == "load"
    assert path.load[-1] == 45.0
    buckling = 4.0 * n**2 * np.sin(np.array([1.0, 2.0]) * np.pi / (2.0 * n)) ** 2
    expected = 0.5 * axial * (1.0 - np.sqrt(1.0 - 4.0 * buckling / axial))
    assert [point.load for point in path.bifurcations] == pytest.approx(expected, rel=1e-7)
    assert expected == pytest.approx([np.pi**2, 4.0 * np.pi**2], rel=0.03)
    counts = [point.negative for point in path.points if point.kind == "regular"]
    assert [count for count, _ in groupby(counts)] == [0, 1, 2]
    for k, point in enumerate(path.bifurcations, 1):
        waves = np.sin(k * np.pi * np.linspace(0.0, 1.0, n + 1))
        mode = point.mode.reshape(-1, 2)[:, 1]
        assert np.abs(mode @ waves) / np.linalg.norm(mode) / np.linalg.norm(waves) == pytest.approx(1.0, abs=1e-9)


# Elliptic integrals, as in scenes/post_buckling.py: P L^2 / EI and amplitude / L at given shortening / L. EA L^2 / EI = 1e7.
@pytest.mark.slow
def test_branch_follows_the_elastica(device):
    edges, errors = (20, 40, 80), []
    for n in edges:
        continuation = strip(device, n, 1e7)
        (point,) = continuation.trace(stop=StopCriterion(load=(0.0, 12.0))).bifurcations
        branch = continuation.switch(point, stop=StopCriterion(displacement=("shortening", -1.0, 0.3)))
        assert branch.values("shortening")[-1] == pytest.approx(0.3, rel=1e-9)
        assert not branch.negative[1:].any()
        assert not [p for p in branch.points[1:] if p.kind != "regular"]
        assert (np.diff(branch.load[1:]) > 0.0).all()
        last = branch.points[-1]
        errors.append([last.load / 11.65303 - 1.0, abs(last.values["amplitude"]) / 0.3143126 - 1.0])
    assert post_buckling.exact(0.3)[:2] == pytest.approx((11.65303, 0.3143126), rel=1e-6)
    assert np.abs(errors[-1]).max() < 1e-3
    assert order(edges, np.array(errors)[:, 0]) == pytest.approx(2.0, abs=0.1)


def arch(device, load_scale: float, imperfection: float = 0.0):
    """Return a shallow elastic arch of 20 edges between hinges, loaded at the crown."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    x = np.linspace(-1.0, 1.0, 21)
    points = np.stack([x, 0.0 * x, 0.3 * (1.0 - x**2) + imperfection * np.sin(np.pi * x)], axis=1)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=1e4, EI1=1.0, radius=0.01))
    scene.fix(rod, [0, -1])
    scene.add_force(rod, 10, (0.0, 0.0, -1.0))
    watch = {"drop": Displacement.of(10, "z", -1.0), "sway": Displacement.of(10, "x")}
    return Continuation(scene.build(device, "float64"), watch, load_scale=load_scale, floor_factor=1.0)


@pytest.mark.slow
@pytest.mark.parametrize("load_scale", [30.0, 300.0])
def test_closed_branch_passes_both_pitchforks(device, load_scale):
    """The asymmetric states of an arch form a loop through both pitchforks, each one event.

    The load is stationary there, yet this is no limit point: the load does no work on the mode, along which the branch
    runs.
    """
    continuation = arch(device, load_scale)
    first = continuation.trace(stop=StopCriterion(displacement=("drop", -1.0, 0.1))).bifurcations[0]
    branch = continuation.switch(first, stop=StopCriterion(steps=45))
    events = [point for point in branch.points[1:] if point.kind != "regular"]
    assert {point.kind for point in events} == {"bifurcation"}
    assert len(events) >= 2
    for point, back in zip(events, (False, True), strict=False):
        assert point.values["sway"] == pytest.approx(0.0, abs=1e-3)
        assert (point.load == pytest.approx(first.load, rel=1e-4)) == back
    assert np.abs(branch.values("sway")).max() > 0.02
    # switching at the other pitchfork, across the loop, leads to symmetric states
    symmetric = continuation.switch(events[0], stop=StopCriterion(steps=3))
    assert np.abs(symmetric.values("sway")[1:]).max() < 1e-3 < np.ptp(symmetric.values("drop"))


@pytest.mark.slow
def test_imperfect_arch_has_a_limit_point_near_the_pitchfork(device):
    """The path passes the pitchfork by limit points instead, without a jump to another path."""
    path = arch(device, 30.0, 1e-4).trace(stop=StopCriterion(displacement=("drop", -1.0, 0.55)))
    assert [point.kind for point in path.points if point.kind != "regular"] == ["limit point"]
    (limit,) = path.limit_points
    perfect = arch(device, 30.0).trace(stop=StopCriterion(displacement=("drop", -1.0, 0.1))).bifurcations[0]
    assert limit.load < perfect.load
    assert limit.load == pytest.approx(perfect.load, rel=0.02)
    assert np.abs(path.values("sway")).max() > 0.02


@pytest.mark.slow
@pytest.mark.parametrize("load_scale", [0.3, 3.0, 30.0])
def test_every_event_is_listed_once(device, load_scale):
    """The steep truss passes six events, by closed form (see above), in any metric."""
    continuation, height = truss(device, 3.0, load_scale=load_scale)
    path = continuation.trace(stop=StopCriterion(displacement=("drop", -1.0, 2.2 * height)))
    roots = np.sort(np.roots([1.0, -3.0, 0.0, 3.0]).real)[:0:-1]
    bars = [roots[0], 3.0 ** (1.0 / 3.0), roots[1]]
    kinds = ["bifurcation", "limit point", "bifurcation"]
    events = [point for point in path.points if point.kind != "regular"]
    assert [point.kind for point in events] == kinds + kinds[::-1]
    lengths = [np.hypot(1.0, height - point.values["drop"]) for point in events]
    assert lengths == pytest.approx(bars + bars[::-1], abs=1e-5)
    assert path.stable.tolist() == (path.negative == 0).tolist()
    assert path.kinds == [point.kind for point in path.points]


def cap(device):
    """Return a shallow triangulated cap, twice as high as thick, between hinges under a dead pressure."""
    points, triangles = meshes.disc(3)
    radius = np.linalg.norm(points, axis=1)
    points = points + (0.02 * (1.0 - radius**2))[:, None] * [0.0, 0.0, 1.0]
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    shell = scene.add_shell(
        points, triangles, thickness=0.01, material=ddg.Material(young=1e7, poisson=0.3), bending="hinge"
    )
    scene.hold(shell, np.flatnonzero(radius > 1.0 - 1e-9))
    scene.add_pressure(shell, -50.0, dead=True)
    return Continuation(scene.build(device, "float64"), {"drop": Displacement.of(int(radius.argmin()), "z", -1.0)})


@pytest.mark.slow
def test_default_steps_resolve_a_snap(device):
    """The snap is shorter than the first default step: limit loads agree with displacement control."""
    continuation = cap(device)
    path = continuation.trace(stop=StopCriterion(displacement=("drop", -1.0, 0.042)))
    assert np.diff(path.values("drop")).max() < 0.01  # a thickness
    assert [point.kind for point in path.points if point.kind != "regular"] == [
        "bifurcation",
        "limit point",
        "limit point",
        "bifurcation",
    ]
    assert path.negative[0] == path.negative[-1] == 0
    drops = np.linspace(0.001, 0.042, 12)
    controlled = continuation.control("drop", drops)
    upper, lower = (point.load for point in path.limit_points)
    assert upper >= controlled.load[drops < 0.036].max() - 1e-3 * upper
    assert lower <= controlled.load.min() + 1e-3 * upper
    assert path.bifurcations[0].mode_displacements.shape == path.points[0].state.points().shape
    assert np.abs(path.bifurcations[0].mode_displacements).max() > 0.0


def test_path_under_moving_supports(device):
    """The load parameter moves a hinge: the path agrees with load stepping, and passes the final load."""
    scene = post_buckling.build(0.1, 1e6, 20)
    scene.supports.clear()
    scene.fix(0, [0])
    scene.fix(0, [-1], motion=ddg.Motion(translation=lambda t: (-0.3 * t, 0.0, 0.0)))
    model = scene.build(device, "float64")
    continuation = Continuation(model, {"rise": Displacement.of(10, "z")}, floor_factor=1.0)
    start = solve(model, end=0.0)
    path = continuation.trace(start, stop=StopCriterion(load=(-1.0, 1.0)))
    assert path.load[-1] == 1.0
    assert (np.diff(path.load) > 0.0).all()
    for point in path.points[:: max(1, len(path) // 3)]:
        assert point.state.points()[-1, 0] == pytest.approx(0.9 - 0.3 * point.load, abs=1e-12)
        stepped = Equilibrium(model, StaticsOptions(floor_factor=1.0)).load(start, 4, 0.0, point.load)
        np.testing.assert_allclose(point.state.points(), stepped.points(), atol=1e-8)


def test_path_under_a_follower_couple(device):
    """A couple in space has no potential; the rod rolls into the circle that planar load stepping gives."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 13)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=1e5, EI1=1.0, GJ=1.0))
    scene.clamp_end(rod, "first")
    scene.add_couple(rod, -1, (0.0, -0.5 * np.pi, 0.0))
    continuation = Continuation(scene.build(device, "float64"), {"tip": Displacement.of(-1, "z")}, floor_factor=1.0)
    path = continuation.trace(stop=StopCriterion(load=(-1.0, 1.0)))
    model = roll_up.build(0.25, 12).build(device, "float64")
    state = path.points[-1].state
    stiffness = continuation.tangent.load_stiffness(1.0, continuation.tangent.dofs(state))
    assert abs(stiffness - stiffness.T).max() > 0.1  # no potential
    np.testing.assert_allclose(state.points()[-1], solve(model, load_steps=4).points()[-1], atol=1e-3)
    assert np.abs(state.points()[-1] - [2.0 / np.pi, 0.0, 2.0 / np.pi]).max() < 5e-3
    tangent = continuation.tangent
    residual = tangent.loads(1.0, tangent.dofs(state)) - tangent.gradient(state)
    assert np.abs(residual[tangent.free]).max() < 1e-7


def test_path_goes_backwards_and_repeats_bitwise(device):
    first, again = (truss(device, 1.1)[0].trace(direction=-1, stop=StopCriterion(steps=12)) for _ in range(2))
    assert first.outcome == "steps"
    assert len(first) == 13
    assert (first.load[1:] < 0.0).all()
    np.testing.assert_array_equal(first.load, again.load)
    for point, repeated in zip(first.points, again.points, strict=True):
        np.testing.assert_array_equal(point.state.points(), repeated.state.points())
        np.testing.assert_array_equal(point.direction, repeated.direction)


def test_stop_by_limit_points_and_the_start_is_kept(device):
    continuation, _ = truss(device, 1.1)
    start = continuation.model.state()
    before = start.snapshot()
    path = continuation.trace(start, stop=StopCriterion(limit_points=1))
    assert path.outcome == "limit_points"
    assert path.points[-1].kind == "limit point"
    assert path.points[-1].negative == 0
    for name, value in start.snapshot().items():
        np.testing.assert_array_equal(value, before[name])


@pytest.mark.slow
def test_displacement_that_reverses_is_refused(device):
    """v of the Lee frame stays below 65 cm on this path (the maximum is 61.3 at 20 edges)."""
    scene = lee_frame.build(10)
    continuation = Continuation(scene.build(device, "float64"), scene.analysis.watch)
    with pytest.raises(ddg.SolverError, match=r"displacement_turns_back.*arc length") as caught:
        continuation.control("v", (30.0, 65.0))
    assert caught.value.outcome == "displacement_turns_back"
    reached = caught.value.path.values("v")
    assert reached[0] == pytest.approx(30.0)
    assert 60.0 < reached[-1] < 63.0


def test_failures_are_named(device):
    continuation, _ = truss(device, 3.0, max_iterations=1)
    with pytest.raises(ddg.SolverError, match=r"no_start.*statics.solve") as caught:
        continuation.trace(start=0.3)
    assert caught.value.outcome == "no_start"
    with pytest.raises(ddg.SolverError, match=r"after 1 points: step_too_small.*min_step below") as caught:
        truss(device, 3.0, max_iterations=1, step=0.05, min_step=0.02)[0].trace()
    assert caught.value.outcome == "step_too_small"
    assert len(caught.value.path) == 1
    np.testing.assert_array_equal(caught.value.state.points(), continuation.model.state().points())
    (point,) = truss(device, 3.0)[0].trace(stop=StopCriterion(load=(-1.0, 0.5))).bifurcations
    with pytest.raises(ddg.SolverError, match="no_branch") as caught:
        truss(device, 3.0, max_iterations=1)[0].switch(point, step=1e6)
    assert caught.value.outcome == "no_branch"


def test_structure_without_stiffness_has_no_path(device):
    """A straight string at rest has no lateral stiffness."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    points = np.linspace((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 4)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=1.0, mass_per_length=1.0), bend=False)
    scene.fix(rod, [0, -1])
    scene.add_force(rod, 1, (1.0, 0.0, 0.0))
    with pytest.raises(ddg.SolverError, match=r"singular_start.*without any stiffness") as caught:
        Continuation(scene.build(device, "float64")).trace()
    assert caught.value.outcome == "singular_start"


def test_mistakes(device):
    continuation, _ = truss(device, 1.1)
    with pytest.raises(ddg.SceneError, match="no displacement 'rise' is watched"):
        continuation.control("rise", [0.1])
    with pytest.raises(ddg.SceneError, match="'rise': it is not watched"):
        continuation.trace(stop=StopCriterion(displacement=("rise", 0.0, 1.0)))
    with pytest.raises(ValueError, match=r"regular.*bifurcation"):
        continuation.switch(continuation.trace(stop=StopCriterion(steps=1)).points[0])
    for row, axis, message in (
        (3, "z", "there are 3 points"),
        (1, "w", "axis is 'w'; it is 'x', 'y' or 'z'"),
        (1, "y", "planar"),
    ):
        with pytest.raises(ddg.SceneError, match=message):
            Continuation(continuation.model, {"d": Displacement.of(row, axis)})
    with pytest.raises(ddg.SceneError, match="step is 0"):
        Continuation(continuation.model, step=0)
    with pytest.raises(ddg.SceneError, match="one world; the model has 2"):
        Continuation(continuation.model.scene.build(device, "float64", worlds=2))


# All equilibria of the path satisfy the equations of the model in any metric; a watched sum equals the sum of its
# terms.
@pytest.mark.slow
def test_metric_does_not_move_the_path(device):
    for load_scale in (0.03, 3.0):
        continuation, height = truss(device, 1.1, load_scale=load_scale)
        path = continuation.trace(stop=StopCriterion(displacement=("drop", -1.0, height)))
        np.testing.assert_allclose(path.load, exact_load(height - path.values("drop"), 1.1), atol=1e-10)
    both = Displacement(((1, "z", -1.0), (1, "x", 2.0)))
    tangent = Tangent(continuation.model)
    assert both.vector(tangent)[tangent.point_dofs()[1, [0, 2]]].tolist() == [2.0, -1.0]
