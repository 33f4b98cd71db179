"""Hard cases of shells in statics: very thin, snapping, needles, folded meshes, sharp creases, crumpled starts.

Every solve ends in an equilibrium known from elsewhere, or in an error that names the outcome or the position.
"""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.geometry.fundamental_forms import second_form
from ddg_warp.scenes import _sze
from ddg_warp.scenes.hinged_roof import HALF_ANGLE, HALF_LENGTH, POISSON, RADIUS, YOUNG
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import Equilibrium, solve

MATERIAL = ddg.Material(young=1e9, poisson=0.3)


def equilibrium_of(scene, device, steps: int = 1):
    """Return model, equilibrium and solver of a scene."""
    model = scene.build(device, "float64")
    solver = Equilibrium(model)
    return model, solver.load(model.state(), steps), solver


def plate_deflection(device, thickness: float, pressure: float = 1.0, bending: str = "midedge_dof") -> float:
    """Return the central deflection of a unit square with immovable edges, in one load step [m]."""
    points, triangles = meshes.rectangle(10, 10, (1.0, 1.0), "crossed")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    plate = scene.add_shell(points, triangles, thickness=thickness, material=MATERIAL, bending=bending)
    scene.hold(plate, np.flatnonzero((np.minimum(points, 1.0 - points)[:, :2] < 1e-9).any(1)))
    scene.add_pressure(plate, pressure)
    _, state, solver = equilibrium_of(scene, device)
    residual = solver.tangent.loads(1.0, solver.tangent.dofs(state)) - solver.tangent.gradient(state)
    assert np.abs(residual[solver.tangent.free]).max() < 1e-9 * pressure
    return state.points()[:, 2].max()


# Square membrane of half side a: p = 1.994 (1 - 0.271 nu) / (1 - nu) E h w^3 / a^4 (Maier-Schneider, Maibach and Obermeier, J. MEMS 4,
# 1995), so w = 0.2880 (p / (E h))^(1/3) with nu = 0.3 and a = 1/2.
@pytest.mark.parametrize("bending", [pytest.param("midedge_dof", marks=pytest.mark.slow), "hinge"])
@pytest.mark.parametrize("thickness", [pytest.param(1e-4, marks=pytest.mark.slow), 1e-5])
def test_very_thin_plate_is_a_membrane(device, thickness, bending):
    """The deflection is 60 and 1300 thicknesses in one step, from a flat state with bending stiffness alone.

    The first iterate of the plate without stretch is 40 m high; its forces must not enter the load scale of later ones.
    """
    height = plate_deflection(device, thickness, bending=bending)
    assert height / (1.0 / (MATERIAL.young * thickness)) ** (1.0 / 3.0) == pytest.approx(0.2880, rel=5e-3)
    more = plate_deflection(device, thickness, 1000.0, bending)  # strains are no longer small: 0.7 and 3 percent
    assert more / height == pytest.approx(10.0, rel=0.02)


def test_snap_through_in_one_step(device):
    """A roof above the limit load of about 2230 N reaches the same minimum on the other side in one step or ten."""
    flat, triangles = _sze.sheet(4, 4, (1.0, 1.0), "crossed")
    points = _sze.cylinder_part(flat, RADIUS, HALF_LENGTH, HALF_ANGLE)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    roof = scene.add_shell(points, triangles, thickness=12.7, material=ddg.Material(YOUNG, POISSON))
    scene.symmetry(roof, _sze.side(flat, 0, 0.0), "y")
    scene.symmetry(roof, _sze.side(flat, 1, 0.0), "z")
    scene.hold(roof, _sze.side(flat, 0, 1.0))
    scene.add_vertex_force(roof, [0], (-3000.0 / 4.0, 0.0, 0.0))
    (model, once, _), (_, often, _) = equilibrium_of(scene, device), equilibrium_of(scene, device, 10)
    rise = RADIUS * (1.0 - np.cos(HALF_ANGLE))
    assert RADIUS - once.points()[0, 0] > 2.0 * rise
    assert once.points() == pytest.approx(often.points(), abs=1e-6)
    assert spectrum(model, once, 1, "unit").stable


def needles(device, aspect: float, gravity: float):
    """Return the end deflection of a clamped strip with cells of an aspect ratio, relative to a beam.

    nu = 0, under its weight.
    """
    points, triangles = meshes.rectangle(8, 4, (1.0, 0.5 / aspect), "right")
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity))
    strip = scene.add_shell(points, triangles, thickness=1e-3, material=ddg.Material(1e9, 0.0, density=10.0))
    scene.clamp_boundary(strip, np.flatnonzero(points[:, 0] < 1e-9))
    beam = 10.0 * 1e-3 * gravity / (8.0 * 1e9 * 1e-9 / 12.0)  # q L^4 / (8 EI), for the width
    return -equilibrium_of(scene, device)[1].points()[:, 2].min() / beam


@pytest.mark.parametrize("aspect", [30.0, pytest.param(1000.0, marks=pytest.mark.slow)])
def test_needles(device, aspect):
    """Triangles a thousand times as long as wide bend like a beam, 1.5 % soft at 8 cells, as compact ones do."""
    assert needles(device, aspect, 0.01) == pytest.approx(1.0156, abs=2e-3)


@pytest.mark.slow
def test_loads_lost_in_rounding_are_named(device):
    """Needles of aspect 1e4 are so stiff across that rounding of forces exceeds the weight: no state counts as equilibrium."""
    with pytest.raises(ddg.SolverError, match=r"lost_in_rounding.*better shaped") as caught:
        needles(device, 1e4, 0.01)
    assert caught.value.outcome == "lost_in_rounding"
    assert np.isfinite(caught.value.state.points()).all()


def square_with_sliver(shift: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Return a square of 4 x 4 cells with the middle vertex shifted towards a neighbour by a number of cells."""
    points, triangles = meshes.rectangle(4, 4)
    points[12, 0] += 0.25 * shift
    return points, triangles, 12


@pytest.mark.slow
def test_slivers(device):
    """A vertex 1e-3 and 4e-6 cells from the next keeps the deflection of a clamped square within 3 %; nearer is refused."""
    heights = []
    for shift in (0.0, 0.999, 1.0 - 4e-6, 1.0 - 1e-12):
        points, triangles, _ = square_with_sliver(shift)
        scene = ddg.Scene(gravity=(0.0, 0.0, -1.0))
        material = ddg.Material(1e6, 0.3, density=1.0)
        if shift > 1.0 - 1e-9:
            with pytest.raises(ddg.SceneError, match=r"triangle \d+ is degenerate"):
                scene.add_shell(points, triangles, thickness=1e-2, material=material)
            continue
        sheet = scene.add_shell(points, triangles, thickness=1e-2, material=material)
        scene.clamp_boundary(sheet, np.flatnonzero(points[:, 0] < 1e-9))
        heights.append(equilibrium_of(scene, device)[1].points()[:, 2].min())
    assert heights == pytest.approx([heights[0]] * 3, rel=0.03)


@pytest.mark.parametrize("bending", ["midedge_dof", "hinge"])
@pytest.mark.parametrize("rest", ["shape", "flat"])
def test_inverted_triangles_are_refused(device, bending, rest):
    """A vertex moved past a neighbour in the plane: triangles overlap at an angle of +pi or -pi."""
    points, triangles, _ = square_with_sliver(1.2)
    scene = ddg.Scene()
    scene.hold(scene.add_shell(points, triangles, thickness=1e-2, material=MATERIAL, bending=bending, rest=rest), [0])
    with pytest.raises(ddg.SceneError, match=r"triangles \d+ and \d+ fold back .*vertices \d+ and \d+.*move a vertex"):
        scene.build(device, "float64")


@pytest.mark.parametrize("degrees", [-175.0, -120.0, 60.0, 91.0, 150.0, 175.0])
def test_energy_and_moment_of_a_fold(device, degrees):
    """Folds of a unit square along the diagonal have energy D t^2 / 2 and moment D t at any dihedral angle t.

    c0 = -2 h t / 2 of the diagonal, h = 1 / sqrt 2 the height of both triangles over it. Free edges rotate, so that c1
    and c2 minimise D/2 A tr(K^2), nu = 0, with a1 . K a2 = c0: K = 2 c0 sym(a1 x a2), a1 and a2 the sides; D A c0^2 = D
    t^2 / 4 each.
    """
    points, triangles = meshes.rectangle(1, 1, (1.0, 1.0), "right")
    far = next(i for i in range(4) if np.sum(triangles == i) == 1)
    on = np.setdiff1d(np.flatnonzero([np.sum(triangles == i) == 2 for i in range(4)]), [far])
    axis, angle = points[on[1]] - points[on[0]], np.radians(degrees)
    if np.dot(np.cross(axis, points[far] - points[on[0]]), [0.0, 0.0, 1.0]) > 0.0:
        axis = -axis  # a positive rotation folds the far corner down, convex on the side of the normals
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    sheet = scene.add_shell(points, triangles, thickness=1e-2, material=ddg.Material(1e6, 0.0))
    scene.hold(sheet, np.setdiff1d(range(4), [far]))
    scene.hold(sheet, [far], motion=ddg.Motion(angle=lambda t: angle * t, axis=tuple(axis), pivot=tuple(points[on[0]])))
    model, state, solver = equilibrium_of(scene, device, 7)
    stiffness = 1e6 * 1e-2**3 / 12.0
    assert model.energies(state)["shell_bend_dof"] == pytest.approx(0.5 * stiffness * angle**2, rel=1e-9)
    force = solver.tangent.gradient(state)[solver.tangent.point_dofs()[far]]
    arm = state.points()[far] - points[on[0]]
    moment = np.cross(arm, force) @ axis / np.linalg.norm(axis)
    assert moment == pytest.approx(stiffness * angle, rel=1e-9)
    assert np.abs(state.coupled.q.numpy()[4:, 0]).max() < 0.5 * np.pi


def creased(device, bending="hinge"):
    """Return the model, host shell and mid-span mesh edges of a strip clamped at one end."""
    points, triangles = meshes.rectangle(8, 4, (1.0, 0.5))
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    strip = scene.add_shell(points, triangles, thickness=1e-3, material=MATERIAL, bending=bending)
    scene.clamp_boundary(strip, np.flatnonzero(points[:, 0] < 1e-9))
    model = scene.build(device, "float64")
    shell = model.coupled.host.shells[strip]
    return model, shell, shell.surface.edges_on(np.abs(points[:, 0] - 0.5) < 1e-9)


def folded(points, angle):
    """Return a strip with the half x > 0.5 rotated down about the line x = 0.5."""
    beyond = np.maximum(points[:, 0] - 0.5, 0.0)
    return np.stack([points[:, 0] - (1.0 - np.cos(angle)) * beyond, points[:, 1], -np.sin(angle) * beyond], -1)


FIVE = (35.0, 70.0, 105.0, 140.0, 175.0)


@pytest.mark.parametrize(
    ("bending", "steps"), [("midedge_dof", FIVE), ("midedge_dof", (175.0,)), ("midedge", FIVE), ("hinge", FIVE)]
)
def test_crease_of_175_degrees(device, bending, steps):
    """Rest angles or curvatures in steps fold the free half by exactly that angle, without strain.

    Stresses of the previous rest shape do not mislead the first tangent: a few iterations a step.
    """
    model, shell, edges = creased(device, bending)
    solver, state, edges = Equilibrium(model), model.state(), np.isin(np.arange(len(shell.surface.edges)), edges)
    for degrees in steps:
        if bending == "hinge":
            model.set_rest(0, angle=np.where(edges, np.radians(degrees), 0.0))
        else:
            shape = folded(model.scene.shells[0].points, np.radians(degrees))
            model.set_rest(0, curvature=second_form(shell.surface, shape, shell.kinds))
        state = solver.solve(state, 1.0, 1.0)
    assert solver.iterations <= 10 * len(steps)
    x, _, z = state.points()[8]
    assert np.degrees(np.arctan2(z, x - 0.5)) == pytest.approx(-175.0, abs=1e-6)
    assert np.hypot(x - 0.5, z) == pytest.approx(0.5, abs=1e-9)
    assert sum(model.energies(state).values()) < 1e-12


def test_crease_at_once(device):
    """The whole angle set at once folds the sheet without energy."""
    model, shell, edges = creased(device)
    angle = np.zeros(len(shell.surface.edges))
    angle[edges] = np.radians(175.0)
    model.set_rest(0, angle=angle)
    solver = Equilibrium(model)
    state = solver.solve(model.state(), 1.0, 1.0)
    x, _, z = state.points()[8]
    assert np.degrees(np.arctan2(z, x - 0.5)) == pytest.approx(-175.0, abs=1e-6)
    assert sum(model.energies(state).values()) < 1e-12
    assert solver.iterations <= 100


@pytest.mark.parametrize(
    "bending", [*(pytest.param(name, marks=pytest.mark.slow) for name in ("midedge_dof", "midedge")), "hinge"]
)
@pytest.mark.parametrize("size", [pytest.param(0.3, marks=pytest.mark.slow), 0.6])
def test_crumpled_sheet_becomes_flat(device, bending, size):
    """Random starts of up to `size` edge lengths relax to the flat sheet without energy; one side is clamped."""
    points, triangles = meshes.rectangle(8, 8)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    sheet = scene.add_shell(points, triangles, thickness=1e-2, material=ddg.Material(1e6, 0.3), bending=bending)
    side = points[:, 0] < 1e-9
    scene.clamp_boundary(sheet, np.flatnonzero(side))
    model = scene.build(device, "float64")
    start = points + 0.125 * size * np.random.default_rng(0).uniform(-1.0, 1.0, points.shape) * ~side[:, None]
    before = sum(model.energies(model.state(points=start)).values())
    state = Equilibrium(model).solve(model.state(points=start), 1.0, 1.0)
    assert state.points() == pytest.approx(points, abs=1e-6)
    assert sum(model.energies(state).values()) < 1e-12 * before


@pytest.mark.parametrize("both", [False, True], ids=["each its own", "the same"])
def test_two_motions_of_a_point(device, both):
    """The corner of two moving edges takes one component from each motion; one component from both is refused."""
    points, triangles = meshes.rectangle(2, 2)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    sheet = scene.add_shell(points, triangles, thickness=1e-2, material=MATERIAL)
    scene.hold(sheet, range(len(points)), "z")
    for axis, components in enumerate("xy"):
        motion = ddg.Motion(translation=lambda t, axis=axis: tuple(0.1 * t * np.eye(3)[axis]))
        scene.hold(sheet, np.flatnonzero(points[:, axis] > 1.0 - 1e-9), "xy" if both else components, motion=motion)
        if not both:
            scene.hold(sheet, np.flatnonzero(points[:, axis] < 1e-9), components)
    if both:
        with pytest.raises(ddg.SceneError, match=r"point at \(1, 1, 0\) m has two motions along x.*give it one"):
            scene.build(device, "float64")
        return
    state = solve(scene.build(device, "float64"))
    np.testing.assert_allclose(state.points(), points * [1.1, 1.1, 1.0], atol=1e-9)


def test_curved_membrane_is_for_statics(device):
    """A sheet with the curved membrane sags in statics; dynamics refuses it by name and remedy."""
    points, triangles = meshes.rectangle(4, 4)
    scene = ddg.Scene()
    material = ddg.Material(young=1e6, poisson=0.3, density=100.0)
    sheet = scene.add_shell(points, triangles, thickness=0.01, material=material, membrane="curved", name="flag")
    scene.clamp_boundary(sheet, np.flatnonzero(points[:, 0] < 1e-9))
    model = scene.build(device, "float64")
    assert Equilibrium(model).load(model.state(), 2).points()[:, 2].min() < -0.01
    with pytest.raises(ddg.SceneError, match=r"shell 0 \('flag'\): membrane 'curved'.*membrane='flat'"):
        ddg.Integrator(model).step(model.state(), 0.01)
