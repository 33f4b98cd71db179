"""Hard cases of shells in statics: very thin, snapping, needles, folded meshes, sharp creases, crumpled starts.

Every search must end in an equilibrium that is known from elsewhere, or in an error that names its outcome or the place.
"""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.geometry.shell_forms import second_form
from ddg_warp.scenes import _sze
from ddg_warp.scenes.hinged_roof import HALF_ANGLE, HALF_LENGTH, POISSON, RADIUS, YOUNG
from ddg_warp.solve.stability import spectrum
from ddg_warp.solve.statics import Equilibrium, solve

MATERIAL = ddg.Material(young=1e9, poisson=0.3)


def found(scene, device, steps: int = 1):
    """Model, equilibrium and solver of a scene."""
    model = scene.build(device, "float64")
    solver = Equilibrium(model)
    return model, solver.load(model.state(), steps), solver


def pressed_plate(device, thickness: float, pressure: float = 1.0, bending: str = "midedge_dof") -> float:
    """Deflection of the centre of a unit square on supports that hold it in its plane, in one load step [m]."""
    points, triangles = meshes.rectangle(10, 10, (1.0, 1.0), "crossed")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    plate = scene.add_shell(points, triangles, thickness=thickness, material=MATERIAL, bending=bending)
    scene.hold(plate, np.flatnonzero((np.minimum(points, 1.0 - points)[:, :2] < 1e-9).any(1)))
    scene.add_pressure(plate, pressure)
    _, state, solver = found(scene, device)
    residual = solver.tangent.loads(1.0, solver.tangent.dofs(state)) - solver.tangent.gradient(state)
    assert np.abs(residual[solver.tangent.free]).max() < 1e-9 * pressure
    return state.points()[:, 2].max()


# Square membrane of half side a: p = 1.994 (1 - 0.271 nu) / (1 - nu) E h w^3 / a^4 (Maier-Schneider, Maibach and Obermeier, J. MEMS 4,
# 1995), so w = 0.2880 (p / (E h))^(1/3) with nu = 0.3 and a = 1/2.
@pytest.mark.parametrize("bending", [pytest.param("midedge_dof", marks=pytest.mark.slow), "hinge"])
@pytest.mark.parametrize("thickness", [pytest.param(1e-4, marks=pytest.mark.slow), 1e-5])
def test_very_thin_plate_is_a_membrane(device, thickness, bending):
    """A deflection of 60 and 1300 thicknesses at once, from a flat state whose tangent is that of bending alone.

    The first iterate of the plate without stretch is 40 m high; its forces must not excuse the residuals of later ones.
    """
    height = pressed_plate(device, thickness, bending=bending)
    assert height / (1.0 / (MATERIAL.young * thickness)) ** (1.0 / 3.0) == pytest.approx(0.2880, rel=5e-3)
    more = pressed_plate(device, thickness, 1000.0, bending)  # strains are no longer small: 0.7 and 3 percent
    assert more / height == pytest.approx(10.0, rel=0.02)


def test_snap_through_in_one_step(device):
    """The roof loaded above its limit load of about 2230 N: one step or ten, it ends at the same minimum on the other side."""
    flat, triangles = _sze.sheet(4, 4, (1.0, 1.0), "crossed")
    points = _sze.cylinder_part(flat, RADIUS, HALF_LENGTH, HALF_ANGLE)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    roof = scene.add_shell(points, triangles, thickness=12.7, material=ddg.Material(YOUNG, POISSON))
    scene.symmetry(roof, _sze.side(flat, 0, 0.0), "y")
    scene.symmetry(roof, _sze.side(flat, 1, 0.0), "z")
    scene.hold(roof, _sze.side(flat, 0, 1.0))
    scene.add_vertex_force(roof, [0], (-3000.0 / 4.0, 0.0, 0.0))
    (model, once, _), (_, often, _) = found(scene, device), found(scene, device, 10)
    rise = RADIUS * (1.0 - np.cos(HALF_ANGLE))
    assert RADIUS - once.points()[0, 0] > 2.0 * rise
    assert once.points() == pytest.approx(often.points(), abs=1e-6)
    assert spectrum(model, once, 1, "unit").stable


def needles(device, aspect: float, gravity: float):
    """A clamped strip with cells of this aspect ratio, nu = 0, under its weight: deflection of the end over that of a beam."""
    points, triangles = meshes.rectangle(8, 4, (1.0, 0.5 / aspect), "right")
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity))
    strip = scene.add_shell(points, triangles, thickness=1e-3, material=ddg.Material(1e9, 0.0, density=10.0))
    scene.clamp_boundary(strip, np.flatnonzero(points[:, 0] < 1e-9))
    beam = 10.0 * 1e-3 * gravity / (8.0 * 1e9 * 1e-9 / 12.0)  # q L^4 / (8 EI), for the width
    return -found(scene, device)[1].points()[:, 2].min() / beam


@pytest.mark.parametrize("aspect", [30.0, pytest.param(1000.0, marks=pytest.mark.slow)])
def test_needles(device, aspect):
    """Triangles a thousand times as long as wide bend like a beam, as those of a few times do: 1.5 % soft at 8 cells."""
    assert needles(device, aspect, 0.01) == pytest.approx(1.0156, abs=2e-3)


@pytest.mark.slow
def test_loads_lost_in_rounding_are_named(device):
    """Ten times longer ones are so stiff across that rounding of their forces exceeds the weight: no state is called equilibrium."""
    with pytest.raises(ddg.SolverError, match=r"lost_in_rounding.*better shaped") as caught:
        needles(device, 1e4, 0.01)
    assert caught.value.outcome == "lost_in_rounding"
    assert np.isfinite(caught.value.state.points()).all()


def moved(shift: float) -> tuple[np.ndarray, np.ndarray, int]:
    """A square of 4 x 4 cells whose middle vertex is shifted towards its neighbour by so many cells."""
    points, triangles = meshes.rectangle(4, 4)
    points[12, 0] += 0.25 * shift
    return points, triangles, 12


@pytest.mark.slow
def test_slivers(device):
    """A vertex moved to 1e-3 and 4e-6 cells of the next leaves the deflection of a clamped square within 3 %; nearer is refused."""
    heights = []
    for shift in (0.0, 0.999, 1.0 - 4e-6, 1.0 - 1e-12):
        points, triangles, _ = moved(shift)
        scene = ddg.Scene(gravity=(0.0, 0.0, -1.0))
        material = ddg.Material(1e6, 0.3, density=1.0)
        if shift > 1.0 - 1e-9:
            with pytest.raises(ddg.SceneError, match=r"triangle \d+ is degenerate"):
                scene.add_shell(points, triangles, thickness=1e-2, material=material)
            continue
        sheet = scene.add_shell(points, triangles, thickness=1e-2, material=material)
        scene.clamp_boundary(sheet, np.flatnonzero(points[:, 0] < 1e-9))
        heights.append(found(scene, device)[1].points()[:, 2].min())
    assert heights == pytest.approx([heights[0]] * 3, rel=0.03)


@pytest.mark.parametrize("bending", ["midedge_dof", "hinge"])
@pytest.mark.parametrize("rest", ["shape", "flat"])
def test_inverted_triangles_are_refused(device, bending, rest):
    """A vertex moved past its neighbour, in the plane: triangles lie on others, with an angle of as well +pi as -pi."""
    points, triangles, _ = moved(1.2)
    scene = ddg.Scene()
    scene.hold(scene.add_shell(points, triangles, thickness=1e-2, material=MATERIAL, bending=bending, rest=rest), [0])
    with pytest.raises(ddg.SceneError, match=r"triangles \d+ and \d+ fold back .*vertices \d+ and \d+.*move a vertex"):
        scene.build(device, "float64")


@pytest.mark.parametrize("degrees", [-175.0, -120.0, 60.0, 91.0, 150.0, 175.0])
def test_fold_is_held(device, degrees):
    """A unit square folded along its diagonal and held: energy D t^2 / 2 and moment D t of the dihedral angle t, at any fold.

    c0 = -2 h t / 2 of the diagonal, h = 1 / sqrt 2 the height of both triangles over it. Free edges turn, so that c1 and c2 are those
    of least D/2 A tr(K^2), nu = 0, with a1 . K a2 = c0: K = 2 c0 sym(a1 x a2), a1 and a2 the sides; D A c0^2 = D t^2 / 4 each.
    """
    points, triangles = meshes.rectangle(1, 1, (1.0, 1.0), "right")
    far = next(i for i in range(4) if np.sum(triangles == i) == 1)
    on = np.setdiff1d(np.flatnonzero([np.sum(triangles == i) == 2 for i in range(4)]), [far])
    axis, angle = points[on[1]] - points[on[0]], np.radians(degrees)
    if np.dot(np.cross(axis, points[far] - points[on[0]]), [0.0, 0.0, 1.0]) > 0.0:
        axis = -axis  # a positive turn folds the far corner down, convex on the side of the normals
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    sheet = scene.add_shell(points, triangles, thickness=1e-2, material=ddg.Material(1e6, 0.0))
    scene.hold(sheet, np.setdiff1d(range(4), [far]))
    scene.hold(sheet, [far], motion=ddg.Motion(angle=lambda t: angle * t, axis=tuple(axis), pivot=tuple(points[on[0]])))
    model, state, solver = found(scene, device, 7)
    stiffness = 1e6 * 1e-2**3 / 12.0
    assert model.energies(state)["shell_bend_dof"] == pytest.approx(0.5 * stiffness * angle**2, rel=1e-9)
    force = solver.tangent.gradient(state)[solver.tangent.point_dofs()[far]]
    arm = state.points()[far] - points[on[0]]
    moment = np.cross(arm, force) @ axis / np.linalg.norm(axis)
    assert moment == pytest.approx(stiffness * angle, rel=1e-9)
    assert np.abs(state.net.q.numpy()[4:, 0]).max() < 0.5 * np.pi


def creased(device, bending="hinge"):
    """A strip, clamped at one end, its model, its shell on the host, and the mesh edges across its middle."""
    points, triangles = meshes.rectangle(8, 4, (1.0, 0.5))
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    strip = scene.add_shell(points, triangles, thickness=1e-3, material=MATERIAL, bending=bending)
    scene.clamp_boundary(strip, np.flatnonzero(points[:, 0] < 1e-9))
    model = scene.build(device, "float64")
    shell = model.net.host.shells[strip]
    return model, shell, shell.surface.edges_on(np.abs(points[:, 0] - 0.5) < 1e-9)


def folded(points, angle):
    """A strip whose half x > 0.5 is turned down about the line x = 0.5."""
    ahead = np.maximum(points[:, 0] - 0.5, 0.0)
    return np.stack([points[:, 0] - (1.0 - np.cos(angle)) * ahead, points[:, 1], -np.sin(angle) * ahead], -1)


FIVE = (35.0, 70.0, 105.0, 140.0, 175.0)


@pytest.mark.parametrize(
    ("bending", "steps"), [("midedge_dof", FIVE), ("midedge_dof", (175.0,)), ("midedge", FIVE), ("hinge", FIVE)]
)
def test_crease_of_175_degrees(device, bending, steps):
    """Rest angles or curvatures in steps: the free half folds over the held one by exactly that, and nothing is strained.

    Stresses of the rest shape before do not mislead the first tangent: a few iterations a step.
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
    """All of the angle set at once: the search folds the sheet to it, without energy, or names what it could not do."""
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
    """Every vertex but those of one clamped side moved at random by up to `size` edge lengths: back to rest, without energy."""
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
    """The corner between two edges that move apart takes each component from its motion; the same one from both is refused."""
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
    """A sheet with it sags in statics; dynamics, whose matrix loses it, refuses it by name and remedy."""
    points, triangles = meshes.rectangle(4, 4)
    scene = ddg.Scene()
    material = ddg.Material(young=1e6, poisson=0.3, density=100.0)
    sheet = scene.add_shell(points, triangles, thickness=0.01, material=material, membrane="curved", name="flag")
    scene.clamp_boundary(sheet, np.flatnonzero(points[:, 0] < 1e-9))
    model = scene.build(device, "float64")
    assert Equilibrium(model).load(model.state(), 2).points()[:, 2].min() < -0.01
    with pytest.raises(ddg.SceneError, match=r"shell 0 \('flag'\): membrane 'curved'.*membrane='flat'"):
        ddg.Integrator(model).step(model.state(), 0.01)
