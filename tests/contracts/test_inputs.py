"""Interpretation of user input on every kind of object: selections, motions, loads, models unchanged after build."""

import inspect
import os
import re
import subprocess
import sys
import typing
from pathlib import Path

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneWarning
from ddg_warp.geometry import meshes
from ddg_warp.io.mesh_read import read_mesh
from ddg_warp.scene.handle import Handle
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.equilibrium.tangent import Tangent

STEEL = ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0, mass_per_length=1.0, rotary_inertia=0.01)
RUBBER = ddg.Material(young=1e6, poisson=0.0, density=1000.0)
PRECISIONS = pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])


def straight(nodes: int = 9) -> np.ndarray:
    points = np.zeros((nodes, 3))
    points[:, 0] = np.linspace(0.0, 1.0, nodes)
    return points


def sheet(cells=(4, 4), size=(1.0, 1.0), bending="midedge_dof", gravity=(0.0, 0.0, 0.0)) -> ddg.Scene:
    scene = ddg.Scene(gravity=gravity)
    scene.add_shell(*meshes.rectangle(*cells, size), thickness=0.01, material=RUBBER, bending=bending)
    return scene


def side(scene: ddg.Scene, axis: int, coordinate: float) -> np.ndarray:
    """Return the mask of vertices of shell 0 on a side."""
    return np.abs(scene.shells[0].points[:, axis] - coordinate) < 1e-9


# --- loads along edges ---
def vertex_forces(scene: ddg.Scene) -> np.ndarray:
    """Return the sum of vertex loads of a scene by vertex (P, 3)."""
    force = np.zeros_like(scene.shells[0].points)
    for load in scene.shell_loads:
        np.add.at(force, load.vertices, load.force)
    return force


def test_edge_force_is_per_length():
    """1 N/m on a side of 1 m is 1 N, halved at the ends, for any order of vertices; on all sides it is 4 N."""
    expected = np.where(side(sheet(), 1, 0.0), 0.25, 0.0)
    expected[[0, 4]] = 0.125
    for chosen in ([0, 1, 2, 3, 4], [3, 0, 4, 1, 2], side(sheet(), 1, 0.0), [[0, 1], [2, 1], [2, 3], [4, 3]]):
        scene = sheet()
        scene.add_edge_force(0, chosen, (0.0, 0.0, 1.0))
        np.testing.assert_allclose(vertex_forces(scene)[:, 2], expected, atol=1e-15)
    scene = sheet()
    scene.add_edge_force(0, scene.shells[0].surface.boundary_vertices, (0.0, 0.0, 1.0))
    assert vertex_forces(scene)[:, 2].sum() == pytest.approx(4.0)
    assert vertex_forces(scene)[12, 2] == 0.0  # the middle


def test_edge_force_on_inner_edges():
    """Mesh edges through the middle carry 2 N/m on 1 m."""
    scene = sheet()
    line = np.arange(10, 15)
    scene.add_edge_force(0, np.column_stack([line[:-1], line[1:]]), (0.0, 2.0, 0.0))
    np.testing.assert_allclose(vertex_forces(scene)[line, 1], [0.25, 0.5, 0.5, 0.5, 0.25])


def strip(turn: float, bending: str, n: int = 32, **options) -> ddg.Scene:
    """Return a strip of 1 m clamped at x = 0, with a couple at x = 1 that bends it into an arc of angle `turn` [rad]."""
    scene = sheet((n, 2), (1.0, 0.1), bending)
    scene.clamp_boundary(0, side(scene, 0, 0.0))
    moment = RUBBER.young * 0.01**3 / 12.0 * turn  # per length: E h^3 / 12 kappa, of nu = 0
    scene.add_edge_couple(0, side(scene, 0, 1.0), moment, **options)
    return scene


@pytest.mark.parametrize("bending", [pytest.param("midedge_dof", marks=pytest.mark.slow), "midedge_boundary"])
def test_edge_couple_bends_strip_into_arc(device, bending):
    """M = E h^3 / 12 kappa, kappa L = pi: the tip is at L (sin pi, cos pi - 1) / pi, convex above; the error falls with n^2."""
    errors = []
    for n in (16, 32):
        scene = strip(np.pi, bending, n)
        model = scene.build(device, "float64")
        state = statics.solve(model, load_steps=4)
        tip = state.points()[side(scene, 0, 1.0)]
        errors.append(np.abs(tip[:, [0, 2]] - [0.0, -2.0 / np.pi]).max())
    assert errors[1] < 4e-4
    assert errors[0] / errors[1] > 2.5
    (reaction,) = model.reactions(state, point=(0.0, 0.0, 0.0))
    np.testing.assert_allclose(reaction.force, 0.0, atol=1e-6)
    moment = 0.1 * RUBBER.young * 0.01**3 / 12.0 * np.pi  # about +y, the direction of the edge at x = 1
    np.testing.assert_allclose(reaction.moment, (0.0, -moment, 0.0), atol=1e-3 * moment)


def test_load_stiffness_of_edge_couples_matches_differences(device):
    """`load_stiffness` is minus the central difference of the loads, on any shape."""
    model = strip(0.5, "midedge_dof", 4).build(device, "float64")
    tangent, random = Tangent(model), np.random.default_rng(0)
    q = tangent.dofs(model.state()) + 0.02 * random.normal(size=tangent.size)
    step, h = random.normal(size=tangent.size), 1e-6
    difference = (tangent.loads(1.0, q + h * step) - tangent.loads(1.0, q - h * step)) / (2.0 * h)
    np.testing.assert_allclose(-tangent.load_stiffness(1.0, q) @ step, difference, atol=1e-8 * np.abs(difference).max())


@pytest.mark.slow
def test_edge_couples_agree_between_pcg_and_factors(device):
    """PCG, with loads from the device, and direct factors find the same arc; 3 worlds agree."""
    scene = strip(0.6, "midedge_dof", 8)
    one = statics.solve(scene.build(device, "float64"), solver="direct").points()
    three = statics.solve(scene.build(device, "float64", worlds=3), solver="pcg").points()
    for points in three:
        np.testing.assert_allclose(points, one, atol=1e-7)


@pytest.mark.parametrize(
    "precision", ["float64", *(pytest.param(precision, marks=pytest.mark.slow) for precision in ("mixed", "float32"))]
)
def test_edge_couple_adds_angular_momentum_only(device, precision):
    """A couple on a side of a free square, h rho a^2 = 10 kg, gives M = I w' about the middle and no momentum."""
    scene = sheet((2, 2))
    scene.add_edge_couple(0, side(scene, 0, 1.0), 2e-5, amplitude=lambda t: 1.0)
    model = scene.build(device, precision)
    state = ddg.Integrator(model).step(model.state(), 1e-3)
    v, x = state.velocities(), state.points()
    (block,) = Tangent(model).parts
    mass = block.mass.reshape(-1, 3)[: len(x), :1]
    np.testing.assert_allclose((mass * v).sum(0), 0.0, atol=1e-11)
    spin = np.cross(x - [0.5, 0.5, 0.0], mass * v).sum(0)
    np.testing.assert_allclose(spin, (0.0, 2e-5 * 1e-3, 0.0), rtol=0.05, atol=1e-11)


def test_edge_couples_need_free_boundary_angles(device):
    for bending in ("midedge", "hinge", "isometric"):
        with pytest.raises(ddg.SceneError, match="no angle with bending"):
            sheet(bending=bending).add_edge_couple(0, [0, 1], 1.0)
    with pytest.raises(ddg.SceneError, match="vertices 6 and 7 is inside"):
        sheet().add_edge_couple(0, [[6, 7]], 1.0)
    scene = sheet()
    scene.clamp_boundary(0, [0, 1])
    scene.add_edge_couple(0, [0, 1], 1.0)
    with pytest.raises(ddg.SceneError, match="vertices 0 and 1 of shell 0 is fixed"):
        scene.build(device)


# --- a displacement for each node or vertex ---
def shift(t: float) -> np.ndarray:
    return np.array([0.02 * t, -0.05 * t, 0.1 * t])


def uncoupled_rods(motion) -> ddg.Scene:
    scene = ddg.Scene(gravity=(0.0, 0.0, -1.0))
    rods = scene.add_rods([straight(), straight() + [0.0, 1.0, 0.0]], section=STEEL)
    scene.fix(rods, [0, 1, -1], motion=motion)
    return scene


def coupled_rods(motion) -> ddg.Scene:
    scene = uncoupled_rods(motion)
    scene.join([(0, 4), (scene.add_rod(straight() + [0.5, 0.0, 0.0], section=STEEL), 0)])
    return scene


def planar(motion) -> ddg.Scene:
    scene = ddg.Scene(dimension=2)
    scene.fix(scene.add_rod(straight(), section=STEEL), [0, 1, -1], motion=motion)
    return scene


def shell(motion) -> ddg.Scene:
    scene = sheet(gravity=(0.0, 0.0, -1.0), bending="hinge")
    scene.hold(0, side(scene, 0, 0.0) | side(scene, 0, 1.0), motion=motion)
    return scene


def revolved(motion) -> ddg.Scene:
    scene = ddg.Scene()
    points = np.column_stack([np.linspace(0.5, 1.0, 7), np.zeros(7)])
    ring = scene.add_axisymmetric_shell(points, thickness=0.01, material=RUBBER)
    scene.hold_ring(ring, [0, -1], motion=motion)
    return scene


KINDS = {
    "rods": (uncoupled_rods, 6),
    "joined": (coupled_rods, 6),
    "planar": (planar, 3),
    "shell": (shell, 10),
    "revolved": (revolved, 2),
}


@pytest.mark.parametrize("worlds", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_common_displacement_equals_displacements_per_node(device, kind, worlds):
    """A rigid displacement and the same one per node: bitwise equal steps and equilibrium."""
    make, count = KINDS[kind]
    scale = [1.0, 0.0 if kind in ("planar", "revolved") else 1.0, 1.0]
    rigid = make(ddg.Motion(translation=lambda t: scale * shift(t)))
    single = make(ddg.Motion(translation=lambda t: np.tile(scale * shift(t), (count, 1))))
    results = []
    for scene in (rigid, single):
        model = scene.build(device, "float64", worlds=worlds)
        integrator, state = ddg.Integrator(model), model.state()
        for _ in range(2):
            state = integrator.step(state, 0.01)
        results.append([state.points(), *([statics.solve(model).points()] if worlds == 1 else [])])
    for common, per_node in zip(*results, strict=True):
        np.testing.assert_array_equal(common, per_node)


@pytest.mark.parametrize("kind", KINDS)
def test_displacements_per_node_apply_in_order(device, kind):
    """Supported node i is displaced by i a t along z, in dynamics and statics, in the given order, rod by rod."""
    make, count = KINDS[kind]
    scene = make(ddg.Motion(translation=lambda t: 1e-3 * t * np.outer(np.arange(count), [0.0, 0.0, 1.0])))
    model = scene.build(device, "float64")
    rest = model.state().points()
    for state, t in ((ddg.Integrator(model).step(model.state(), 0.1), 0.1), (statics.solve(model), 1.0)):
        moved = (state.points() - rest)[supported_points(scene), 2]
        np.testing.assert_allclose(moved, 1e-3 * t * np.arange(count), atol=1e-14)


def supported_points(scene: ddg.Scene) -> np.ndarray:
    """Return the point indices of the first support of a scene, in its order."""
    if scene.shell_supports:
        return scene.shell_supports[0].vertices
    if scene.ring_supports:
        return scene.ring_supports[0].nodes
    support = scene.supports[0]
    return np.array([9 * rod + node % 9 for rod in support.rods for node in support.nodes])


# --- models stay as they were built ---
def test_edits_after_build_do_not_reach_the_model(device):
    """Later changes of the scene do not change the model; arrays of a scene are read-only."""
    scene = coupled_rods(None)
    model = scene.build(device, "float64")
    before = ddg.Integrator(model).step(model.state(), 0.01).points()
    scene.gravity, scene.mass_damping = (5.0, 0.0, 0.0), 3.0
    scene.callbacks.append(lambda state: pytest.fail("called"))
    scene.add_force(0, 3, (0.0, 0.0, 100.0))
    scene.add_rod(straight(), section=STEEL)
    scene.batches[0].name = "other"
    assert (model.scene.rod_count, model.scene.loads, model.scene.batches[0].name) == (3, [], "rod")
    np.testing.assert_array_equal(ddg.Integrator(model).step(model.state(), 0.01).points(), before)
    for array in (scene.batches[0].points, sheet().shells[0].points, sheet().shells[0].triangles):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0


def test_input_arrays_are_copied(device):
    """Arrays changed after the call do not change the scene."""
    points, stiffness, natural = straight(), np.full(8, 1e3), np.zeros(7)
    scene = ddg.Scene()
    scene.add_rod(points, section=ddg.Stiffness(EA=stiffness, EI1=1.0, GJ=1.0), natural=(natural, 0.0, 0.0))
    points += 1.0
    stiffness *= -1.0
    natural += np.nan
    np.testing.assert_array_equal(scene.build(device, "float64").state().points(), straight())


# --- meshes and masses that are probably unintended ---
def test_disconnected_meshes_warn_and_weld(tmp_path):
    """Two squares with separate vertices are two pieces until read with a tolerance; a slit mesh is one piece."""
    quads = "".join(f"v {x} {y} 0\n" for s in (0, 1) for x, y in ((s, 0), (s + 1, 0), (s + 1, 1), (s, 1 + 1e-9)))
    (tmp_path / "two.obj").write_text(quads + "f 1 2 3 4\nf 5 6 7 8\n")
    points, triangles, name = read_mesh(tmp_path / "two.obj")
    scene = ddg.Scene()
    with pytest.warns(SceneWarning, match=r"shell 'two' falls into 2 pieces, though 2 of its vertices .* weld=1e-6"):
        scene.add_shell(points, triangles, thickness=0.01, material=RUBBER, name=name)
    points, triangles, _ = read_mesh(tmp_path / "two.obj", weld=1e-6)
    assert (len(points), len(triangles)) == (6, 4)
    for mesh in ((points, triangles), meshes.annulus(2, 8, 1.0, 2.0, slit=True), meshes.weld(*meshes.sphere(1), 1e-9)):
        shell = scene.add_shell(*mesh, thickness=0.01, material=RUBBER)  # warnings are errors, see `filterwarnings`
        assert scene.shells[shell].surface.pieces == 1


@pytest.mark.filterwarnings("error")
def test_gravity_without_mass_warns(device):
    """A rod without mass under gravity warns by name in statics; not without gravity or with a point mass."""
    bare = ddg.Stiffness(EA=1e3, EI1=1.0, GJ=1.0)

    def solve(mass: float = 0.0, **options):
        scene = ddg.Scene(**options)
        scene.clamp(scene.add_rod(straight(), section=bare, name="hair"))
        if mass:
            scene.add_mass(0, -1, mass)
        return statics.solve(scene.build(device, "float64")).points()

    with pytest.warns(SceneWarning, match=r"rod 0 \('hair'\) has no mass, .* gravity=\(0, 0, 0\)"):
        solve()
    solve(gravity=(0.0, 0.0, 0.0))
    assert solve(mass=1e-3)[-1, 2] < -1e-3


def test_curved_membranes_take_a_new_rest_shape(device):
    """A sheet with curved sides grown by a tenth is a tenth larger: every term takes the new rest shape."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_shell(*meshes.rectangle(2, 2), thickness=0.05, material=RUBBER, membrane="curved")
    scene.hold(0, [0])
    scene.hold(0, [2], "yz")
    scene.hold(0, [6], "z")
    model = scene.build(device, "float64")
    points = scene.shells[0].points
    model.set_rest(0, points=1.1 * points)
    np.testing.assert_allclose(statics.solve(model).points(), 1.1 * points, atol=1e-8)


# --- public names ---
def test_public_names_are_listed():
    """`dir`, completion and type checkers list the names of `ddg_warp`, each from its module."""
    pytest.importorskip("torch")  # for `ddg.Simulator`
    source = Path(ddg.__file__).read_text()
    checked = re.findall(r"^    from ddg_warp(?:\.(\S+))? import (.+)$", source, re.MULTILINE)
    homes = {name.strip().split(" as ")[-1]: home for home, names in checked for name in names.split(",")}
    assert set(homes) == set(ddg.__all__) <= set(dir(ddg))
    for name in ddg.__all__:
        value = getattr(ddg, name)
        assert inspect.ismodule(value) or value.__module__.startswith(f"ddg_warp.{homes[name]}")
    assert (Path(ddg.__file__).parent / "py.typed").exists()
    with pytest.raises(AttributeError, match="'Rod'"):
        _ = ddg.Rod


def test_signatures_list_arguments():
    """`add_rod` shows the arguments of `add_rods`; a scene takes keywords only, none of them its internal lists."""
    one, several = (inspect.signature(getattr(ddg.Scene, name)) for name in ("add_rod", "add_rods"))
    assert one.parameters == several.parameters
    assert list(inspect.signature(ddg.Scene).parameters) == [
        *("gravity", "dimension", "analysis", "mass_damping", "flow", "initial", "callbacks")
    ]
    assert {p.kind for p in inspect.signature(ddg.Scene).parameters.values()} == {inspect.Parameter.KEYWORD_ONLY}
    assert typing.get_type_hints(ddg.Scene.add_rod)["return"] is Handle


def test_repr_names_object_and_counts(device):
    """A few lines each, with the main counts."""
    from ddg_warp.run.simulate import Result

    scene = coupled_rods(None)
    scene.add_force(0, 3, (0.0, 0.0, 1.0))
    model = scene.build(device, "float64", worlds=2)
    state = model.state()
    texts = [
        (scene, "Scene", "3 rods of 27 nodes", "1 joints", "1 supports, 1 loads"),
        (model, "Model", "float64", "2 worlds of 27 points", "of 3 rods:"),
        (state, "State", "t = 0 s", "2 worlds of 27 points"),
        (Result(scene, model, state, [0.0, 0.5], {"tip": [0.0, 1.0]}), "Result", "2 states", "0 to 0.5", "tip"),
    ]
    for item, *words in texts:
        text = repr(item)
        assert all(word in text for word in words), text
        assert len(text) < 400


SCRIPT = """
import sys, ddg_warp as ddg
assert "warp" not in sys.modules and "numpy" not in sys.modules and "scipy" not in sys.modules
dir(ddg), ddg.SceneError
assert "warp" not in sys.modules
import numpy as np
scene = ddg.Scene()
assert "warp" not in sys.modules and "scipy" not in sys.modules
points = np.zeros((5, 3)); points[:, 0] = np.arange(5)
scene.add_rod(points, section=ddg.Stiffness(1e3, 1.0, GJ=1.0, mass_per_length=1.0))
model = scene.build("cpu")
ddg.Integrator(model).step(model.state(), 0.01)
"""


@pytest.mark.parametrize("verbose", ["", pytest.param("1", marks=pytest.mark.slow)])
def test_scripts_print_no_module_loads(verbose):
    """Importing loads nothing heavy; a run prints Warp's messages only with DDG_WARP_VERBOSE=1."""
    environment = os.environ | {"DDG_WARP_VERBOSE": verbose}
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert ("Module ddg_warp" in done.stdout or "Warp 1." in done.stdout) == bool(verbose)
    assert verbose or not done.stdout


# --- symmetry planes across any direction ---
def quarter(turn: float = 0.0, bending: str = "midedge_dof", axes: bool = False, gravity: float = 1.0) -> ddg.Scene:
    """Return a quarter of a square plate, rotated about z, with two symmetry planes, supported sides and gravity."""
    rotation = ddg.Motion().rotation(turn)
    points, triangles = meshes.rectangle(4, 4)
    scene = ddg.Scene(gravity=(0.0, 0.0, -gravity))
    scene.add_shell(points @ rotation.T, triangles, thickness=0.05, material=RUBBER, bending=bending)
    x, y, _ = points.T
    for mask, axis, letter in ((x == 0.0, rotation[:, 0], "x"), (y == 0.0, 2.0 * rotation[:, 1], "y")):
        scene.symmetry(0, mask, letter if axes else axis)
    scene.hold(0, (x == 1.0) | (y == 1.0), "z")
    return scene


TURN = np.pi / 6.0


@pytest.mark.parametrize("bending", [pytest.param("midedge_dof", marks=pytest.mark.slow), "hinge"])
def test_oblique_symmetry_is_rotated_axis_aligned_symmetry(device, bending):
    """Rotated by 30 degrees, statics by both solvers and steps of both schemes are rotated, and otherwise equal."""
    results = []
    for turn, axes in ((0.0, True), (TURN, False)):
        back = ddg.Motion().rotation(turn)
        model = quarter(turn, bending, axes).build(device, "float64")
        points = [statics.solve(model, solver=solver).points() for solver in ("direct", "pcg")]
        for scheme in ("implicit_euler", "implicit_midpoint"):
            integrator, state = ddg.Integrator(model, scheme), model.state()
            for _ in range(5):
                state = integrator.step(state, 0.01)
            points.append(state.points())
        results.append([x @ back for x in points])
    for aligned, oblique in zip(*results, strict=True):
        np.testing.assert_allclose(oblique, aligned, atol=1e-7)
    assert results[0][0][0, 2] < -1e-3  # the middle sags


@pytest.mark.slow
def test_oblique_symmetry_agrees_across_worlds_precisions_and_paths(device):
    """Worlds agree exactly, precisions within rounding; frequencies and path ends equal the aligned ones."""
    from ddg_warp.solve.equilibrium.continuation import Continuation
    from ddg_warp.solve.equilibrium.stability import spectrum

    results = []
    for turn, axes in ((0.0, True), (TURN, False)):
        model = quarter(turn, axes=axes).build(device, "float64")
        state = statics.solve(model)
        watch = {"middle": ddg.Displacement.of(0, "z")}
        path = Continuation(model, watch).trace(stop=ddg.StopCriterion(load=(-1.0, 0.5))).values("middle")
        results.append([*spectrum(model, state, 3).frequencies, path[-1]])
    np.testing.assert_allclose(results[1], results[0], rtol=1e-6)
    reference = ddg.Integrator(model).step(model.state(), 0.02).points()
    for precision, tolerance in (("mixed", 1e-6), ("float32", 1e-4)):
        worlds = quarter(TURN).build(device, precision, worlds=3)
        points = ddg.Integrator(worlds).step(worlds.state(), 0.02).points()
        np.testing.assert_array_equal(points[1:], points[:1].repeat(2, axis=0))
        np.testing.assert_allclose(points[0], reference, atol=tolerance)


def test_oblique_planes_keep_points_and_normal_reactions(device):
    """Sheet points stay on the oblique planes; reactions are normal to the planes and carry the weight."""
    scene = quarter(TURN)
    model = scene.build(device, "float64")
    first, second, sides = model.reactions(statics.solve(model))
    rotation = ddg.Motion().rotation(TURN)
    np.testing.assert_allclose(np.cross(first.force, rotation[:, 0]), 0.0, atol=1e-7)
    np.testing.assert_allclose(np.cross(second.force, rotation[:, 1]), 0.0, atol=1e-7)
    np.testing.assert_allclose(sides.force, (0.0, 0.0, 50.0), rtol=1e-6)
    state = ddg.Integrator(model).step(model.state(), 0.1)
    for support in scene.shell_supports[:2]:
        offset = (state.points() - model.state().points())[support.vertices] @ support.normal
        np.testing.assert_allclose(offset, 0.0, atol=1e-12)


def test_wedge_between_symmetry_planes_matches_disc(device):
    """A sixth of a disc between symmetry planes 60 degrees apart that meet on the axis equals the disc."""
    points, triangles = meshes.disc(4)
    scenes = []
    for sector in (False, True):
        angle = np.arctan2(points[:, 1], points[:, 0])
        inside = (angle > -1e-9) & (angle < np.pi / 3.0 + 1e-9) | (np.arange(len(points)) == 0)
        chosen = triangles[inside[triangles].all(1)] if sector else triangles
        used, corners = np.unique(chosen, return_inverse=True)
        scene = ddg.Scene(gravity=(0.0, 0.0, -1.0))
        x = points[used]
        scene.add_shell(x, corners.reshape(-1, 3), thickness=0.05, material=RUBBER)
        if sector:
            for normal in ((0.0, 1.0, 0.0), (-np.sin(np.pi / 3.0), np.cos(np.pi / 3.0), 0.0)):
                scene.symmetry(0, np.abs(x @ normal) < 1e-9, normal)
        else:
            scene.hold(0, [0], "xy")
            scene.hold(0, [1], "y")
        scene.hold(0, np.abs(np.linalg.norm(x, axis=1) - 1.0) < 1e-9, "z")
        scenes.append((scene, used))
    disc, wedge = (statics.solve(scene.build(device, "float64")).points() for scene, _ in scenes)
    np.testing.assert_allclose(wedge, disc[scenes[1][1]], atol=1e-7)


def test_moved_vertex_on_oblique_plane_is_refused(device):
    scene = quarter(TURN)
    scene.hold(0, [0], motion=ddg.Motion(translation=lambda t: (0.0, 0.0, t)))
    with pytest.raises(ddg.SceneError, match=r"\(0, 0, 0\) m is on a symmetry plane across .* and moved by a support"):
        scene.build(device)
    for normal in ((0.0, 0.0, 0.0), (1.0, 0.0), "xy", None):
        with pytest.raises(ddg.SceneError, match="symmetry"):
            quarter().symmetry(0, [0, 1], normal)
