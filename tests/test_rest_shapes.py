"""Rest shapes of shells: forms from principal values, growth, curvature, creases, pre-stress, and named mistakes."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.geometry.fundamental_forms import edge_kinds, metric, second_form
from ddg_warp.geometry.surface import Surface
from ddg_warp.model.rest_shapes import bilayer_curvature, grown_metric, principal_form
from ddg_warp.solve.equilibrium.statics import solve
from ddg_warp.solve.equilibrium.tangent import Tangent

MATERIAL = ddg.Material(1e6, 0.3, density=1000.0)
THICKNESS = 0.02


def patch(bending="midedge_dof", shells=1, fold=None):
    """Return jittered squares a metre apart, with statically determinate supports."""
    points, triangles = meshes.jittered_rectangle(4, 4, jitter=0.2)
    if fold is not None:
        points = fold(points)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    for i in range(shells):
        shell = scene.add_shell(
            points + [0.0, 0.0, float(i)], triangles, thickness=THICKNESS, material=MATERIAL, bending=bending
        )
        scene.hold(shell, [0], "xyz")
        scene.hold(shell, [4], "yz")
        scene.hold(shell, [20], "z")
    return scene, points, triangles


def bowl(points):
    """Return points of a surface with every kind of curvature."""
    x, y = points[:, 0], points[:, 1]
    return np.stack([x, y, 0.3 * x * y + 0.2 * x**2 - 0.1 * y**2], -1)


def test_principal_form_of_the_plane():
    """Unit stretches give the metric; principal values and directions equal the form, in any basis."""
    points, triangles = meshes.jittered_rectangle(4, 4)
    np.testing.assert_allclose(
        grown_metric(points, triangles, 1.0), metric(Surface(points, triangles), points), atol=1e-15
    )
    direction = np.array([0.6, 0.8, 0.0])
    form = principal_form(points, triangles, 3.0, -2.0, direction)
    corners = points[triangles]
    a = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], 1)[..., :2]
    plane = 3.0 * np.outer(direction, direction) - 2.0 * np.outer([-0.8, 0.6, 0.0], [-0.8, 0.6, 0.0])
    expected = np.einsum("tim,mn,tjn->tij", a, plane[:2, :2], a)
    np.testing.assert_allclose(form, expected[:, [0, 0, 1], [0, 1, 1]], atol=1e-15)


def test_curvature_is_positive_towards_the_normal():
    """An outward-facing cylinder bends away from the normal: -1 / R around, 0 along the axis."""
    points, triangles = meshes.cylinder(64, 12, 2.0, 1.0)
    surface = Surface(points, triangles)
    kinds = edge_kinds(surface)
    around = np.cross([0.0, 0.0, 1.0], points[triangles].mean(1))
    inside = (kinds.of_triangles(surface)[0] == 1).all(1)
    expected = principal_form(points, triangles, -0.5, 0.0, around)[inside]
    measured = second_form(surface, points, kinds)[inside]
    np.testing.assert_allclose(measured, expected, atol=2e-3 * np.abs(expected).max())


@pytest.mark.parametrize("bending", ["midedge_dof", pytest.param("midedge", marks=pytest.mark.slow), "hinge"])
@pytest.mark.parametrize("size", [0.9, 1.1])
def test_growth_alone_changes_the_size(device, bending, size):
    """A metric size^2 times as large gives a surface `size` times as large; other shells stay."""
    scene, points, _ = patch(bending, shells=2)
    model = scene.build(device, "float64")
    before = model.version
    model.set_rest(1, metric=size**2 * metric(Surface(points, scene.shells[1].triangles), points))
    assert model.version > before
    first, second = np.split(solve(model, mode="follow").points(), 2)
    np.testing.assert_allclose(first, points, atol=1e-12)
    np.testing.assert_allclose(second, size * points + [0.0, 0.0, 1.0], atol=1e-9)


@pytest.mark.parametrize("bending", ["midedge_dof", "midedge", "hinge"])
def test_rest_shape_has_no_force(device, bending):
    """The second of two shells gets another rest shape: forces vanish there, not at the old one; the first stays."""
    scene, points, _ = patch(bending, shells=2)
    model = scene.build(device, "float64")
    tangent = Tangent(model)
    shape = bowl(points)
    model.set_rest(1, points=shape)
    states = [np.concatenate([points, second + [0.0, 0.0, 1.0]]) for second in (shape, points)]
    bent, flat = (np.abs(tangent.gradient(model.state(points=x))) for x in states)
    assert bent.max() < 1e-12 * flat.max()
    assert flat.max() > 1.0
    single_model = patch(bending, shells=1)[0].build(device, "float64")
    moved = bowl(points)
    both = tangent.gradient(model.state(points=np.concatenate([moved, states[0][len(points) :]]))).reshape(-1, 3)
    single = Tangent(single_model).gradient(single_model.state(points=moved)).reshape(-1, 3)
    np.testing.assert_allclose(both[: len(points)], single[: len(points)], atol=1e-12 * np.abs(single).max())


def test_rest_in_add_shell_equals_set_rest(device):
    """`add_shell(rest=(abar, bbar))` and `set_rest` give equal energies and forces, bit for bit."""
    scene, points, triangles = patch()
    forms = grown_metric(points, triangles, 1.05, 0.98), principal_form(points, triangles, 0.7, 0.2, (1.0, 1.0, 0.0))
    model = scene.build(device, "float64")
    model.set_rest(0, metric=forms[0], curvature=forms[1])
    scene.shells[0].rest = forms
    rebuilt = scene.build(device, "float64")
    state = model.state(points=bowl(points)), rebuilt.state(points=bowl(points))
    one, two = Tangent(model), Tangent(rebuilt)
    np.testing.assert_array_equal(one.gradient(state[0]), two.gradient(state[1]))
    assert one.energy(state[0]) == two.energy(state[1])


def test_set_rest_keeps_forms_that_are_not_given(device):
    scene, points, triangles = patch()
    forms = {"metric": grown_metric(points, triangles, 1.05), "curvature": principal_form(points, triangles, 0.7)}
    gradients = []
    for steps in (["metric", "curvature"], ["curvature", "metric"]):
        model = scene.build(device, "float64")
        for name in steps:
            model.set_rest(0, **{name: forms[name]})
        gradients.append(Tangent(model).gradient(model.state(points=bowl(points))))
    np.testing.assert_array_equal(*gradients)
    assert np.abs(gradients[0]).max() > 1.0


def test_crease(device):
    """Two triangles fold by the given rest angle."""
    points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 1.0, 0.0], [0.5, -1.0, 0.0]])
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    shell = scene.add_shell(
        points, [[0, 1, 2], [1, 0, 3]], thickness=THICKNESS, material=MATERIAL, bending="hinge", name="fold"
    )
    scene.hold(shell, [0, 1, 2])
    model = scene.build(device, "float64")
    surface = Surface(points, scene.shells[0].triangles)
    angle = np.zeros(len(surface.edges))
    angle[surface.edge_between(0, 1)] = 0.8
    model.set_rest(shell, angle=angle)
    end = solve(model, rtol=1e-12).points()[3]
    # convex on the side of the normal +z: the free triangle moves down
    np.testing.assert_allclose(end, [0.5, -np.cos(0.8), -np.sin(0.8)], atol=1e-9)


def test_pre_stress(device):
    """A fixed membrane shrunk by 2 % has the energy A K (1 + nu) E^2 with E = (1 / 0.98^2 - 1) / 2 and rest area A."""
    scene, points, triangles = patch()
    model = scene.build(device, "float64")
    model.set_rest(0, metric=grown_metric(points, triangles, 0.98))
    strain = 0.5 * (1.0 / 0.98**2 - 1.0)
    exact = 0.98**2 * 1e6 * THICKNESS / (1.0 - 0.3) * strain**2
    assert Tangent(model).energy(model.state())["shell_stretch"] == pytest.approx(exact, rel=1e-12)


def test_set_rest_of_a_curved_membrane(device):
    """Growth set later equals growth at build for elements of the curved membrane."""
    points, triangles = meshes.rectangle(4, 3)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_shell(points, triangles, thickness=THICKNESS, material=MATERIAL, membrane="curved")
    model = scene.build(device, "float64")
    grown = grown_metric(points, triangles, 0.98)
    model.set_rest(0, metric=grown)
    start = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rest = (grown, np.zeros_like(grown))
    start.add_shell(points, triangles, thickness=THICKNESS, material=MATERIAL, membrane="curved", rest=rest)
    rebuilt = start.build(device, "float64")
    forces = [Tangent(m).gradient(m.state()) for m in (model, rebuilt)]
    assert np.abs(forces[0]).max() > 0.0
    np.testing.assert_allclose(forces[0], forces[1], rtol=1e-12, atol=1e-12 * np.abs(forces[1]).max())


def test_failed_set_rest_changes_nothing(device):
    """Everything that may fail comes before the first change: plate and elements stay."""
    scene, points, triangles = patch()
    model = scene.build(device, "float64")
    plate, version = model.coupled.host.shells[0].plate, model.version
    before = Tangent(model).gradient(model.state())
    first = dict(model.coupled.host.shells[0].first)
    model.coupled.host.shells[0].first.pop("shell_bend_dof")
    with pytest.raises(KeyError):
        model.set_rest(0, metric=grown_metric(points, triangles, 0.9))
    model.coupled.host.shells[0].first.update(first)
    assert model.coupled.host.shells[0].plate is plate
    assert model.version == version
    np.testing.assert_array_equal(Tangent(model).gradient(model.state()), before)


def test_set_rest_applies_to_every_world(device):
    scene, points, triangles = patch()
    model = scene.build(device, "float64", worlds=2)
    model.set_parameter("shell_bend_dof", "stiffness", np.array([1.0, 2.0]))
    model.set_rest(0, curvature=principal_form(points, triangles, 0.5))
    one, two = np.split(Tangent(model).gradient(model.state()), 2)
    assert np.abs(one).max() > 0.0
    # rounding of the membrane, whose stiffness is equal in both worlds
    rounding = 64 * np.finfo(float).eps * MATERIAL.young * THICKNESS
    np.testing.assert_allclose(two, 2.0 * one, rtol=1e-14, atol=rounding)  # the stiffness of each world stays


# kappa h / mismatch (Timoshenko 1925): 3/2 for equal layers, also where h1 / h2 = 1/2 or E1 / E2 = 10.
@pytest.mark.parametrize(
    ("h1", "young1", "value"), [(1.0, 1.0, 1.5), (0.5, 1.0, 1.333333333), (1.0, 10.0, 0.9958506224)]
)
def test_bilayer_curvature(h1, young1, value):
    assert bilayer_curvature(1e-3, h1, 1.0, young1) * (h1 + 1.0) / 1e-3 == pytest.approx(value, rel=1e-9)


@pytest.mark.parametrize(
    ("bending", "arguments", "message"),
    [
        ("midedge_dof", {"shell": 1, "metric": 0}, "shell 1 does not exist; the model has 1 shells"),
        ("midedge_dof", {}, "give points, metric, curvature or angle"),
        ("midedge_dof", {"metric": np.ones((3, 3))}, "metric has shape (3, 3)"),
        ("midedge_dof", {"metric": np.ones((32, 3))}, "metric of triangle 0"),
        ("midedge_dof", {"curvature": np.full((32, 3), np.nan)}, "curvature has shape (32, 3); give finite"),
        ("midedge_dof", {"angle": np.zeros(56)}, "has no rest angles"),
        ("hinge", {"curvature": np.zeros((32, 3))}, "no rest curvature of a triangle"),
        ("isometric", {"metric": np.ones((32, 3))}, "keeps its flat rest shape"),
        ("hinge", {"points": np.zeros((2, 3))}, "points has shape (2, 3)"),
    ],
)
def test_mistakes_are_named(device, bending, arguments, message):
    model = patch(bending)[0].build(device, "float64")
    with pytest.raises(ValueError) as error:
        model.set_rest(**{"shell": 0, **arguments})
    assert message in str(error.value)


def test_direction_across_the_surface_is_refused():
    points, triangles = meshes.rectangle(2, 2)
    with pytest.raises(ValueError, match="triangle 0: direction"):
        principal_form(points, triangles, 1.0, 0.0, (0.0, 0.0, 1.0))


def test_growth_by_load_steps(device):
    """Rest curvature of a bilayer applied by load steps gives an arc, as does setting it stepwise."""
    points, triangles = meshes.rectangle(16, 2, (0.1, 0.0125), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    strip = scene.add_shell(points, triangles, thickness=5e-4, material=ddg.Material(1e6, 0.0), name="strip")
    scene.clamp_boundary(strip, np.flatnonzero(points[:, 0] < 1e-9))
    curvature = 15.0  # a quarter of a revolution
    form = principal_form(points, triangles, curvature, 0.0)
    model = scene.build(device, "float64")
    states = []
    state = solve(model, rest={"strip": dict(curvature=form)}, load_steps=4, way=states)
    end = state.points()[np.argmax(points[:, 0])]  # of an arc with that curvature
    assert np.hypot(*end[[0, 2]]) == pytest.approx(2.0 * np.sin(0.5 * curvature * 0.1) / curvature, rel=2e-2)
    half = scene.build(device, "float64")
    half.set_rest(strip, curvature=0.5 * form)
    np.testing.assert_allclose(
        states[1].points(), solve(half, half.state(points=states[1].points())).points(), atol=1e-9
    )
    whole = scene.build(device, "float64")
    whole.set_rest(strip, curvature=form)
    np.testing.assert_allclose(solve(whole, whole.state(points=state.points())).points(), state.points(), atol=1e-9)


@pytest.mark.parametrize("kind", ["planar", "alone", "joined"])
def test_natural_curvature_by_load_steps(device, kind):
    """A cantilever with natural curvature pi / L ends as half a circle, in one load step or five.

    The rigid joint between two rods keeps its rest shape, so that these rotate by 39 of 40 vertex angles.
    """
    for steps in (1, 5):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2 if kind == "planar" else 3)
        points = np.linspace((0, 0, 0), (1.0, 0, 0), 41)
        parts = (points[:21], points[20:]) if kind == "joined" else (points,)
        rods = [scene.add_rod(part, section=ddg.Circle(0.01), material=ddg.Material(1e6)) for part in parts]
        if kind == "joined":
            scene.join([(rods[0], -1), (rods[1], 0)])
        scene.clamp_end(rods[0])
        model = scene.build(device, "float64")
        bent = np.pi if kind == "planar" else (np.pi, 0.0)
        state = solve(model, rest={rod: dict(curvature=bent) for rod in rods}, load_steps=steps)
        x = state.points()
        rotation = np.pi * (39.0 / 40.0 if kind == "joined" else 1.0)
        assert np.linalg.norm(x[-1] - x[0]) == pytest.approx(2.0 / rotation * np.sin(0.5 * rotation), rel=2e-2)
        energy = sum(float(np.sum(value)) for value in model.energies(state).values())
        assert energy < 1e-10 or kind == "joined"


def test_rest_shapes_that_do_not_fit_are_refused(device):
    points, triangles = meshes.rectangle(2, 2)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    scene.hold(
        scene.add_shell(points, triangles, thickness=1e-2, material=ddg.Material(1e6, 0.3), name="sheet"), [0, 1, 2]
    )
    scene.clamp_end(
        scene.add_rod(np.linspace((0, 0, 1), (1, 0, 1), 5), section=ddg.Circle(0.01), material=ddg.Material(1e6))
    )
    model = scene.build(device, "float64")
    for rest, message in (
        ({"none": dict(curvature=1.0)}, r"rest\['none'\] is no shell or rod"),
        ({0: dict(metrics=1.0)}, r"rest\[0\] has \['metrics'\]; there are"),
        ({"sheet": dict(metric=np.zeros((3, 3)))}, r"rest\['sheet'\].*shape"),
        ({0: dict(twist=(1.0, 2.0))}, r"rest\[0\]\['twist'\]"),
        (3, "give a dictionary"),
    ):
        with pytest.raises(ddg.SceneError, match=message):
            solve(model, rest=rest)
