"""Spectra and critical loads: singular tangents, rigid modes, clusters, massless dofs, and modes by node."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.solve.equilibrium import stability
from ddg_warp.solve.equilibrium.rigid_modes import rigid_modes
from ddg_warp.solve.equilibrium.stability import spectrum
from ddg_warp.solve.equilibrium.statics import solve
from ddg_warp.solve.equilibrium.tangent import Tangent
from ddg_warp.solve.linear import eigensolver
from ddg_warp.solve.linear.eigensolver import ShiftInvertLanczos
from ddg_warp.solve.linear.sparse_direct import Factorisation

SECTION = ddg.Stiffness(EA=1e4, EI1=1.0, EI2=1.5, GJ=0.8, mass_per_length=0.5, rotary_inertia=1e-3)
STEEL = ddg.Material(young=1e6, poisson=0.3, density=1000.0)


def line(nodes: int = 7, start=(0.0, 0.0, 0.0), end=(1.0, 0.0, 0.0)) -> np.ndarray:
    return np.linspace(start, end, nodes)


def still(**options) -> ddg.Scene:
    return ddg.Scene(gravity=(0.0, 0.0, 0.0), **options)


def stretched_string(device, tension: float):
    """Return a string under a dead end force and the equilibrium state along the axis."""
    scene = still()
    points = line(5)
    rod = scene.add_rod(points, section=ddg.Stiffness(EA=4.0, mass_per_length=1.0), bend=False)
    scene.fix(rod, [0])
    scene.fix(rod, [-1], "yz")
    scene.add_force(rod, -1, (tension, 0.0, 0.0))
    model = scene.build(device, "float64")
    return model, model.state(points=points * (1.0 + 0.25 * tension))


@pytest.mark.parametrize("limit", [10**6, 1], ids=["dense", "sparse"])
def test_singular_tangent(device, monkeypatch, limit):
    """Transverse rows of the tangent of a string without tension are zero.

    Transverse stiffness: T (w[i-1] - 2 w[i] + w[i+1]) / h.
    """
    monkeypatch.setattr(stability, "DENSE", limit)
    model, state = stretched_string(device, 0.0)
    tangent = Tangent(model)
    matrix = tangent.stiffness(state)[tangent.free][:, tangent.free]
    assert (abs(matrix).sum(axis=1) == 0.0).sum() == 6
    modes = spectrum(model, state, 7, "unit")
    np.testing.assert_allclose(modes.eigenvalues[:6], 0.0, atol=1e-9)
    # EA / h = 16; a row of four springs, one end free: 4 EA / h sin(pi / 16)^2 at unit masses
    exact = 16.0 * (2.0 - 2.0 * np.cos(np.pi / 9.0))
    assert modes.eigenvalues[6] == pytest.approx(exact, rel=1e-9)
    assert modes.negative == 0
    assert stability.negative_eigenvalues(matrix) == 0
    assert stability.instabilities(tangent, state, tangent.stiffness(state)) == 0
    assert stability.nearest_to_zero(matrix, np.ones(matrix.shape[0]))[0] == pytest.approx(0.0, abs=1e-9)


def test_critical_load_where_the_tangent_is_exactly_singular(device):
    """The string is slack where |p| < 0.2; the search ends there, whatever sign rounding gives the lowest eigenvalue."""
    tensions = []

    def equilibrium(parameter):
        tensions.append(0.0 if abs(parameter) < 0.2 else parameter)
        return stretched_string(device, tensions[-1])

    assert abs(stability.critical(equilibrium, -0.5, 0.6)) < 0.2 + 1e-7
    assert 0.0 in tensions


def test_buckling_from_a_singular_state(device):
    model, state = stretched_string(device, 0.0)
    with pytest.raises(ValueError, match="no minimum"):
        stability.buckling(model, state, state)


def free_body(kind: str) -> tuple[ddg.Scene, int]:
    """Return unsupported bodies and the number of rigid-body modes."""
    scene = still(dimension=2) if kind == "planar rod" else still()
    bend = np.stack([np.cos(np.linspace(0.0, 2.0, 9)), 0.0 * np.zeros(9), np.sin(np.linspace(0.0, 2.0, 9))], axis=1)
    if kind == "curved rod":  # unequal bending stiffnesses: no spin about the axis
        scene.add_rod(bend, section=SECTION)
        return scene, 6
    if kind == "straight rod":  # the rotation about the axis is the spin
        scene.add_rod(line(), section=SECTION)
        return scene, 6
    if kind == "two rods":
        scene.add_rods(np.array([line(), line() + [0.0, 1.0, 0.0]]), section=SECTION)
        return scene, 12
    if kind == "curved rod, naturally straight":  # uniform: rotates every director alike
        scene.add_rod(line(), section=ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0, mass_per_length=1.0, rotary_inertia=1e-3))
        return scene, 6
    if kind == "planar rod":
        scene.add_rod(bend, section=ddg.Stiffness(EA=1e4, EI1=1.0, mass_per_length=1.0))
        return scene, 3
    if kind == "hinged rods":  # two rigid bodies that share a point
        for end in ((1.0, 0.2, 0.0), (0.0, 0.3, 1.0)):
            scene.add_rod(line(6, end=end), section=SECTION)
        scene.join([(0, 0), (1, 0)], rigid=False)
        return scene, 9
    if kind == "rigid joint":
        for end in ((1.0, 0.2, 0.0), (0.0, 0.3, 1.0)):
            scene.add_rod(line(6, end=end), section=SECTION)
        scene.join([(0, 0), (1, 0)])
        return scene, 6
    bending = "hinge" if kind == "hinge shell" else "midedge_dof"
    points, triangles = meshes.rectangle(4, 3, (1.0, 0.7))
    if kind == "shell of revolution":
        scene.add_axisymmetric_shell(np.array([[0.5, 0.0], [0.7, 0.3], [0.8, 0.6]]), thickness=0.01, material=STEEL)
        return scene, 1
    scene.add_shell(points, triangles, thickness=0.01, material=STEEL, bending=bending)
    return scene, 6


KINDS = ["curved rod", "straight rod", "two rods", "curved rod, naturally straight", "planar rod", "hinged rods"]
KINDS += ["rigid joint", "shell", "hinge shell", "shell of revolution"]


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("metric", ["mass", "unit"])
@pytest.mark.parametrize("kind", KINDS)
def test_rigid_modes_of_free_bodies(device, monkeypatch, kind, metric, worlds):
    """Rigid-body modes have zero eigenvalues, are counted, and are no instability; dense and sparse solvers agree."""
    scene, rigid = free_body(kind)
    model = scene.build(device, "float64", worlds=worlds)
    state = model.state()
    rigid *= worlds
    spectra = {}
    for name, limit in (("dense", 10**6), ("sparse", 1)):
        monkeypatch.setattr(stability, "DENSE", limit)
        spectra[name] = spectrum(model, state, rigid + 4, metric)
        assert spectra[name].rigid == rigid
        assert spectra[name].negative == 0
        assert spectra[name].stable
        assert (spectra[name].eigenvalues[:rigid] == 0.0).all()
        assert (spectra[name].eigenvalues[rigid:] > 0.0).all()
        assert np.isfinite(spectra[name].frequencies).all()
        assert len(spectra[name].elastic) == 4
    np.testing.assert_allclose(spectra["sparse"].eigenvalues, spectra["dense"].eigenvalues, rtol=1e-8)
    tangent = Tangent(model)
    modes = rigid_modes(tangent, state, tangent.stiffness(state))
    scale = abs(tangent.stiffness(state)).max() * np.abs(modes).max()
    assert np.abs((tangent.stiffness(state) @ modes)[tangent.free]).max() < 1e-9 * scale


def test_supports_leave_some_rigid_modes(device):
    """A hanging hinged rod has one rigid-body mode, the rotation about the vertical.

    It swings with w^2 = 3 g / 2 L.
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, -9.81))
    section = ddg.Stiffness(EA=1e6, EI1=1e3, EI2=1e3, GJ=1e3, mass_per_length=1.0, rotary_inertia=1e-6)
    rod = scene.add_rod(line(41, end=(0.0, 0.0, -1.0)), section=section)
    scene.fix(rod, [0])
    model = scene.build(device, "float64")
    modes = spectrum(model, solve(model), 4)
    assert modes.rigid == 1
    assert modes.stable
    np.testing.assert_allclose(modes.eigenvalues[1:3], 1.5 * 9.81, rtol=2e-3)


def stiffened(device, spin: str, fix_twist: bool = False):
    """Return the spectrum of a clamped plate with a rod along the middle, attached by nodes or glued."""
    points, triangles = meshes.rectangle(4, 4)
    scene = still()
    plate = scene.add_shell(points, triangles, thickness=0.01, material=STEEL)
    scene.clamp_boundary(plate, np.flatnonzero(points[:, 0] < 1e-9))
    line_of = np.flatnonzero(np.abs(points[:, 1] - 0.5) < 1e-9)
    line_of = line_of[np.argsort(points[line_of, 0])]
    rod = scene.add_rod(points[line_of], section=SECTION)
    scene.attach(rod, range(len(line_of)), plate, line_of, spin=spin)
    if fix_twist:
        scene.fix_twist(rod, [0])
    model = scene.build(device, "float64")
    return spectrum(model, model.state(), 4)


def test_stiffener_spins_on_its_line(device):
    """A straight stiffener attached by nodes alone has a rigid-body mode, the spin. Glue prevents it."""
    modes = stiffened(device, "free")
    assert (modes.rigid, modes.stable) == (1, True)
    assert modes.eigenvalues[0] == 0.0 < modes.eigenvalues[1]
    moved = np.abs(modes.displacements).max((1, 2))
    assert moved[0] < 1e-9 * moved[1]  # no node moves, the stiffener rotates
    assert np.isfinite(modes.frequencies).all()
    assert stiffened(device, "free", fix_twist=True).rigid == 0
    glued = stiffened(device, "glued")
    assert (glued.rigid, glued.stable) == (0, True)
    assert (glued.eigenvalues > 0.0).all()


def test_an_instability_is_no_rigid_mode(device):
    """An inverted pendulum rod falls: w^2 = -3 g / 2 L, twice."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 9.81))
    section = ddg.Stiffness(EA=1e6, EI1=1e3, EI2=1e3, GJ=1e3, mass_per_length=1.0, rotary_inertia=1e-6)
    rod = scene.add_rod(line(41, end=(0.0, 0.0, -1.0)), section=section)
    scene.fix(rod, [0])
    model = scene.build(device, "float64")
    state = solve(model, mode="follow")
    modes = spectrum(model, state, 4)
    assert (modes.rigid, modes.negative, modes.stable) == (1, 2, False)
    np.testing.assert_allclose(modes.eigenvalues[:2], -1.5 * 9.81, rtol=2e-3)


@pytest.mark.parametrize("metric", ["mass", "unit"])
def test_sparse_spectrum_is_the_dense_one(device, monkeypatch, metric):
    """A square plate has massless dofs at mesh edges and pairs of equal frequencies."""
    points, triangles = meshes.rectangle(6, 6, (1.0, 1.0), "crossed")
    scene = still()
    plate = scene.add_shell(points, triangles, thickness=0.01, material=STEEL)
    edge = np.flatnonzero((np.abs(points[:, :2] - 0.5) > 0.5 - 1e-9).any(axis=1))
    scene.clamp_boundary(plate, edge)
    model = scene.build(device, "float64")
    spectra = []
    for limit in (10**6, 1):
        monkeypatch.setattr(stability, "DENSE", limit)
        spectra.append(spectrum(model, model.state(), 12, metric))
    dense, sparse = spectra
    np.testing.assert_allclose(sparse.eigenvalues, dense.eigenvalues, rtol=1e-8)
    assert sparse.eigenvalues[1] == pytest.approx(sparse.eigenvalues[2], rel=1e-8)
    tangent = Tangent(model)
    stiffness = tangent.stiffness(model.state())
    weights = tangent.mass if metric == "mass" else np.where(tangent.angle, tangent.edge_length() ** 2, 1.0)
    for values, modes in ((sparse.eigenvalues, sparse.modes), (dense.eigenvalues, dense.modes)):
        residual = (stiffness @ modes - weights[:, None] * modes * values)[tangent.free]
        assert np.abs(residual).max() < 1e-7 * abs(stiffness @ modes).max()  # massless dofs follow
        np.testing.assert_allclose(modes.T @ (weights[:, None] * modes), np.eye(12), atol=1e-8)


def test_iteration_finds_every_copy(device):
    """Eleven equal rods in one model repeat every eigenvalue eleven times; the inertia count requests each."""
    scene = still()
    rods = scene.add_rods(np.stack([line(9) + [0.0, float(i), 0.0] for i in range(11)]), section=SECTION)
    for rod in rods:
        scene.clamp_end(rod)
    model = scene.build(device, "float64")
    tangent = Tangent(model)
    matrix = tangent.stiffness(model.state())[tangent.free][:, tangent.free]
    values, _ = eigensolver.ShiftInvertLanczos(matrix, tangent.mass[tangent.free], np.zeros((matrix.shape[0], 0)))(25)
    exact, _ = eigensolver.dense(matrix, tangent.mass[tangent.free], np.zeros((matrix.shape[0], 0)))
    np.testing.assert_allclose(values, exact[:25], rtol=1e-8)
    assert np.ptp(values[:11]) < 1e-8 * values[0]
    assert values[11] > 1.01 * values[10]


def test_modes_by_node(device):
    """Displacements of modes are the nodal entries of the raw modes, in the order of the points of a state."""
    scene = still()
    scene.add_rod(line(6), section=SECTION)
    scene.clamp_end(0)
    points, triangles = meshes.rectangle(3, 2)
    plate = scene.add_shell(points + [0.0, 3.0, 0.0], triangles, thickness=0.01, material=STEEL)
    scene.clamp_boundary(plate, np.flatnonzero(points[:, 0] < 1e-9))
    for worlds in (1, 3):
        model = scene.build(device, "float64", worlds=worlds)
        state = model.state()
        modes = spectrum(model, state, 5, "unit")
        assert modes.displacements.shape == (5, *state.points().shape)
        tangent = Tangent(model)
        moved, q = state.copy(), tangent.dofs(state)
        for mode, displacement in zip(modes.modes.T, modes.displacements, strict=True):
            tangent.assign(moved, q + 1e-3 * mode)
            np.testing.assert_allclose(moved.points() - state.points(), 1e-3 * displacement, atol=1e-15)


def sphere(device, subdivisions: int):
    """Return a closed sphere under a follower pressure, at a tenth of the critical load.

    Supports prevent rigid motions.
    """
    points, triangles = meshes.sphere(subdivisions)
    young, nu, thickness = 1e9, 0.3, 0.02
    scene = still()
    shell = scene.add_shell(
        points, triangles, thickness=thickness, material=ddg.Material(young, nu, density=1.0), bending="hinge"
    )
    for vertex, components in (
        (points[:, 0].argmax(), "xyz"),
        (points[:, 0].argmin(), "yz"),
        (points[:, 1].argmax(), "z"),
    ):
        scene.hold(shell, [vertex], components)
    scene.add_pressure(shell, -0.1 * 2.0 * young * thickness**2 / np.sqrt(3.0 * (1.0 - nu**2)))  # Zoelly 1915
    model = scene.build(device, "float64")
    return model, solve(model)


@pytest.mark.parametrize("limit", [10**6, 1], ids=["dense", "sparse"])
def test_buckling_of_a_closed_sphere(device, monkeypatch, limit):
    """Critical loads come in clusters; few solves find the lowest and its copies, as all eigenvalues show."""
    model, state = sphere(device, 2)
    monkeypatch.setattr(stability, "DENSE", limit)
    solves = []
    search = Factorisation.solve
    monkeypatch.setattr(Factorisation, "solve", lambda self, b: solves.append(1) or search(self, b))
    loads = stability.buckling(model, model.state(), state, 6)
    monkeypatch.setattr(stability, "DENSE", 10**6)
    np.testing.assert_allclose(loads, stability.buckling(model, model.state(), state, 6), rtol=1e-8)
    assert np.ptp(loads[:3]) < 1e-4 * loads[0]
    assert len(solves) < 400


def test_mistakes(device):
    scene = still()
    scene.add_rod(line(), section=SECTION)
    model = scene.build(device, "float64")
    with pytest.raises(ddg.SceneError, match=r"metric is 'foo'.*'mass' or 'unit'"):
        spectrum(model, model.state(), metric="foo")
    with pytest.raises(ddg.SceneError, match="count = 0"):
        spectrum(model, model.state(), 0)


def test_a_count_that_rounding_makes_too_large_ends_the_search(device, monkeypatch):
    """The inertia count claims one eigenvalue too many: the search finds none, and the spectrum stays."""
    scene = still()
    scene.clamp(scene.add_rod(line(), section=SECTION))
    model = scene.build(device, "float64")
    monkeypatch.setattr(stability, "DENSE", 0)
    exact = spectrum(model, model.state(), 3)
    searches, inertia, nearest = [], ShiftInvertLanczos.inertia, ShiftInvertLanczos.nearest
    monkeypatch.setattr(ShiftInvertLanczos, "inertia", lambda self, shift: inertia(self, shift) + 1)
    monkeypatch.setattr(ShiftInvertLanczos, "nearest", lambda self, *args: searches.append(1) or nearest(self, *args))
    modes = spectrum(model, model.state(), 3)
    np.testing.assert_allclose(modes.eigenvalues, exact.eigenvalues, rtol=1e-9)
    assert len(searches) < 5


def test_unstable_mode_of_massless_twist_angles_is_found(device):
    """A tall strip on an arc in the stiff plane would rotate into the soft one, although its angles have no inertia."""
    scene, angle = still(), np.linspace(0.0, 1.0, 9)
    arc = np.stack([np.sin(angle), np.cos(angle), 0.0 * angle], -1)
    section = ddg.Stiffness(EA=1e4, EI1=4.0, EI2=0.1, GJ=0.05, mass_per_length=1.0)
    director = np.stack([-np.sin(angle), -np.cos(angle), 0.0 * angle], -1)[4]
    rod = scene.add_rod(arc, section=section, director=director, natural="straight")
    scene.fix(rod, range(1, 9))
    model = scene.build(device, "float64")
    spectra = [spectrum(model, model.state(), 3, metric) for metric in ("mass", "unit")]
    assert spectra[0].negative == spectra[1].negative > 0
    assert not spectra[0].stable and (spectra[0].eigenvalues > 0.0).all()
