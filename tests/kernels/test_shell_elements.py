"""Element sets of shells: agreement of host and kernels, rest shapes, supports, materials and refusals."""

import numpy as np
import pytest
from shell_cases import Surface, gather, square

from ddg_warp.compile import shells
from ddg_warp.errors import SceneError
from ddg_warp.geometry.fundamental_forms import edge_angles, edge_kinds, metric, second_form

NU = 0.3
UNIT_D = 12.0 * (1.0 - NU**2)  # Young's modulus of a plate of thickness 1 with D = 1


def patch(supported=True):
    """Return a random surface of 18 triangles with every kind of edge, clamped inside, too."""
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


@pytest.mark.parametrize(
    ("bending", "flags"), [("midedge_dof", (1, 1, 0, 0)), ("midedge_boundary", (1, 0, 0, 0)), ("midedge", (0, 0, 0, 0))]
)
def test_edges_with_angles_by_bending_model(bending, flags):
    """Flags are by kind of edge: free, with a neighbour, clamped, symmetry."""
    *_, kinds = patch()
    assert np.array_equal(shells.turning(kinds, bending), np.array(flags, bool)[kinds.kind])


def test_second_form_equals_the_measure(device):
    """NumPy and the kernel agree on every kind of edge, with and without angles; the host's rest angles are the kernel's."""
    surface, place, kinds = patch()
    assert set(kinds.kind) == {0, 1, 2, 3}
    angles = np.random.default_rng(5).normal(size=len(surface.edges))
    plate = shells.plate(surface, place, 1.0, UNIT_D, NU, kinds, "flat")
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
    [
        ("midedge", "flat"),
        ("midedge_dof", "flat"),
        pytest.param("midedge_dof", "curved", marks=pytest.mark.slow),
        ("hinge", "flat"),
    ],
)
def test_rest_shape_bears_no_force(device, bending, membrane, viscosity):
    """A shape with rest="shape" bears no force, supports included; a displaced shape does."""
    surface, place, kinds = patch()
    plate = shells.plate(surface, place, 0.3, UNIT_D, NU, kinds, "shape", viscosity)
    moved = place + 0.1 * np.random.default_rng(6).normal(size=place.shape)
    for elements in shells.shell_elements(surface, plate, kinds, bending, membrane):
        sizes = [np.abs(at_rest(elements, x, device).evaluate(device=device)["gradient"]).max() for x in (place, moved)]
        assert sizes[0] < 1e-14 and sizes[1] > 1e-3, elements.term.name


def at_rest(elements, place, device):
    """Return local elements, damped ones without change of strain since the last step."""
    local = gather(elements, place)
    if not elements.term.density.lagged:
        return local
    n = len(elements.term.measure.strains)
    padded = local.changed(p=np.concatenate([local.p, np.zeros((len(local.p), n + 1))], 1))
    last = padded.evaluate(device=device)["strain"]
    return local.changed(p=np.concatenate([local.p, last, np.full((len(last), 1), 50.0)], 1))


@pytest.mark.parametrize("bending", ["midedge", "midedge_dof", "hinge"])
def test_symmetry_plane_is_half_of_the_whole(device, bending):
    """A surface mirrored at x = 0 has twice the energy of a half with that plane as support; a free half has less."""
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
        elements = shells.shell_elements(
            surface, shells.plate(surface, place, 1.0, UNIT_D, NU, kinds, "flat"), kinds, bending
        )[1:]
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
    """A step of length h from rest adds viscosity / h times the elastic energy as dissipation potential."""
    surface, place, kinds = patch()
    moved = place + 0.1 * np.random.default_rng(6).normal(size=place.shape)
    for bending in ("midedge", "hinge"):
        plates = [shells.plate(surface, place, 0.3, UNIT_D, NU, kinds, "shape", v) for v in (None, 0.1)]
        pairs = zip(*(shells.shell_elements(surface, plate, kinds, bending) for plate in plates), strict=True)
        for elastic, damped in pairs:
            start = at_rest(damped, place, device)
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
