"""Curvature as turning angle over length: exact polygons, joints, ends, directors, and the registry."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import polyline
from ddg_warp.kernels.terms import REGISTRY
from ddg_warp.scenes import tip_load
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions

SECTION = ddg.Stiffness(EA=1e6, EI1=1.0, EI2=1.3, GJ=0.8, mass_per_length=1.0)
ROUND = ddg.Stiffness(EA=1e6, EI1=1.0, GJ=0.8)
X, Y, Z = np.eye(3)
slow = pytest.mark.slow


def equilibrium(scene, device, load_steps: int = 1, **options):
    model = scene.build(device, "float64")
    return model, Equilibrium(model, StaticsOptions(floor_factor=1.0, **options)).load(model.state(), load_steps)


def turning_angles(points: np.ndarray) -> np.ndarray:
    """Return angles between neighbouring edges [rad]."""
    t = polyline.unit(np.diff(points, axis=0))
    return np.arctan2(np.linalg.norm(np.cross(t[:-1], t[1:]), axis=1), np.sum(t[:-1] * t[1:], 1))


def bent_by_a_couple(kind: str, curvature: str, n: int = 12) -> ddg.Scene:
    """Return a cantilever of length 1 in n equal edges, bent by a couple to a full revolution about -y."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2 if kind.startswith("planar") else 3)
    points = np.linspace(0.0 * X, X, n + 1)
    parts = [points[:6], points[5:]] if "joined" in kind else [points]
    options = {"section": ROUND, "curvature": curvature, "twist": kind != "without twist"}
    rods = [scene.add_rod(part, **options) for part in parts]
    if "joined" in kind:
        scene.join([(rods[0], -1), (rods[1], 0)])
    scene.clamp_end(rods[0], "first")
    scene.add_couple(rods[-1], -1, (0.0, -2.0 * np.pi, 0.0))
    return scene


# A couple M on the last edge rotates each cell by M h / EI = 2 pi / n, half cells at the clamp and at a joint by half
# of it.
# Edge k points at (k + 1/2) 2 pi / n, and the polygon closes.
@pytest.mark.parametrize(
    "kind", ["planar", *(pytest.param(k, marks=slow) for k in ("in space", "without twist", "joined"))]
)
def test_a_couple_makes_a_regular_polygon(device, kind):
    n = 12
    _, state = equilibrium(bent_by_a_couple(kind, "angle", n), device, 10, mode="follow")
    points = state.points()
    points = np.delete(points, 5, axis=0) if "joined" in kind else points
    angle = (np.arange(n) + 0.5) * 2.0 * np.pi / n
    exact = np.cumsum(np.stack([np.cos(angle), 0.0 * angle, np.sin(angle)], 1), 0) / n
    np.testing.assert_allclose(points[1:], exact, atol=1e-7)
    np.testing.assert_allclose(turning_angles(points), 2.0 * np.pi / n, atol=1e-7)


def test_a_ring_has_the_energy_of_its_circle(device):
    """B (2 pi)^2 / 2 L for any regular polygon; the tangent measure gives (tan(a) / a)^2 times that, a = pi / n."""
    for n in (5, 12):
        angle = 2.0 * np.pi * np.arange(n) / n
        points = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
        for curvature, factor in (("angle", 1.0), ("tangent", (np.tan(np.pi / n) / (np.pi / n)) ** 2)):
            scene = ddg.Scene()
            scene.add_rod(points, section=ROUND, closed=True, natural="straight", curvature=curvature)
            model = scene.build(device, "float64")
            length = n * 2.0 * np.sin(np.pi / n)
            energy = model.energies(model.state())["rod_bend_twist"]
            assert energy == pytest.approx(2.0 * np.pi**2 / length * factor, rel=1e-12)


def test_both_curvature_measures_converge_with_order_two(device):
    """Reference: elliptic integrals for a transverse tip force."""
    edges, x, z = (20, 40, 80), *tip_load.exact(10.0)[:2]
    for curvature in ("tangent", "angle"):
        errors = []
        for n in edges:
            scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
            section = ddg.Stiffness(EA=1e8, EI1=1.0)
            rod = scene.add_rod(np.linspace(0.0 * X, X, n + 1), section=section, curvature=curvature)
            scene.clamp_end(rod)
            scene.add_force(rod, -1, (0.0, 0.0, -10.0))
            errors.append(np.linalg.norm(equilibrium(scene, device, 5)[1].points()[-1] - [x, 0.0, z]))
        order = -np.polyfit(np.log(edges), np.log(errors), 1)[0]
        assert order == pytest.approx(2.0, abs=0.2 if curvature == "tangent" else 0.1)


# Free of stress every vertex rotates by its natural curvature at any twist between its edges: phi = h |k|. With the
# tangent
# measure, means of directors that differ by m = h t see cos(m / 2) of it: 2 tan(phi / 2) = h |k| / cos(m / 2).
@pytest.mark.parametrize("curvature", ["tangent", "angle"])
def test_a_twisted_natural_helix(device, curvature):
    n, first, second, twist = 10, 2.0, 1.0, 9.0
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    natural = (first, second, twist)
    scene.add_rod(np.linspace(0.0 * X, X, n + 1), section=SECTION, natural=natural, director=Y, curvature=curvature)
    scene.clamp_end(0)
    model, state = equilibrium(scene, device)
    assert sum(model.energies(state).values()) < 1e-12
    size, m = np.hypot(first, second) / n, twist / n
    phi = size if curvature == "angle" else 2.0 * np.arctan(0.5 * size / np.cos(0.5 * m))
    np.testing.assert_allclose(turning_angles(state.points()), phi, atol=1e-7)
    tangents = polyline.unit(np.diff(state.points(), axis=0))[None]
    directors = state.directors()[None]
    np.testing.assert_allclose(polyline.reference_twist(tangents, directors, False), m, atol=1e-7)
    curvatures = polyline.curvatures(tangents, directors, False, by_angle=curvature == "angle")
    np.testing.assert_allclose(curvatures, np.array([[[first]], [[second]]]) / n * np.ones((2, 1, n - 1)), atol=1e-7)


@pytest.mark.parametrize("m", [1.0, 3.0, np.pi])
def test_energy_of_any_twist(device, m):
    """B phi^2 / 2 l + C m^2 / 2 l, even at half a revolution between two edges, where the director means vanish."""
    phi = 0.6
    directors = np.array([[Z, np.cos(m) * Z - np.sin(m) * Y]])
    bent = np.array([-X, 0.0 * X, np.cos(phi) * X + np.sin(phi) * Y])
    energies = {}
    for curvature in ("angle", "tangent"):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        options = {"natural": "straight", "director": directors, "curvature": curvature}
        scene.add_rod([-X, 0.0 * X, X], section=ROUND, **options)
        model = scene.build(device, "float64")
        energies[curvature] = model.energies(model.state(points=bent))["rod_bend_twist"] - 0.4 * m**2
    assert energies["angle"] == pytest.approx(0.5 * phi**2, rel=1e-12)
    assert energies["tangent"] == pytest.approx(2.0 * (np.tan(0.5 * phi) * np.cos(0.5 * m)) ** 2, rel=1e-12, abs=1e-12)


@slow
def test_both_curvature_measures_in_one_scene(device):
    """Rods of each measure have separate groups and element sets, and one name in energies, laws and parameters."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    for curvature in ("tangent", "angle"):
        first = scene.add_rod(np.linspace(0.0 * X, X, 5), section=SECTION, curvature=curvature)
        second = scene.add_rod(np.linspace(X, X + Y, 5), section=SECTION, curvature=curvature)
        scene.join([(first, -1), (second, 0)])
        scene.add_rod(np.linspace(Z, Z + X, 5), section=SECTION, curvature=curvature)
    model = scene.build(device, "float64")
    text = model.report()
    for measure in ("rod_curvature_twist", "joint_curvature_twist"):
        assert f"{measure} x quadratic" in text and f"{measure}_angle x quadratic" in text
    assert {name.split("/")[1] for name in model.parameters() if "stiffness_2" in name} == {
        *("rod_bend_twist", "rod_bend_twist 1", "rigid_joint", "rigid_joint 1")
    }
    bent = model.state(points=model.state().points() * [1.0, 1.0, 1.0] + 0.05 * np.sin(np.arange(30))[:, None] * Y)
    before = model.energies(bent)["rod_bend_twist"]
    for number in (1, 2):
        model.set_parameter("rod_bend_twist", f"stiffness_{number}", 0.0)
    assert model.energies(bent)["rod_bend_twist"] < 0.1 * before


def test_a_fold_has_finite_energy(device):
    """B phi^2 / 2 l up to phi = pi, where 2 tan(phi / 2) is unbounded."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
    scene.add_rod([-X, 0.0 * X, X], section=ROUND, curvature="angle")
    model = scene.build(device, "float64")
    for gap in (1e-2, 1e-4, 1e-6):
        points = np.array([-X, 0.0 * X, -np.cos(gap) * X + np.sin(gap) * Z])
        energy = model.energies(model.state(points=points))["planar_bend"]
        assert energy == pytest.approx(0.5 * (np.pi - gap) ** 2, rel=1e-9)


def test_both_are_in_the_registry():
    """Every bending term of rods has both measures, under one name."""
    bending = {name for name, term in REGISTRY.items() if term.measure.span == 2 and not term.measure.by_angle}
    angles = {name.replace("_angle", "") for name, term in REGISTRY.items() if term.measure.by_angle}
    assert bending == angles
