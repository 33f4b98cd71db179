"""Rods glued along shells: sections rotate with the surface. Closed forms, meshes, rotations, and omitted elements."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import solve
from ddg_warp.solve.equilibrium.tangent import Tangent

YOUNG, LENGTH, WIDTH, THICKNESS = 1e7, 1.0, 0.4, 0.01
TALL = ddg.Stiffness(EA=1e3, EI1=0.08, EI2=0.01, GJ=0.02, mass_per_length=0.1, rotary_inertia=1e-5)
LIGHT = ddg.Stiffness(EA=1e3, EI1=0.016, EI2=0.002, GJ=0.004, mass_per_length=0.1)  # against b D = 0.4 of the plate
X, Y, Z = np.eye(3)


def strip(
    cells: int,
    pattern="alternating",
    poisson=0.3,
    row=None,
    spin="glued",
    section=TALL,
    director=Z,
    jitter=0.0,
    **options,
):
    """Return a strip along x with a rod along the middle or another mesh row, and the vertices along the rod."""
    rows = max(2, 2 * round(0.5 * cells * WIDTH / LENGTH))
    points, triangles = meshes.rectangle(cells, rows, (LENGTH, WIDTH), pattern)
    points[:, 1] -= 0.5 * WIDTH
    level = np.unique(np.round(points[:, 1], 9))[:: 2 if pattern == "crossed" else 1][rows // 2 if row is None else row]
    line = on(points, 1, level)
    line = line[np.argsort(points[line, 0])]
    inside = (np.abs(points - [0.5 * LENGTH, 0.0, 0.0]) < [0.5 * LENGTH - 1e-9, 0.5 * WIDTH - 1e-9, 1.0]).all(1)
    inside[line] = False
    points[inside, :2] += jitter * LENGTH / cells * np.random.default_rng(2).uniform(-1.0, 1.0, (inside.sum(), 2))
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    material = ddg.Material(young=YOUNG, poisson=poisson, density=1000.0)
    scene.add_shell(points, triangles, thickness=THICKNESS, material=material, **options)
    scene.add_rod(points[line], section=section, director=director)
    scene.attach(0, range(len(line)), 0, line, spin=spin)
    return scene, line


def on(points, axis: int, value: float) -> np.ndarray:
    return np.flatnonzero(np.abs(points[:, axis] - value) < 1e-9)


def elastic(model, state) -> dict[str, float]:
    return {name: value for name, value in model.energies(state).items() if name not in ("kinetic", "gravity")}


def torsional_stiffness(device, cells: int, factor=1.0, **options) -> float:
    """Return torque over rate of twist [N m^2] of a strip, from its energy.

    The ends are rotated about the axis and may warp.
    """
    scene, line = strip(cells, section=LIGHT, **options)
    points, twist = scene.shells[0].points, 0.02
    for x, rotation in ((0.0, -0.5 * twist), (LENGTH, 0.5 * twist)):
        motion = ddg.Motion(
            angle=lambda t, rotation=rotation: rotation * t, axis=tuple(X), pivot=tuple(points[line[0]])
        )
        scene.hold(0, on(points, 0, x), "yz", motion=motion)
    scene.hold(0, line[[len(line) // 2]], "x")
    if not scene.attachments[0].glued:
        scene.fix_twist(0, [0])
    model = scene.build(device, "float64")
    if factor != 1.0:
        model.set_parameter("glued_edge", "stiffness", factor * model.parameters()["net/glued_edge/stiffness"].ravel())
    return 2.0 * sum(elastic(model, solve(model)).values()) / twist**2 * LENGTH


PLATE = YOUNG / 2.6 * WIDTH * THICKNESS**3 / 3.0  # G b t^3 / 3


@pytest.mark.parametrize(
    ("pattern", "jitter", "row"), [("alternating", 0.0, None), ("alternating", 0.0, 0), ("right", 0.25, None)]
)
def test_glued_rod_stiffens_twist(device, pattern, jitter, row):
    """Twisted strips have the torque G b t^3 / 3 a rate of twist, plus GJ with a rod at the middle or edge.

    Torque enters the rod through the glue, over the first edge at either end. GJ is small against the plate, so the
    energy of the rod is GJ (L - l) of the inner vertices. The energy of the glue is small against it.
    """
    options = {"pattern": pattern, "jitter": jitter, "row": row}
    added = {}
    for cells in (10, 20):
        free = torsional_stiffness(device, cells, spin="free", **options)
        assert free == pytest.approx(PLATE, rel=2e-3)
        added[cells] = (torsional_stiffness(device, cells, **options) - free) / LIGHT.GJ
        assert added[cells] == pytest.approx(1.0 - 1.0 / cells, abs=0.6 / cells)
    assert 2.0 * added[20] - added[10] == pytest.approx(1.0, abs=0.02)  # first order


@pytest.mark.parametrize("bending", ["midedge_boundary", "midedge", "hinge", "isometric"])
def test_every_bending_model_rotates_the_rod(device, bending):
    """Bending models that are no plates give the same stiffness on a mesh that is uniform along the rod."""
    added = []
    for cells in (10, 20):
        free, glued = (
            torsional_stiffness(device, cells, spin=spin, pattern="crossed", bending=bending)
            for spin in ("free", "glued")
        )
        added.append((glued - free) / LIGHT.GJ)
    assert 2.0 * added[1] - added[0] == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
def test_stiffness_of_the_glue_does_not_matter(device):
    """A tenfold glue stiffness changes the torque by some thousandths, less on finer meshes; a tenth by less than a tenth."""
    changes = []
    for cells in (10, 20, 40):
        base = torsional_stiffness(device, cells)
        changes.append([abs(torsional_stiffness(device, cells, factor) - base) / LIGHT.GJ for factor in (10.0, 0.1)])
    changes = np.array(changes)
    assert (changes[0] < [0.006, 0.05]).all()
    assert (changes[1:] < 0.6 * changes[:-1]).all()


def arched(device, cells: int, spin: str):
    """Return model, equilibrium and relative energy of a strip bent to an arc of curvature 1.

    Poisson's ratio is 0; the energy is divided by (E b t^3 / 12 + EI1) / 2.
    """
    scene, _ = strip(cells, poisson=0.0, spin=spin, section=LIGHT)
    for x, rotation in ((0.0, 0.5), (LENGTH, -0.5)):
        motion = ddg.Motion(
            angle=lambda t, rotation=rotation: rotation * LENGTH * t, axis=tuple(Y), pivot=(x, 0.0, 0.0)
        )
        scene.clamp_boundary(0, on(scene.shells[0].points, 0, x), "yz" if x else "xyz", motion=motion)
        if spin == "glued":
            scene.clamp_end(0, "last" if x else "first", motion=motion, components="yz" if x else "xyz")
    model = scene.build(device, "float64")
    state = solve(model, load_steps=4, mode="follow")
    expected = 0.5 * (YOUNG * WIDTH * THICKNESS**3 / 12.0 + LIGHT.EI1)
    return model, state, sum(elastic(model, state).values()) / expected


@pytest.mark.slow
def test_tall_section_stands(device):
    """A glued rod bends stably about the strong axis with the strip; a rod that may spin is unstable."""
    for cells, error in ((10, 2e-4), (20, 5e-5)):
        model, state, energy = arched(device, cells, "glued")
        assert energy == pytest.approx(1.0, abs=error)
        assert state.stable
        assert spectrum(model, state, metric="unit").negative == 0
    model, state, _ = arched(device, 10, "free")
    assert not state.stable
    # -(EI1 - EI2) kappa^2 a length is the stiffness against a uniform rotation, which costs no torsion
    assert spectrum(model, state, metric="unit").negative == 1


@pytest.mark.parametrize(
    ("precision", "cells"),
    [pytest.param(*case, marks=pytest.mark.slow) for case in (("float64", 3), ("float64", 6), ("mixed", 6))],
)
def test_rigid_rotations_have_no_energy(device, precision, cells):
    """A clamped side rotates the strip by one and a half revolutions about the rod: no energy, and the rod follows."""
    scene, _ = strip(cells)
    revolutions = 1.5
    motion = ddg.Motion(angle=lambda t: 2.0 * np.pi * revolutions * t, axis=tuple(X))
    scene.clamp_boundary(0, on(scene.shells[0].points, 0, 0.0), motion=motion)
    model = scene.build(device, precision)
    state = solve(model, load_steps=18)
    assert sum(elastic(model, state).values()) < 1e-9
    np.testing.assert_allclose(state.points(), motion.place(1.0, model.state().points()), atol=1e-5)
    np.testing.assert_allclose(state.directors(), np.tile([0.0, 0.0, -1.0], (cells, 1)), atol=1e-5)
    np.testing.assert_array_equal(np.round(state.angles() / np.pi), 2.0 * revolutions)


def test_initial_states_rotate_the_rod(device):
    """Rigid rotations of a strip about the rod and other axes: no energy, and matching spin rates."""
    scene, line = strip(6)
    model = scene.build(device, "float64", worlds=2)
    rest = model.state().points()[0]
    rotation = ddg.Motion(angle=lambda t: 1.2, axis=(2.0, 1.0, -0.5))
    spin = np.array([0.7, -0.4, 0.3])
    points = rotation.place(1.0, rest)
    state = model.state(points=points, velocities=np.cross(spin, points))
    assert np.abs(list(elastic(model, state).values())).max() < 1e-18
    rates = state.coupled.v.numpy().reshape(2, -1, 3)[:, model.coupled.host.rods[0].edges, 0]
    np.testing.assert_allclose(rates, spin @ rotation.turn(1.0, X[None])[0], rtol=1e-9)
    without_spin = model.state(points=points, velocities=np.cross(spin, points), spins=np.zeros(len(line) - 1))
    assert not without_spin.coupled.v.numpy().reshape(2, -1, 3)[:, model.coupled.host.rods[0].edges, 0].any()


@pytest.mark.parametrize("scheme", [pytest.param("implicit_euler", marks=pytest.mark.slow), "implicit_midpoint"])
def test_spinning_strip_rotates_its_rod(device, scheme):
    """A free strip spins about the rod by two revolutions: the rod spins with it, without shear against the surface."""
    scene, line = strip(4)
    model = scene.build(device, "float64")
    rate, dt = 2.0 * np.pi, 0.01
    state = model.state(velocities=np.cross([rate, 0.0, 0.0], model.state().points()))
    integrator = ddg.Integrator(model, scheme=scheme)
    energy = model.energies(state)["kinetic"]
    rotation = 0.0
    for _ in range(200):
        before = state.angles()
        state = integrator.step(state, dt)
        rotation += np.mean(state.angles() - before)
    assert model.energies(state)["glued_edge"] < 1e-6 * energy
    across = state.points()[len(line) :][-1] - state.points()[len(line) :][line[-1]]
    angle = np.arctan2(across[2], across[1])
    assert np.mod(rotation - angle + np.pi, 2.0 * np.pi) - np.pi == pytest.approx(0.0, abs=1e-3)
    if scheme == "implicit_midpoint":
        assert rotation == pytest.approx(4.0 * np.pi, rel=5e-3)
    else:
        assert rotation > 2.2 * np.pi


def pendulum(device, cells: int, spin="glued", stiff=1e3):
    """Return the lowest modes of a light clamped wire with a stiff plate on the other half."""
    half = 0.5
    points, triangles = meshes.rectangle(cells, 2 * cells, (half, 0.2), "crossed")
    points[:, 1] -= 0.1
    line = on(points, 1, 0.0)
    line = line[np.argsort(points[line, 0])]
    wire = np.concatenate([points[line[:1]] - np.linspace(half, 0.0, cells + 1)[:-1, None] * X, points[line]])
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_shell(points, triangles, thickness=0.02, material=ddg.Material(stiff * YOUNG, 0.3, 1000.0))
    section = ddg.Stiffness(EA=1e3, EI1=0.02, EI2=0.02, GJ=0.02, mass_per_length=1e-6, rotary_inertia=1e-12)
    scene.add_rod(wire, section=section)
    scene.attach(0, range(cells, 2 * cells + 1), 0, line, spin=spin)
    scene.clamp_end(0)
    scene.fix(0, range(1, len(wire)))
    model = scene.build(device, "float64")
    return spectrum(model, model.state(), 2)


def test_torsional_pendulum(device):
    """Plates of inertia I = rho t l b^3 / 12 on a wire have w^2 = GJ / (L I), first order; without glue the plate spins freely."""
    inertia = 1000.0 * 0.02 * 0.5 * 0.2**3 / 12.0
    exact = np.sqrt(0.02 / (0.5 * inertia))
    errors = []
    for cells in (4, 8, 16):
        modes = pendulum(device, cells)
        assert (modes.rigid, modes.stable) == (0, True)
        errors.append(modes.frequencies[0] / exact - 1.0)
    assert abs(errors[-1]) < 0.03
    ratios = np.array(errors[:-1]) / errors[1:]
    assert (ratios > 1.8).all()
    free = pendulum(device, 4, "free")
    assert (free.rigid, free.stable) == (1, True)


def test_folds_across_the_rod_are_free(device):
    """Equal folds on both sides leave the rod at rest; different folds rotate it by the mean."""
    scene, _ = strip(4, bending="hinge")
    model = scene.build(device, "float64")
    points = model.state().points()
    for left, right in ((0.5, 0.5), (0.9, -0.3), (2.5, 2.0)):
        folded = points.copy()
        angle = np.where(points[:, 1] > 0.0, left, right)
        folded[:, 1] = points[:, 1] * np.cos(angle)
        folded[:, 2] = np.abs(points[:, 1]) * np.sin(angle)
        state = model.state(points=folded)
        np.testing.assert_allclose(state.angles(), 0.5 * (left - right), atol=1e-12)
        assert model.energies(state)["glued_edge"] < 1e-20
        assert np.abs(Tangent(model).gradient(state)[3 * model.coupled.host.rods[0].edges]).max() < 1e-12


def test_half_a_plate_on_a_symmetry_plane(device):
    """Half a stiffened plate with half a stiffener does not rotate, and sags like the whole plate."""
    sags = []
    for half in (False, True):
        cells, material = 8, ddg.Material(YOUNG, 0.3, 1000.0)
        points, triangles = meshes.rectangle(
            cells, cells // 2 if half else cells, (1.0, 0.5 if half else 1.0), "crossed"
        )
        line = on(points, 1, 0.0 if half else 0.5)
        line = line[np.argsort(points[line, 0])]
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        scene.add_shell(points, triangles, thickness=THICKNESS, material=material)
        fraction = 0.5 if half else 1.0
        section = ddg.Stiffness(EA=fraction * 1e3, EI1=fraction * 0.4, EI2=fraction * 0.1, GJ=fraction * 0.1)
        scene.add_rod(points[line], section=section, director=Z)
        scene.attach(0, range(len(line)), 0, line)
        if half:
            scene.symmetry(0, line, "y")
        far = 0.5 if half else 1.0
        scene.hold(0, np.unique(np.concatenate([on(points, 0, 0.0), on(points, 0, 1.0), on(points, 1, far)])))
        if not half:
            scene.hold(0, on(points, 1, 0.0))
        scene.add_pressure(0, 50.0, dead=True)
        model = scene.build(device, "float64")
        state = solve(model)
        assert np.abs(state.angles()).max() < 1e-9
        sags.append(state.points()[len(line) // 2, 2])
        assert ("glued_edge" in model.energies(state)) == (not half)
    assert sags[0] > 0.1 * THICKNESS
    assert sags[1] == pytest.approx(sags[0], rel=1e-6)


def test_cases_without_glue_elements(device):
    """A post, nodes off mesh edges, rods without twist and `spin="free"`: no elements, and the report states so."""
    points, triangles = meshes.rectangle(4, 4)
    corner = points[-1]
    cases = {
        "post": ([corner, corner + Z, corner + 2.0 * Z], [0], [24], {}),
        "no mesh edge": ([points[0], points[2], points[4]], [0, 1, 2], [0, 2, 4], {}),
        "no twist": (points[:5], range(5), range(5), {"twist": False}),
        "no bending": (points[:5], range(5), range(5), {"bend": False}),
        "free": (points[:5], range(5), range(5), {}),
    }
    for name, (nodes, rod_nodes, vertices, options) in cases.items():
        scene = ddg.Scene()
        scene.add_shell(points, triangles, thickness=0.01, material=ddg.Material(YOUNG, 0.3, 1000.0))
        section = ddg.Stiffness(EA=1e3, mass_per_length=0.1) if "bend" in options else ddg.Stiffness(1e3, 1.0, GJ=0.5)
        scene.add_rod(np.array(nodes), section=section, natural="straight", **options)
        scene.attach(0, rod_nodes, 0, vertices, spin="free" if name == "free" else "glued")
        model = scene.build(device, "float64")
        present, absent = model.report(absent=True).split("not in this scene: ")
        assert "glued_edge" in absent and "glued_edge" not in present, name


def test_a_ring_and_two_calls(device):
    """A ring on a cylinder is glued at all edges; a rod attached in two calls is glued where an edge has both nodes."""
    points, triangles = meshes.cylinder(12, 2, 1.0, 0.6)
    ring = on(points, 2, np.median(np.unique(points[:, 2])))
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_shell(points, triangles, thickness=0.01, material=ddg.Material(YOUNG, 0.3, 1000.0))
    angle = np.arctan2(points[ring, 1], points[ring, 0])
    ring = ring[np.argsort(angle)][::-1]
    scene.add_rod(points[ring], section=TALL, closed=True)
    scene.attach(0, range(5), 0, ring[:5])
    scene.attach(0, range(4, 12), 0, ring[4:])
    model = scene.build(device, "float64")
    assert "glued_edge: 12 elements, rod_surface_angle x quadratic" in model.report()
    assert np.abs(list(elastic(model, model.state()).values())).max() < 1e-18
    assert spectrum(model, model.state(), 8).rigid == 6
    wave = 0.02 * np.sin(3.0 * points + np.arange(3.0))
    state = model.state(points=np.concatenate([points[ring] + wave[ring], points + wave]))
    (slip,) = (np.asarray(value) for value in model.stresses(state)["glued_edge"])
    assert slip.shape == (12, 1) and np.abs(slip).max() < 1e-9
