"""Element sets of shells against closed forms: energies of exact shapes with observed orders, and what they must be equal to.

Energy per area of a plate that is flat at rest, with D = E h^3 / (12 (1 - nu^2)): D/2 [(tr b)^2 - 2 (1 - nu) det b], so
D / (2 R^2) on a cylinder, D (1 + nu) / R^2 on a sphere, D (1 - nu) k^2 on a saddle of curvatures k, -k.
"""

import numpy as np
import pytest
from shell_cases import Surface, cylinder, gather, relaxed_angles, saddle, sphere, square

from ddg_warp import shells
from ddg_warp.errors import SceneError
from ddg_warp.shell_geometry import edge_angles, edge_kinds, metric, second_form

NU = 0.3
RADIUS = 2.0
SHAPES = {
    "cylinder 0": (lambda points: cylinder(points, 0.0), 0.5 / RADIUS**2),
    "cylinder 20": (lambda points: cylinder(points, 20.0), 0.5 / RADIUS**2),
    "cylinder 45": (lambda points: cylinder(points, 45.0), 0.5 / RADIUS**2),
    "sphere": (sphere, (1.0 + NU) / RADIUS**2),
    "saddle 0": (lambda points: saddle(points, 0.005), (1.0 - NU) * 0.005**2),
    "saddle 45": (lambda points: saddle(points, 0.005, 45.0), (1.0 - NU) * 0.005**2),
}
UNIT_D = 12.0 * (1.0 - NU**2)  # Young's modulus of a plate of thickness 1 with D = 1


def flat_plate(surface, place, kinds, **options):
    return shells.plate(surface, place, 1.0, UNIT_D, NU, kinds, "flat", **options)


def relative_error(mesh, n, shape, bending, device, supported):
    """Relative error of the energy per area: of the whole square, clamped to the exact normals all around; or of the triangles
    inside [0.2, 0.8]^2 of a free one."""
    points, triangles = square(mesh, n)
    surface = Surface(triangles)
    exact, reference = SHAPES[shape]
    place, _ = exact(points)
    _, normals = exact(points[surface.edges].mean(1))
    clamped = {edge: normals[edge] for edge in np.flatnonzero(surface.boundary)} if supported else {}
    kinds = edge_kinds(surface, clamped)
    plate = flat_plate(surface, place, kinds)
    _, bend = shells.shell_elements(surface, plate, kinds, bending)
    angles = relaxed_angles(bend, place, kinds.turning, device) if bending == "midedge_dof" else None
    energy = gather(bend, place, angles).evaluate(device=device)["energy"][:, 0]
    span = points.max(0)
    middle = points[triangles].mean(1) / span
    inside = np.full(len(energy), True) if supported else (np.abs(middle - 0.5) < 0.3).all(1)
    return energy[inside].sum() / plate.area[inside].sum() / reference - 1.0


def order(counts, errors):
    return -np.polyfit(np.log(counts), np.log(np.abs(errors)), 1)[0]


@pytest.mark.parametrize("shape", ["cylinder 20", "cylinder 45"])
@pytest.mark.parametrize("mesh", ["right", "jittered"])
def test_curved_membrane_bends_without_stretch(device, mesh, shape):
    """A sheet rolled up isometrically: facets have strains of order 2 in their size, arcs over their sides of order 3 or more.

    Energies go with the squares. Free sheets, whose mid-edge normals are those of least bending energy; triangles in the middle.
    """
    counts, energies = (8, 16, 32), {"flat": [], "curved": []}
    for n in counts:
        points, triangles = square(mesh, n)
        surface = Surface(triangles)
        kinds = edge_kinds(surface)
        plate = flat_plate(surface, np.column_stack([points, np.zeros(len(points))]), kinds)
        place, _ = SHAPES[shape][0](points)
        inside = (np.abs(points[triangles].mean(1) - 0.5) < 0.3).all(1)
        for membrane, results in energies.items():
            stretch, bend = shells.shell_elements(surface, plate, kinds, "midedge_dof", membrane)
            angles = relaxed_angles(bend, place, kinds.turning, device)
            energy = gather(stretch, place, angles).evaluate(device=device)["energy"][:, 0]
            results.append(energy[inside].sum() / plate.area[inside].sum())
    assert order(counts, energies["flat"]) == pytest.approx(4.0, abs=0.2)
    assert order(counts, energies["curved"]) > 5.8
    assert energies["curved"][-1] < 0.01 * energies["flat"][-1]


@pytest.mark.parametrize("shape", ["cylinder 20", "cylinder 45", "sphere"])
@pytest.mark.parametrize("mesh", ["crossed", "equilateral"])
def test_turning_normals_have_order_two(device, mesh, shape):
    counts = (6, 12, 24)
    errors = [relative_error(mesh, n, shape, "midedge_dof", device, supported=True) for n in counts]
    assert abs(order(counts, errors) - 2.0) < 0.1
    assert abs(errors[-1]) < 2e-5


@pytest.mark.parametrize("shape", ["cylinder 20", "cylinder 45", "sphere", "saddle 45"])
@pytest.mark.parametrize("mesh", ["jittered", "delaunay"])
def test_turning_normals_converge_on_irregular_meshes(device, mesh, shape):
    """Random meshes have no smooth error, but all of it is below h^2 / 30."""
    for n in (12, 24):
        assert abs(relative_error(mesh, n, shape, "midedge_dof", device, supported=True)) < 1.0 / (30.0 * n**2)


@pytest.mark.parametrize(("shape", "size"), [("cylinder 20", 1e-5), ("sphere", 2e-4), ("saddle 45", 1e-5)])
@pytest.mark.parametrize("mesh", ["right", "equilateral"])
def test_averaged_normals_on_structured_meshes(device, mesh, shape, size):
    counts = (8, 16, 32)
    errors = [relative_error(mesh, n, shape, "midedge", device, supported=False) for n in counts]
    assert abs(errors[-1]) < size
    if "saddle" not in shape:  # whose error is that of the shallow graph, of the order of (k / 2)^2
        assert abs(order(counts, errors) - 2.0) < 0.1


@pytest.mark.parametrize(
    ("mesh", "shape", "error"),
    [("crossed", "cylinder 45", 0.65), ("crossed", "saddle 45", 1.857), ("crossed", "cylinder 0", 0.0)],
)
def test_averaged_normals_do_not_converge_where_diagonals_alternate(device, mesh, shape, error):
    """The error of the energy depends on mesh and direction, 65 % and 186 % at the worst, and stays when h is halved."""
    for n in (16, 32):
        assert abs(relative_error(mesh, n, shape, "midedge", device, supported=False) - error) < 1e-3


def conversion(mesh, place, bending, device):
    """Energy per area of hinges with k = 1 over whole periods of the mesh."""
    points, triangles = square(mesh, 20)
    surface = Surface(triangles)
    place = place(points)
    kinds = edge_kinds(surface)
    plate = shells.plate(surface, place, 1.0, 3.0 * UNIT_D, NU, kinds, "flat")
    bend = shells.shell_elements(surface, plate, kinds, bending)[1]
    size = np.array([8 / 20, 8 / 20 * (np.sqrt(0.75) if mesh == "equilateral" else 1.0)])
    middle = points[bend.nodes[:, :2]].mean(1) - 0.501 * points.max(0) + 0.5 * size
    inside = ((middle >= 0.0) & (middle < size)).all(1)
    return gather(bend, place).evaluate(device=device)["energy"][inside, 0].sum() / size.prod()


# D_eff = 2 energy / k^2 of cylinders by direction, and energies / k^2 of sphere and saddles, for K_e = 3 |e|^2 / A_e with A_e the
# area of both triangles: slope jumps of a quadratic patch; the equilateral mesh agrees with Seung and Nelson (1988), who find
# the Gaussian modulus -(4/3) D, so nu = -1/3: sphere D (1 + nu) = 2, saddle D (1 - nu) = 4.
CONVERSION = {
    ("equilateral", 0): 3.0,
    ("equilateral", 45): 3.0,
    ("equilateral", 90): 3.0,
    ("equilateral", 135): 3.0,
    ("equilateral", "sphere"): 2.0,
    ("equilateral", "saddle 0"): 4.0,
    ("equilateral", "saddle 45"): 4.0,
    ("right", 0): 3.0,
    ("right", 45): 9.0,
    ("right", 90): 3.0,
    ("right", 135): 3.0,
    ("right", "sphere"): 3.0,
    ("right", "saddle 0"): 3.0,
    ("right", "saddle 45"): 9.0,
}


@pytest.mark.parametrize("bending", ["hinge", "isometric"])
@pytest.mark.parametrize(("mesh", "bent"), CONVERSION)
def test_hinge_conversion(device, mesh, bent, bending):
    k = 0.01
    if bent == "sphere":
        energy = conversion(mesh, lambda points: sphere(points, 1.0 / k)[0], bending, device) / k**2
    elif isinstance(bent, str):
        angle = float(bent.split()[1])
        energy = conversion(mesh, lambda points: saddle(points, k, angle)[0], bending, device) / k**2
    else:
        energy = 2.0 * conversion(mesh, lambda points: cylinder(points, bent, 1.0 / k)[0], bending, device) / k**2
    assert abs(energy / CONVERSION[mesh, bent] - 1.0) < 1e-3


def patch(supported=True):
    """A random surface of 18 triangles with every kind of edge, clamped inside too."""
    points, triangles = square("jittered", 3)
    surface = Surface(triangles)
    place = np.concatenate([points, points[:, :1] * points[:, 1:]], 1)
    place += 0.05 * np.random.default_rng(4).normal(size=place.shape)
    if not supported:
        return surface, place, edge_kinds(surface)
    outside, inside = np.flatnonzero(surface.boundary), np.flatnonzero(~surface.boundary)
    symmetry = {edge: [1.0, 0.2, 0.3] for edge in outside[:3]}
    return (
        surface,
        place,
        edge_kinds(surface, {edge: [0.1, 0.2, 2.0] for edge in [*outside[3:6], inside[4]]}, symmetry),
    )


def test_second_form_is_the_measure(device):
    """NumPy and the kernel agree on every kind of edge, with and without angles; the host's rest angles are the kernel's."""
    surface, place, kinds = patch()
    assert set(kinds.kind) == {0, 1, 2, 3}
    angles = np.random.default_rng(5).normal(size=len(surface.edges))
    plate = flat_plate(surface, place, kinds)
    turned = gather(shells.mid_edge_bending(surface, plate, kinds, True), place, angles).evaluate(device=device)
    still = gather(shells.mid_edge_bending(surface, plate, kinds, False), place).evaluate(device=device)
    np.testing.assert_allclose(turned["strain"], second_form(surface, place, kinds, angles), atol=1e-14)
    np.testing.assert_allclose(still["strain"], second_form(surface, place, kinds), atol=1e-14)
    hinge, tilt = (gather(e, place).evaluate(device=device) for e in shells.hinge_bending(surface, plate, kinds))
    angle = edge_angles(surface, place, kinds)
    np.testing.assert_allclose(hinge["strain"][:, 0], angle[kinds.kind == 1, 0], atol=1e-14)
    supported = angle[kinds.kind >= 2]
    np.testing.assert_allclose(tilt["strain"][:, 0], supported[supported != 0.0], atol=1e-14)


@pytest.mark.parametrize("viscosity", [None, 0.1])
@pytest.mark.parametrize(
    ("bending", "membrane"),
    [("midedge", "flat"), ("midedge_dof", "flat"), ("midedge_dof", "curved"), ("hinge", "flat")],
)
def test_no_force_at_rest(device, bending, membrane, viscosity):
    """With rest="shape", supports included, the shape itself bears no force; elsewhere it does."""
    surface, place, kinds = patch()
    plate = shells.plate(surface, place, 0.3, UNIT_D, NU, kinds, "shape", viscosity)
    moved = place + 0.1 * np.random.default_rng(6).normal(size=place.shape)
    for elements in shells.shell_elements(surface, plate, kinds, bending, membrane):
        sizes = [np.abs(at_rest(elements, x).evaluate(device=device)["gradient"]).max() for x in (place, moved)]
        assert sizes[0] < 1e-14 and sizes[1] > 1e-3, elements.term.name


def at_rest(elements, place):
    """Local elements; damped ones without change of strain since the last step."""
    local = gather(elements, place)
    if not elements.term.density.lagged:
        return local
    n = len(elements.term.measure.strains)
    padded = local.changed(p=np.concatenate([local.p, np.zeros((len(local.p), n + 1))], 1))
    last = padded.evaluate()["strain"]
    return local.changed(p=np.concatenate([local.p, last, np.full((len(last), 1), 50.0)], 1))


@pytest.mark.parametrize("bending", ["midedge", "midedge_dof", "hinge"])
def test_symmetry_plane_is_half_of_the_whole(device, bending):
    """A surface mirrored at x = 0 has twice the energy of its half with that plane as support, and of no other half."""
    points, triangles = square("delaunay", 4)
    half = np.concatenate([points, 0.3 * np.cos(2.0 * points[:, :1]) + 0.2 * points[:, 1:] ** 2], 1)
    on = points[:, 0] < 1e-12
    twin = np.arange(len(points))
    twin[~on] = len(points) + np.arange((~on).sum())
    whole = np.concatenate([half, half[~on] * [-1.0, 1.0, 1.0]])
    pieces = []
    for place, cells, planes in (
        (half, triangles, True),
        (whole, np.concatenate([triangles, twin[triangles[:, ::-1]]]), False),
        (half, triangles, False),
    ):
        surface = Surface(cells)
        edges = np.flatnonzero(surface.boundary & on[surface.edges % len(on)].all(1) & (surface.edges < len(on)).all(1))
        kinds = edge_kinds(surface, symmetry={edge: [1.0, 0.0, 0.0] for edge in edges if planes})
        elements = shells.shell_elements(surface, flat_plate(surface, place, kinds), kinds, bending)[1:]
        pieces.append(sum(gather(e, place).evaluate(device=device)["energy"].sum() for e in elements))
    assert abs(2.0 * pieces[0] / pieces[1] - 1.0) < 1e-13
    assert pieces[2] < 0.97 * pieces[0]


def test_membrane_under_affine_strain(device):
    """K/2 [(1 - nu) tr(E^2) + nu (tr E)^2] A with the Green strain E = (F^T F - I) / 2, exact on every mesh and in every basis."""
    points, triangles = square("delaunay", 5)
    surface = Surface(triangles)
    flat = np.pad(points, ((0, 0), (0, 1)))
    F = np.array([[1.1, 0.2, 0.0], [-0.1, 0.9, 0.3]]).T
    plate = shells.plate(surface, flat, 0.01, 5.0, NU, edge_kinds(surface))
    E = 0.5 * (F.T @ F - np.eye(2))
    K = 5.0 * 0.01 / (1.0 - NU**2)
    exact = 0.5 * K * ((1.0 - NU) * np.trace(E @ E) + NU * np.trace(E) ** 2)
    energy = gather(shells.membrane(surface, plate), points @ F.T).evaluate(device=device)["energy"].sum()
    assert abs(energy / exact - 1.0) < 1e-13


def test_explicit_rest_shape_and_material_of_each_triangle(device):
    """Growth by a factor g in length needs no force at g times the size; a rest curvature bends where its triangle is."""
    surface, place, kinds = patch(supported=False)
    count = len(surface.triangles)
    abar = 1.21 * metric(surface, place)
    bbar = 1.1 * second_form(surface, place, kinds)
    young = np.linspace(1.0, 2.0, count)
    plate = shells.plate(surface, place, 0.1, young, NU, kinds, (abar, bbar))
    for elements in shells.shell_elements(surface, plate, kinds, "midedge_dof"):
        grown, still = (gather(elements, g * place).evaluate(device=device)["energy"][:, 0] for g in (1.1, 1.0))
        assert grown.max() < 1e-20 * still.min()
    single = shells.membrane(surface, shells.plate(surface, place, 0.1, 1.0, NU, kinds, (abar, bbar)))
    ratio = gather(shells.membrane(surface, plate), place).evaluate(device=device)["energy"][:, 0]
    np.testing.assert_allclose(ratio / gather(single, place).evaluate(device=device)["energy"][:, 0], young, rtol=1e-12)


def test_damping_is_a_scaled_step(device):
    """From rest, the dissipation potential of a step of length h adds viscosity / h times the elastic energy."""
    surface, place, kinds = patch()
    moved = place + 0.1 * np.random.default_rng(6).normal(size=place.shape)
    for bending in ("midedge", "hinge"):
        plates = [shells.plate(surface, place, 0.3, UNIT_D, NU, kinds, "shape", v) for v in (None, 0.1)]
        pairs = zip(*(shells.shell_elements(surface, plate, kinds, bending) for plate in plates), strict=True)
        for elastic, damped in pairs:
            start = at_rest(damped, place)
            local = start.changed(q=gather(damped, moved).q)
            both = local.evaluate(device=device)["energy"]
            np.testing.assert_allclose(both, 6.0 * gather(elastic, moved).evaluate(device=device)["energy"], rtol=1e-10)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"thickness": -1.0}, "triangle 0: thickness = -1.0"),
        ({"young": np.array([1.0] * 17 + [np.nan])}, "triangle 17: Young's modulus = nan"),
        ({"poisson": 1.0}, "triangle 0: Poisson's ratio = 1.0"),
        ({"young": np.ones(3)}, "one for each of 18 triangles"),
        ({"rest": "round"}, "rest = 'round'"),
        ({"rest": (np.zeros((18, 3)), np.zeros((18, 3)))}, "triangle 0: rest metric"),
        ({"rest": (np.ones((2, 3)), np.ones((2, 3)))}, "rest abar has shape"),
        ({"viscosity": -0.1}, "triangle 0: viscosity = -0.1"),
    ],
)
def test_bad_plate_is_refused(changes, message):
    surface, place, kinds = patch(supported=False)
    arguments = {"thickness": 0.1, "young": 1.0, "poisson": 0.3, **changes}
    with pytest.raises(SceneError, match=message.replace("(", r"\(")):
        shells.plate(surface, place, kinds=kinds, **arguments)


def test_bad_supports_and_models_are_refused():
    surface, place, kinds = patch(supported=False)
    outside, inside = (int(np.flatnonzero(surface.boundary == side)[0]) for side in (True, False))
    for clamped, symmetry, message in (
        ({99: [0.0, 0.0, 1.0]}, {}, "clamped edge 99"),
        ({outside: [0.0, 0.0, 0.0]}, {}, f"clamped edge {outside}: normal"),
        ({}, {inside: [0.0, 0.0, 1.0]}, f"symmetry edge {inside} is inside"),
        ({outside: [0.0, 0.0, 1.0]}, {outside: [1.0, 0.0, 0.0]}, f"edge {outside} is clamped and"),
    ):
        with pytest.raises(SceneError, match=message):
            edge_kinds(surface, clamped, symmetry)
    curved = shells.plate(surface, place, 0.1, 1.0, NU, kinds, "shape")
    explicit = shells.plate(surface, place, 0.1, 1.0, NU, kinds, (curved.abar, curved.bbar))
    for plate, bending, membrane, message in (
        (curved, "isometric", "flat", "needs a flat rest shape"),
        (explicit, "hinge", "flat", "no rest angle"),
        (curved, "koiter", "flat", "bending = 'koiter'"),
        (curved, "hinge", "round", "membrane = 'round'"),
        (curved, "hinge", "curved", "reads the mid-edge normals"),
    ):
        with pytest.raises(SceneError, match=message):
            shells.shell_elements(surface, plate, kinds, bending, membrane)
