"""Fields: rest strains that a scene prescribes over time and along rods, in steps, queries and equilibria."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import rest_shapes, statics
from ddg_warp.geometry import meshes
from ddg_warp.model.parameters import ParameterTable
from ddg_warp.solve.equilibrium.dynamic_relaxation import relax
from ddg_warp.solve.stepping.graph_cache import Graphs

RODS, NODES, LENGTH, DT = 2, 11, 0.5, 0.01
SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
CURL = "rod_bend_twist.rest_1"
PLACES = LENGTH * np.arange(1, NODES - 1) / (NODES - 1)  # arc lengths of vertices


def wave(s, t):
    """Return a travelling wave of natural curvature [1/m]."""
    return 3.0 * np.sin(8.0 * s - 20.0 * t)


def scene_of(kind: str = "uncoupled", **fields) -> ddg.Scene:
    """Return two straight rods, clamped at one end: uncoupled, joined, or on a plane. `fields`: arguments of `prescribe`."""
    scene = ddg.Scene()
    points = np.stack([np.linspace((0.0, 0.1 * k, 0.05), (LENGTH, 0.1 * k, 0.05), NODES) for k in range(RODS)])
    rods = scene.add_rods(
        points, section=ddg.Circle(5e-3), material=SOFT, natural="straight", director=(0.0, 0.0, 1.0), name="arms"
    )
    scene.clamp(rods)
    if kind == "joined":
        bar = np.linspace(points[0, -1], points[1, -1], 4)
        bar = scene.add_rod(bar, section=ddg.Circle(5e-3), material=SOFT, name="bar")
        scene.join([(0, NODES - 1), (bar, 0)])
        scene.join([(1, NODES - 1), (bar, 3)])
    if kind == "contact":
        scene.add_obstacle(ddg.Plane())
        scene.contact()
    if fields:
        scene.prescribe("muscle", **({"parameter": CURL, "rods": rods} | fields))
    return scene


def stepped(model, steps: int = 8, before=None, controls=None, **options):
    """Return the state after some steps, and the integrator; `before(t)` is called with the end time of each step."""
    integrator, state = ddg.Integrator(model, **options), model.state()
    for _ in range(steps):
        if before is not None:
            before(state.time + DT)
        state = integrator.step(state, DT, controls(state.time + DT) if controls else None)
    return state, integrator


def set_on_arms(model, values: np.ndarray) -> None:
    """Set the natural curvature of both arms by `set_parameter`, of the bar to zero."""
    of_bar = (
        sum(part.elements for part in model.coupled.sets if part.term.name == "rod_bend_twist") if model.coupled else 0
    )
    arms = np.tile(values, RODS)
    model.set_parameter("rod_bend_twist", "rest_1", np.pad(arms, (0, of_bar - len(arms))) if of_bar else values)


@pytest.mark.parametrize("kind", ["uncoupled", "joined", "contact"])
def test_field_equals_a_parameter_set_before_each_step(device, kind):
    """The values at the end of a step act: bitwise for uncoupled rods, with equal solver selection."""
    model = scene_of(kind, values=wave, over="arc_length").build(device, "float64")
    actual, integrator = stepped(model)
    reference = scene_of(kind).build(device, "float64")
    set_on_arms(reference, wave(PLACES, 0.0))
    expected, _ = stepped(reference, before=lambda t: set_on_arms(reference, wave(PLACES, t)))
    np.testing.assert_allclose(actual.points(), expected.points(), rtol=0.0, atol=0.0 if kind == "uncoupled" else 1e-8)
    assert np.abs(actual.points() - model.state().points()).max() > 1e-3
    assert model.version == 0
    assert integrator.statistics()["retries"] == 0


@pytest.mark.parametrize("kind", ["uncoupled", "contact"])
def test_field_costs_one_write_a_table_and_changes_nothing_else(device, kind, monkeypatch):
    """Version, layout, buffers, steppers and graphs stay; nothing is captured or selected again."""
    model = scene_of(kind, values=wave, over="arc_length").build(device, "float64")
    state, integrator = stepped(model, 4)
    state = integrator.step(state, DT)  # both buffers have their graphs
    parts = [*model.groups, *(model.coupled.sets if model.coupled else ())]

    def found():
        tables = [part.parameters for part in parts]
        return [
            model.version,
            model.layout,
            *(id(table.buffer) for table in tables),
            *(table.version for table in tables),
            *map(id, integrator._parts),
            *(part.newton.psd for part in integrator._parts),
            *(id(graph) for graph in integrator._graphs._graphs.values()),
        ]

    writes, captures, before = [], [], found()
    write, capture = ParameterTable.write, Graphs._capture
    monkeypatch.setattr(ParameterTable, "write", lambda self, *args: writes.append(1) or write(self, *args))
    monkeypatch.setattr(Graphs, "_capture", lambda self, *args: captures.append(1) or capture(self, *args))
    monkeypatch.setattr(type(integrator), "_adapt", lambda self, *args: pytest.fail("solvers are selected again"))
    for _ in range(5):
        state = integrator.step(state, DT)
    assert found() == before
    assert captures == []
    assert len(writes) == 5 * (2 if kind == "contact" else 1)  # rods in contact are also stepped as uncoupled rods


def test_steps_evaluate_at_the_end_or_the_middle_and_queries_at_the_time_of_a_state(device):
    for scheme, part in (("implicit_euler", 1.0), ("implicit_midpoint", 0.5)):
        times = []
        model = scene_of(values=lambda t, times=times: times.append(t) or 2.0 * t).build(device, "float64")
        integrator, start = ddg.Integrator(model, scheme), model.state()
        end = integrator.step(start, DT)
        np.testing.assert_allclose(times, [0.0, part * DT])
        resting, bent = model.energies(start)["rod_bend_twist"], model.energies(end)["rod_bend_twist"]
        assert times[-1] == DT
        assert resting < 1e-20 < bent
        reference = scene_of().build(device, "float64")
        set_on_arms(reference, np.full(NODES - 2, 2.0 * DT))
        same = reference.state(end.points(), end.velocities())
        assert reference.energies(same)["rod_bend_twist"] == pytest.approx(bent, rel=1e-9)


def test_fields_of_places(device):
    """Functions of arc length and position, samples, arrays by rod and by element, closed rods and clamped ends."""
    along = scene_of(values=lambda s, t: s, over="arc_length").build(device).fields.items["muscle"]
    assert along.shape == (RODS, NODES - 2)
    np.testing.assert_allclose(along.values.reshape(along.shape), np.tile(PLACES, (RODS, 1)))
    across = scene_of(values=lambda x, t: x[..., 1], over="position").build(device).fields.items["muscle"]
    np.testing.assert_allclose(across.values.reshape(across.shape), np.repeat([[0.0], [0.1]], NODES - 2, 1), atol=1e-15)
    edges = scene_of(values=lambda s, t: 1.0 + s, over="arc_length", parameter="rod_stretch.rest").build(device)
    np.testing.assert_allclose(
        edges.fields.items["muscle"].values[: NODES - 1], 1.0 + LENGTH * (np.arange(NODES - 1) + 0.5) / (NODES - 1)
    )
    for values in ([[1.0], [2.0]], np.repeat([1.0, 2.0], NODES - 2)):
        model = scene_of(values=values).build(device)
        stored = model.parameters()["0/rod_bend_twist/rest_1"][: NODES - 2]
        np.testing.assert_array_equal(stored, np.tile([1.0, 2.0], (NODES - 2, 1)))
    samples = ddg.Samples([[0.0, 1.0], [2.0, 5.0]], times=[0.0, 1.0], arc_lengths=[0.0, 0.5])
    assert samples(0.25, 0.5) == pytest.approx(2.0)
    assert samples(9.0, 9.0) == 5.0
    assert ddg.Samples([1.0, 3.0], times=[0.0, 1.0])(0.25) == pytest.approx(1.5)
    np.testing.assert_allclose(ddg.Samples([[1.0, 0.0], [3.0, 1.0]], times=[0.0, 1.0])(0.5), [2.0, 0.5])
    ring = ddg.Scene(gravity=(0, 0, 0))
    angle = 2.0 * np.pi * np.arange(8) / 8
    ring.add_rod(
        np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1), section=ddg.Circle(0.01), material=SOFT, closed=True
    )
    ring.add_rod([(0, 0, 1), (1, 0, 1), (2, 0, 1), (3, 0, 1)], section=ddg.Circle(0.01), material=SOFT)
    ring.clamp_end(1)
    ring.prescribe("all", CURL, lambda s, t: s, over="arc_length")
    item = ring.build(device).fields.items["all"]
    side = 2.0 * np.sin(np.pi / 8)
    assert item.shape == (item.size,)
    np.testing.assert_allclose(item.values, [*(side * np.arange(1, 9)), 0.0, 1.0, 2.0], atol=1e-12)


@pytest.mark.parametrize("kind", ["uncoupled", "joined", "contact"])
def test_controls_replace_fields_by_world(device, kind):
    """Each world moves as a model of one world; without controls the scene's values act again."""
    amplitudes = np.array([0.0, 1.0, -2.0])
    together = scene_of(kind, values=0.5).build(device, "float64", worlds=3)
    state, _ = stepped(together, controls=lambda t: ddg.Controls(fields={"muscle": 20.0 * t * amplitudes}))
    for world, amplitude in enumerate(amplitudes):
        single = scene_of(kind, values=0.5).build(device, "float64")
        expected, _ = stepped(single, controls=lambda t, a=amplitude: ddg.Controls(fields={"muscle": 20.0 * t * a}))
        np.testing.assert_allclose(state.points()[world], expected.points(), rtol=0.0, atol=1e-12)
    shapes = [(), (3,), (3, 1), (RODS, NODES - 2), (RODS * (NODES - 2),), (3, RODS, NODES - 2), (3, RODS * (NODES - 2))]
    integrator = ddg.Integrator(together)
    ends = [
        integrator.step(together.state(), DT, ddg.Controls(fields={"muscle": np.full(s, 2.0)})).points() for s in shapes
    ]
    for end in ends[1:]:
        np.testing.assert_array_equal(end, ends[0])
    usual = ddg.Integrator(scene_of(kind, values=0.5).build(device, "float64", worlds=3))
    np.testing.assert_allclose(
        integrator.step(together.state(), DT).points(),
        usual.step(usual.model.state(), DT).points(),
        rtol=0.0,
        atol=1e-12,
    )


def test_retried_step_uses_the_same_values(device):
    """Substeps of a step that failed at first use the values at the end of the whole step."""
    options = {"max_iterations": 4}
    model = scene_of(values=lambda t: 10000.0 * t).build(device, "float64")
    state, integrator = stepped(model, 3, **options)
    assert integrator.statistics()["retries"] > 0
    reference = scene_of().build(device, "float64")
    expected, _ = stepped(
        reference, 3, before=lambda t: set_on_arms(reference, np.full(NODES - 2, 10000.0 * t)), **options
    )
    np.testing.assert_allclose(state.points(), expected.points(), rtol=0.0, atol=1e-7)


def test_resumed_copied_and_reset_runs(device):
    """A restored state steps as the run did, in a rebuilt model, too; reset worlds start from rest at the common time."""
    import pickle

    scene = scene_of(values=wave, over="arc_length")
    model = scene.build(device, "float64")
    middle, _ = stepped(model, 4)
    snapshot = middle.snapshot()
    expected = ddg.Integrator(model).step(middle, DT).points()
    again = scene.build(device, "float64")
    np.testing.assert_array_equal(ddg.Integrator(again).step(again.restore(snapshot), DT).points(), expected)
    constant = scene_of(values=2.0).build(device, "float64", worlds=2)
    ddg.Integrator(constant).step(constant.state(), DT, ddg.Controls(fields={"muscle": [1.0, 3.0]}))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(constant)).parameters()["0/rod_bend_twist/rest_1"][0], 2.0)
    worlds = scene.build(device, "float64", worlds=2)
    integrator, state = ddg.Integrator(worlds), worlds.state()
    for _ in range(3):
        state = integrator.step(state, DT)
    state = integrator.step(integrator.reset(state, [True, False]), DT)
    later = scene.build(device, "float64")
    start = later.state()
    start.time = 3 * DT
    np.testing.assert_allclose(state.points()[0], ddg.Integrator(later).step(start, DT).points(), rtol=0.0, atol=1e-12)


def test_growth_is_a_load(device):
    """Equilibria follow a natural curvature in load steps; controls are reached on a straight path."""
    kappa = 4.0 * np.pi / LENGTH
    grown = scene_of(values=lambda factor: factor * kappa)
    grown.gravity = (0.0, 0.0, 0.0)
    model, path = grown.build(device, "float64"), []
    end = statics.solve(model, load_steps=8, way=path)
    assert len(path) == 8 and model.version == 0
    for state in (path[3], end):  # edges of circles rotate by the natural curvature over their length
        edges = np.diff(state.points().reshape(RODS, NODES, 3)[0], axis=0)
        cosine = (edges[1:-1] * edges[2:]).sum(1) / np.prod(
            [np.linalg.norm(e, axis=1) for e in (edges[1:-1], edges[2:])], 0
        )
        turning = 2.0 * np.arctan(0.5 * kappa * state.time * LENGTH / (NODES - 1))
        np.testing.assert_allclose(np.arccos(cosine), turning, rtol=1e-8)
        assert model.energies(state)["rod_bend_twist"] < 1e-12
    half = relax(model, path[2], at=0.5, residual=1e-5)  # from the equilibrium at 3/8
    np.testing.assert_allclose(half.points(), path[3].points(), rtol=0.0, atol=1e-3)
    still = scene_of(values=0.0)
    still.gravity = (0.0, 0.0, 0.0)
    controlled = statics.solve(
        still.build(device, "float64"), load_steps=8, controls=ddg.Controls(fields={"muscle": kappa})
    )
    np.testing.assert_allclose(controlled.points(), end.points(), rtol=0.0, atol=1e-12)


def test_bilayer_strip_rolls_up_in_one_call(device):
    """A strip of two layers rolls up by 1.2 revolutions in eight load steps, as by `rest`."""
    flat, triangles = meshes.rectangle(30, 4, (0.1, 0.01), "alternating")
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    strip = scene.add_shell(flat, triangles, thickness=5e-4, material=ddg.Material(young=1e6, poisson=0.45))
    scene.clamp_boundary(strip, np.flatnonzero(flat[:, 0] < 1e-9))
    bare = scene.copy()
    kappa = 2.0 * np.pi * 1.31 / 0.1
    curled = rest_shapes.principal_form(flat, triangles, kappa, kappa)
    plain, grown = (rest_shapes.grown_metric(flat, triangles, stretch) for stretch in (1.0, 1.05))
    scene.prescribe("curl", "curvature", lambda factor: factor * curled, shell=strip)
    scene.prescribe("swelling", "metric", lambda factor: plain + factor * (grown - plain), shell=strip)
    model = scene.build(device, "float64")
    end = statics.solve(model, load_steps=8)
    middle = np.flatnonzero(np.abs(flat[:, 1] - 0.005) < 1e-9)
    edges = np.diff(end.points()[middle[np.argsort(flat[middle, 0])]], axis=0)
    angle = np.unwrap(np.arctan2(edges[:, 2], edges[:, 0]))
    assert abs(angle[-1] - angle[0]) > 2.0 * np.pi * 1.2
    assert end.stable and model.version == 0
    with pytest.raises(ValueError, match="field 'swelling'"):
        model.set_rest(strip, points=flat)
    expected = statics.solve(
        bare.build(device, "float64"), load_steps=8, rest={strip: {"curvature": curled, "metric": grown}}
    )
    np.testing.assert_allclose(end.points(), expected.points(), rtol=0.0, atol=1e-12)


def fails(t):
    """Raise an error."""
    raise IndexError(f"no value at {t}")


def refused(call, *texts, error=ddg.SceneError):
    """Assert that a call raises an error with some texts in the message."""
    with pytest.raises(error) as caught:
        call()
    for text in texts:
        assert text in str(caught.value)


def test_refusals(device):
    """Messages name the field and the remedy."""
    model = scene_of(values=1.0).build(device, worlds=2)
    integrator, state = ddg.Integrator(model), model.state()

    def step(**fields):
        return lambda: integrator.step(state, DT, ddg.Controls(fields=fields))

    refused(step(muscles=1.0), "no field 'muscles'", "'muscle'")
    refused(step(muscle=np.zeros(5)), "'muscle' has shape (5,)", str((RODS, NODES - 2)))
    refused(step(muscle=[1.0, np.nan]), "'muscle'", "not finite")
    refused(lambda: integrator.step(state, DT, ddg.Controls(fields=[1.0])), "fields are", "by name")
    refused(lambda: ddg.Integrator(scene_of().build(device)).step(None, DT), "step")
    refused(scene_of(values=np.zeros(5)).build, "the field 'muscle' has shape (5,)")
    refused(scene_of(parameter="rod_bend_twist.rest_7").build, "rest_7", CURL, "arms")
    refused(scene_of(parameter="rod_bend_twist.stiffness_1").build, "no rest strain")
    twice = scene_of(values=1.0)
    refused(lambda: twice.prescribe("muscle", CURL), "'muscle' already")
    twice.prescribe("second", CURL, rods=[1])
    refused(twice.build, "rod 1", "'muscle'", "'second'")
    refused(lambda: scene_of(over="space", values=1.0), "over")
    refused(lambda: scene_of(rods=[7], values=1.0), "rod 7")
    refused(lambda: twice.prescribe("form", "metric", shell=0), "shell 0", "0 shells")
    refused(lambda: model.set_parameter("rod_bend_twist", "rest_1", 1.0), "field 'muscle'", error=ValueError)
    refused(
        lambda: rest_shapes.set_rest_strains(model, {CURL: np.zeros(2 * (NODES - 2))}), "'muscle'", error=ValueError
    )
    refused(lambda: statics.solve(model, rest={0: {"curvature": 1.0}}), "rest[0]", "field 'muscle'")
    refused(lambda: ddg.Samples([1.0, 2.0], times=[1.0, 0.0]), "times")
    refused(lambda: ddg.Samples([1.0, 2.0, 3.0], times=[0.0, 1.0]), "values have shape (3,)")
    refused(lambda: ddg.Samples(np.zeros((2, 3, 4)), [0.0, 1.0], [0.0, 1.0, 2.0]), "values have shape (2, 3, 4)")
    moving = scene_of(values=lambda t: t).build(device)
    refused(lambda: ddg.continuation.Continuation(moving), "continuation", "load_steps")


def test_samples_in_time_have_any_shape():
    poses = ddg.Samples(np.arange(24.0).reshape(2, 2, 6), times=[0.0, 1.0])
    np.testing.assert_array_equal(poses(0.5), np.arange(12.0).reshape(2, 6) + 6.0)


@pytest.mark.parametrize(
    ("function", "text"),
    [
        (lambda t: 1.0 if t < 0.015 else np.nan, "not finite"),
        (lambda t: 1.0 if t < 0.015 else np.zeros(3), "shape (3,)"),
        (lambda t: 1.0 if t < 0.015 else fails(t), "IndexError"),
    ],
)
def test_failing_functions_name_field_and_time(device, function, text):
    """A failing function refuses the step, and the last state can be stepped further."""
    model = scene_of(values=function).build(device)
    integrator = ddg.Integrator(model)
    state = integrator.step(model.state(), DT)
    refused(lambda: integrator.step(state, DT), "the field 'muscle'", "0.02", text, error=ddg.SolverError)
    assert np.isfinite(integrator.step(state, 0.4 * DT).points()).all()
    refused(scene_of(values=fails).build, "the field 'muscle'", "IndexError")
