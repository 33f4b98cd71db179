"""Hard cases of coupled systems in dynamics: crumpled, folded, thin, in long steps, on bad meshes.

Every run ends in finite states by converged steps only, or in an error that names outcome, position and remedy.
"""

import numpy as np
import pytest
from hard_run import attempt

import ddg_warp as ddg
from ddg_warp.geometry import meshes

RUBBER = ddg.Material(young=1e6, poisson=0.3, density=1000.0)
BENDING = ("midedge_dof", "hinge")


def sheet(cells=8, bending="midedge_dof", thickness=1e-2, gravity=0.0, material=RUBBER, **options) -> ddg.Scene:
    points, triangles = meshes.rectangle(cells, cells, (1.0, 1.0), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity))
    scene.add_shell(points, triangles, thickness=thickness, material=material, bending=bending, **options)
    return scene


def run(scene, device, dt, count, start=None, **options):
    """Return the last state and total energies; failed steps were retried, or an error names outcome and position."""
    return attempt(scene, device, dt, count, ("world 0", "of shell 0", "smaller dt"), start, **options)[1:]


def assert_energy_never_grows(energy) -> None:
    assert np.diff(energy).max() <= 1e-8 * (np.ptp(energy) + np.abs(energy).max())


def edge_strain(scene, state) -> float:
    """Return the largest relative change of an edge length."""
    shell = scene.shells[0]
    edges = np.concatenate([shell.triangles[:, [0, 1]], shell.triangles[:, [1, 2]], shell.triangles[:, [2, 0]]])
    rest_lengths, lengths = (
        np.linalg.norm(p[edges[:, 1]] - p[edges[:, 0]], axis=1) for p in (shell.points, state.points())
    )
    return float(np.abs(lengths / rest_lengths - 1.0).max())


@pytest.mark.parametrize("size", [0.1, 0.5, 1.0], ids=["crumpled", "inverted", "scrambled"])
@pytest.mark.parametrize("bending", BENDING)
def test_random_perturbation(device, bending, size):
    """Vertices moved by a fraction of the cells, which inverts triangles: the sheet springs back, and energy only falls."""
    scene = sheet(6, bending)
    start = scene.shells[0].points
    start = start + size / 6.0 * np.random.default_rng(1).normal(size=start.shape)
    state, energy, statistics, _ = run(scene, device, 0.01, 10, start)
    assert_energy_never_grows(energy)
    assert statistics["retries"] == 0
    assert energy[-1] < 0.2 * energy[0]
    assert edge_strain(scene, state) < 0.5


@pytest.mark.parametrize("thickness", [1e-3, pytest.param(1e-4, marks=pytest.mark.slow)])
def test_random_perturbation_in_long_steps(device, thickness):
    """A thin sheet of 144 cells with inverted triangles, steps of 0.1 s: no step fails, and ten steps leave little energy."""
    scene = sheet(12, thickness=thickness)
    start = scene.shells[0].points
    start = start + 0.5 / 12.0 * np.random.default_rng(1).normal(size=start.shape)
    _, energy, statistics, _ = run(scene, device, 0.1, 10, start)
    assert_energy_never_grows(energy)
    assert statistics["retries"] == 0
    assert energy[-1] < 1e-4 * energy[0]


@pytest.mark.parametrize("bending", BENDING)
def test_thickness_of_a_ten_thousandth(device, bending):
    """A sheet of h / L = 1e-4 hangs from two corners and swings, stretched by its weight alone."""
    scene = sheet(8, bending, thickness=1e-4, gravity=9.81, material=ddg.Material(1e8, 0.3, 1000.0))
    scene.hold(0, [0, 8])
    state, energy, statistics, _ = run(scene, device, 0.01, 20)
    assert_energy_never_grows(energy)
    assert statistics["retries"] == 0
    assert edge_strain(scene, state) < 0.02
    assert state.points()[:, 2].min() < -0.1


@pytest.mark.parametrize("bending", BENDING)
@pytest.mark.parametrize("dt", [1.0 / 30.0, 0.2])
def test_long_steps(device, bending, dt):
    """The step is far beyond the wave time of a hanging sheet: 1e6 Pa, cells of 1/8 m, sqrt(E / rho) h / l = 8 and 50."""
    scene = sheet(8, bending, thickness=1e-3, gravity=9.81)
    scene.hold(0, [0, 8])
    _, energy, statistics, _ = run(scene, device, dt, 12)
    assert_energy_never_grows(energy)
    assert statistics["newton_iterations"]["mean"] < 40


def folded(points, angle: float, x0: float = 0.0) -> np.ndarray:
    """Return points with the half x > x0 rotated about the y axis through x0 by an angle."""
    x = points[:, 0] - x0
    beyond = np.maximum(x, 0.0)
    return np.stack([x0 + np.minimum(x, 0.0) + beyond * np.cos(angle), points[:, 1], beyond * np.sin(angle)], -1)


@pytest.mark.parametrize("bending", BENDING)
@pytest.mark.parametrize("degrees", [85.0, 175.0])
def test_crease_opens(device, bending, degrees):
    """A flat sheet released from a fold opens, and energy only falls; rotating normals do not flip."""
    scene = sheet(4, bending)
    points = scene.shells[0].points
    start = folded(points, np.radians(degrees), float(np.median(points[:, 0])))
    state, energy, statistics, _ = run(scene, device, 0.02, 40, start)
    assert_energy_never_grows(energy)
    assert statistics["retries"] == 0
    far = points[:, 0] == points[:, 0].max()
    assert np.abs(state.points()[far] - start[far]).max() > 0.05
    assert np.abs(state.coupled.q.numpy()[len(points) :, 0]).max(initial=0.0) < 0.5 * np.pi


@pytest.mark.parametrize("bending", BENDING)
def test_crease_of_175_degrees_at_rest_stays(device, bending):
    """A sheet with a rest shape creased by 175 degrees stays at rest."""
    points, triangles = meshes.rectangle(4, 4, (1.0, 1.0), "alternating")
    points = folded(points, np.radians(175.0), float(np.median(points[:, 0])))
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_shell(points, triangles, thickness=1e-2, material=RUBBER, bending=bending)
    state, _, _, _ = run(scene, device, 0.02, 5)
    np.testing.assert_allclose(state.points(), points, atol=1e-9)


@pytest.mark.parametrize("bending", BENDING)
def test_needle_triangles(device, bending):
    """Cells of 1 : 1000 stay finite and fall freely in their rest shape."""
    points, triangles = meshes.rectangle(4, 4, (1.0, 1e-3), "right")
    scene = ddg.Scene()
    scene.add_shell(points, triangles, thickness=1e-3, material=RUBBER, bending=bending)
    state, _, _, _ = run(scene, device, 0.01, 5)
    np.testing.assert_allclose(state.points() - points, [[0.0, 0.0, -9.81 * 1e-4 * 15.0]] * len(points), atol=1e-9)


def test_triangles_without_area_are_refused(device):
    points, triangles = meshes.rectangle(2, 2, (1.0, 1.0), "right")
    points[4] = points[3] + 0.5 * (points[5] - points[3])
    points[4], points[1] = points[3], points[1]
    scene = ddg.Scene()
    with pytest.raises(ddg.SceneError, match="triangle"):
        scene.add_shell(points, triangles, thickness=1e-3, material=RUBBER)
        scene.build(device)


def test_inverted_neighbours_are_refused(device):
    """Neighbouring triangles of opposite orientation form no surface."""
    points, triangles = meshes.rectangle(2, 2, (1.0, 1.0), "right")
    triangles = np.array(triangles)
    triangles[3] = triangles[3][::-1]
    scene = ddg.Scene()
    with pytest.raises(ddg.SceneError, match="triangle"):
        scene.add_shell(points, triangles, thickness=1e-3, material=RUBBER)
        scene.build(device)


@pytest.mark.parametrize("bending", BENDING)
def test_collapsed_to_a_point(device, bending):
    """Coincident vertices have no direction: the run ends with a named outcome."""
    scene = sheet(3, bending)
    *_, error = run(scene, device, 0.01, 3, np.zeros((16, 3)), fails=("non_finite",))
    assert error.outcome == "non_finite"


def test_crumpled_between_moving_supports(device):
    """Opposite sides approach in 0.5 s, in steps of 1/30 s: the sheet folds and keeps lengths."""
    scene = sheet(16, "hinge", thickness=2e-3)
    points = scene.shells[0].points
    noise = 1e-3 * np.random.default_rng(0).normal(size=points.shape)
    for end, sign in ((points[:, 0].min(), 1.0), (points[:, 0].max(), -1.0)):
        motion = ddg.Motion(translation=lambda t, sign=sign: (sign * 0.33 * min(1.0, t / 0.5), 0.0, 0.0))
        edge = np.flatnonzero(points[:, 0] == end)
        noise[edge] = 0.0
        scene.hold(0, edge, motion=motion)
    state, _, statistics, _ = run(scene, device, 1.0 / 30.0, 20, points + noise)
    assert edge_strain(scene, state) < 0.15
    assert statistics["newton_iterations"]["mean"] < 60
