"""Frames of clamped ends, extrapolated or prescribed, and end moments, of uncoupled and joined rods."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.solve.equilibrium import statics

SECTION = ddg.Stiffness(EA=1e7, EI1=2.0, EI2=3.0, GJ=1.0)
X, Y, Z = np.eye(3)


def weightless() -> ddg.Scene:
    return ddg.Scene(gravity=(0.0, 0.0, 0.0))


def straight(edges: int) -> np.ndarray:
    return np.linspace(0.0 * X, X, edges + 1)


def add_halves(scene, points, **options) -> list[int]:
    """Add a rod as two rigidly joined halves and return the indices."""
    middle = len(points) // 2
    directors = options.pop("director", None)
    rods = []
    for half in (slice(0, middle + 1), slice(middle, None)):
        half_directors = None if directors is None else directors[half.start : (middle if half.stop else None)]
        rods.append(scene.add_rod(points[half], director=half_directors, **options))
    scene.join([(rods[0], -1), (rods[1], 0)])
    return rods


# Directors that rotate at rate tau along a straight rod without natural twist: M = GJ tau everywhere, for any mesh.
@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
@pytest.mark.parametrize("edges", [10, 16])
def test_pretwisted_rod(device, edges, joined):
    rate = 2.0
    angle = rate * (np.arange(edges) + 0.5) / edges
    directors = np.outer(np.cos(angle), Y) + np.outer(np.sin(angle), Z)
    scene = weightless()
    options = {"director": directors, "section": SECTION, "natural": "straight"}
    rods = add_halves(scene, straight(edges), **options) if joined else [scene.add_rod(straight(edges), **options)]
    scene.clamp_end(rods[0], "first")
    scene.clamp_end(rods[-1], "last")
    model = scene.build(device, "float64")
    state = statics.solve(model)
    stresses = model.stresses(state)
    for rod in rods:
        np.testing.assert_allclose(stresses["rod_bend_twist"][rod][:, 2], SECTION.GJ * rate, rtol=1e-9)
        if joined:
            np.testing.assert_allclose(stresses["rigid_joint"][rod][:, 2], SECTION.GJ * rate, rtol=1e-9)
    revolutions = sum(ddg.quantities.total_twist(model, state, rod) for rod in rods)
    assert revolutions == pytest.approx(rate / (2.0 * np.pi), rel=1e-9)
    first, last = model.reactions(state)
    np.testing.assert_allclose(first.moment, -SECTION.GJ * rate * X, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(last.moment, SECTION.GJ * rate * X, rtol=1e-8, atol=1e-8)


# A clamp prescribes the end of a straight rod at an angle: the equilibrium is the rotated rod, without energy.
def test_prescribed_tangent_and_director(device):
    tangent = np.array([np.cos(0.3), np.sin(0.3), 0.2])
    tangent /= np.linalg.norm(tangent)
    director = np.cross(tangent, Z + 0.4 * Y)
    director /= np.linalg.norm(director)
    for end, sign in (("first", 1.0), ("last", -1.0)):
        scene = weightless()
        rod = scene.add_rod(straight(8), section=SECTION, natural="straight")
        scene.clamp_end(rod, end, tangent=tangent, director=director)
        model = scene.build(device, "float64")
        state = statics.solve(model)
        points = state.points()
        fixed, free = (points[0], points[-1]) if end == "first" else (points[-1], points[0])
        np.testing.assert_allclose(free, fixed + sign * tangent, atol=1e-8)
        np.testing.assert_allclose(state.directors(), np.tile(director, (8, 1)), atol=1e-7)
        assert sum(model.energies(state).values()) < 1e-12


# The natural shape takes the prescribed tangent: a rod of that shape is in equilibrium for any tangent.
def test_natural_shape_has_the_prescribed_tangent(device):
    angle = np.linspace(0.0, 1.0, 9)
    points = np.stack([np.sin(angle), 0.0 * angle, 1.0 - np.cos(angle) + 0.1 * angle**3], -1)
    scene = weightless()
    scene.clamp_end(scene.add_rod(points, section=SECTION), tangent=(1.0, 0.05, 0.02))
    model = scene.build(device, "float64")
    assert np.abs(model.stresses(model.state())["rod_bend_twist"][0]).max() < 1e-12


# The clamp moment of a curved cantilever is that of the tip force about the clamp: M = -(x_tip - x_0) x F, in the
# directors
# of the clamp. Stresses converge with order 2, next to rigid joints too.
@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
def test_moments_at_clamp_and_joint_are_of_second_order(device, joined):
    errors = []
    for edges in (16, 32, 64):
        angle = np.linspace(0.0, 0.25 * np.pi, edges + 1)
        points = np.stack([1.0 - np.cos(angle), np.sin(angle), 0.0 * angle], -1)
        scene = weightless()
        rods = add_halves(scene, points, section=SECTION) if joined else [scene.add_rod(points, section=SECTION)]
        scene.clamp_end(rods[0], "first", tangent=Y, director=Z)
        scene.add_force(rods[-1], -1, (0.0, 0.3, 4.0))
        model = scene.build(device, "float64")
        state = statics.solve(model, load_steps=2)
        lever, force = state.points()[-1], np.array([0.0, 0.3, 4.0])
        stresses = model.stresses(state)
        errors.append([_relative_error(stresses["rod_bend_twist"][0][0], np.cross(lever, force), Z, Y)])
        if joined:  # both sides of the joint give the moment at its node, in the mean directors
            node = state.points()[edges // 2]
            one, two = stresses["rigid_joint"][0][0], stresses["rigid_joint"][1][0]
            u, v = state.directors()[edges // 2 - 1 : edges // 2 + 1]
            t, s = np.diff(state.points()[[edges // 2 - 1, edges // 2, edges // 2 + 1 + 1]], axis=0)
            director, tangent = (u + v) / np.linalg.norm(u + v), t / np.linalg.norm(t) + s / np.linalg.norm(s)
            moment = np.cross(lever - node, force)
            errors[-1] += [_relative_error(each, moment, director, tangent) for each in (one, two)]
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.abs(orders - 2.0).max() < 0.1, (errors, orders)


def _relative_error(moments: np.ndarray, moment: np.ndarray, director: np.ndarray, tangent: np.ndarray) -> float:
    """Return the relative error of moments against a moment in space.

    Moments are about the second, minus the first director, and the tangent.
    """
    tangent = tangent / np.linalg.norm(tangent)
    director = director - tangent * (director @ tangent)
    director /= np.linalg.norm(director)
    expected = np.array([moment @ np.cross(tangent, director), -moment @ director, moment @ tangent])
    return float(np.linalg.norm(moments - expected) / np.linalg.norm(expected))


@pytest.mark.parametrize(
    ("options", "phrases"),
    {
        "tangent of zero": ({"tangent": (0.0, 0.0, 0.0)}, ("tangent of rod 0", "not zero")),
        "tangent not finite": ({"tangent": (np.nan, 0.0, 1.0)}, ("tangent of rod 0", "finite")),
        "tangent of two": ({"tangent": (1.0, 0.0)}, ("tangent", "(1.0, 0.0)", "(3,)")),
        "tangent back": ({"tangent": (-1.0, 0.0, 0.0)}, ("rod 0", "first end", "points back")),
        "director along": ({"director": (1.0, 0.0, 0.0)}, ("rod 0", "first end", "across")),
    }.values(),
)
def test_bad_end_frames(device, options, phrases):
    scene = weightless()
    scene.add_rod(straight(4), section=SECTION)
    with pytest.raises(ddg.SceneError) as caught:
        scene.clamp_end(0, **options)
        scene.build(device)
    assert all(word in str(caught.value) for word in phrases), caught.value


def test_inconsistent_end_frames_are_refused(device):
    scene = weightless()
    scene.add_rod(straight(4), section=ddg.Stiffness(EA=1.0, EI1=1.0), twist=False)
    with pytest.raises(ddg.SceneError, match=r"rod 0 .* has no twist"):
        scene.clamp_end(0, director=Y)
    planar = ddg.Scene(dimension=2)
    planar.add_rod(straight(4), section=SECTION)
    with pytest.raises(ddg.SceneError, match="leaves the plane"):
        planar.clamp_end(0, tangent=(1.0, 0.1, 0.0))
    scene.clamp_end(0, tangent=X)
    scene.clamp_end(0, tangent=X + 0.1 * Y)
    with pytest.raises(ddg.SceneError, match="first end of rod 0 is clamped twice"):
        scene.build(device)
