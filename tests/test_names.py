"""Access by name and handle: points, reactions, stress resultants, watched displacements; rods of unequal node counts."""

import pickle

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import continuation, meshes, statics
from ddg_warp.scene.handle import Handle

LENGTH, RADIUS, YOUNG = 1.0, 0.01, 1e7
SOFT = {"section": ddg.Circle(RADIUS), "material": ddg.Material(young=YOUNG, density=1000.0)}


def straight(nodes: int, start: float = 0.0, y: float = 0.0) -> np.ndarray:
    return np.linspace((start, y, 0.0), (start + LENGTH, y, 0.0), nodes)


def several(device):
    """Return a model of two rods, a shell and an obstacle, and its handles."""
    scene = ddg.Scene(gravity=(0.0, 0.0, -1.0))
    cable, beam = (
        scene.add_rod(straight(5), name="cable", **SOFT),
        scene.add_rod(straight(7, y=1.0), name="beam", **SOFT),
    )
    points, triangles = meshes.rectangle(3, 2, (1.0, 1.0))
    sheet = scene.add_shell(
        points - [0.0, 0.0, 1.0], triangles, thickness=0.01, material=SOFT["material"], name="sheet"
    )
    post = scene.add_obstacle(ddg.Sphere((0.5, 0.0, -3.0), 0.1), name="post")
    supports = [
        scene.clamp(cable, name="left"),
        scene.fix(beam, [0, -1], name="pins"),
        scene.hold(sheet, [0, 1, 2], name="rim"),
    ]
    scene.contact()
    return scene.build(device), cable, beam, sheet, post, supports


def test_handles_are_indices_with_kind_and_name(device):
    model, cable, beam, sheet, post, supports = several(device)
    assert (cable, beam, sheet, post, *supports) == (0, 1, 0, 0, 0, 1, 0)
    assert [repr(each) for each in (beam, sheet, post)] == [
        "<rod 1 'beam'>",
        "<shell 0 'sheet'>",
        "<obstacle 0 'post'>",
    ]
    assert f"{beam}" == "1"
    assert (model.rod("beam"), model.rod("beam").kind) == (1, "rod")
    assert model.rods() == [0, 1]
    assert model.shell("sheet").kind == "shell"
    assert model.obstacle("post").name == "post"
    loaded = pickle.loads(pickle.dumps(beam))
    assert (loaded, loaded.kind, loaded.name) == (1, "rod", "beam")


def test_points_by_name_are_rows_of_all_points(device):
    model, cable, beam, sheet, _, _ = several(device)
    state = model.state(velocities=np.arange(3.0 * model.points_count).reshape(-1, 3))
    points, velocities = state.points(), state.velocities()
    for item, rows in ((cable, slice(0, 5)), ("beam", slice(5, 12)), (1, slice(5, 12)), (sheet, slice(12, None))):
        np.testing.assert_array_equal(state.points(item), points[rows])
        np.testing.assert_array_equal(state.velocities(item), velocities[rows])
    np.testing.assert_array_equal(state.points("post"), [[0.5, 0.0, -3.0]])
    np.testing.assert_array_equal(state.velocities("post"), [[0.0, 0.0, 0.0]])
    np.testing.assert_array_equal(state.directors(beam), state.directors()[4:])
    np.testing.assert_array_equal(state.angles(beam), state.angles()[4:])
    np.testing.assert_allclose(state.tangents(beam), np.tile([1.0, 0.0, 0.0], (6, 1)), atol=1e-7)


def test_points_of_several_rods_have_an_axis(device):
    scene = ddg.Scene()
    rods = scene.add_rods(np.stack([straight(4, y=k) for k in range(3)]), name="strand", **SOFT)
    state = scene.build(device, worlds=2).state()
    assert state.points(rods).shape == (2, 3, 4, 3)
    np.testing.assert_allclose(state.points(rods[1:])[0, :, 0, 1], [1.0, 2.0])
    with pytest.raises(ddg.SceneError, match=r"3 rods are named 'strand', 0, 1, 2; give one by its handle or index"):
        state.points("strand")


def test_unknown_names_are_refused_with_the_nearest(device):
    model, cable, _, sheet, _, _ = several(device)
    with pytest.raises(ddg.SceneError, match=r"no rod is named 'cabel'; did you mean 'cable'\?"):
        model.rod("cabel")
    with pytest.raises(ddg.SceneError, match=r"nothing is named 'shet'; did you mean 'sheet'\?"):
        model.state().points("shet")
    with pytest.raises(ddg.SceneError, match=r"rod 2 does not exist; there are 2"):
        model.state().points(2)
    with pytest.raises(ddg.SceneError, match=r"<shell 0 'sheet'> is no rod; give a rod"):
        model.state().angles(sheet)
    with pytest.raises(ddg.SceneError, match=r"<shell 0 'sheet'> is no rod"):
        ddg.Scene().clamp(sheet)
    with pytest.raises(ddg.SceneError, match=r"rods have 5 to 7 nodes"):
        model.state().points([0, 1])
    with pytest.raises(ddg.SceneError, match=r"<rod 0 'cable'> is no shell"):
        model.stresses(model.state()).shell(cable)


def test_reactions_by_name_and_handle_equal_those_by_index(device):
    model, cable, _, _, post, supports = several(device)
    reactions = model.reactions(statics.solve(model))
    assert len(reactions) == 4
    for index, (name, handle) in enumerate(zip(("left", "pins", "rim", "post"), (*supports, post), strict=True)):
        assert reactions[name] is reactions[index]
        assert reactions[handle] is reactions[index]
    assert [len(each) for each in (reactions[1:], list(reactions))] == [3, 4]
    with pytest.raises(ddg.SceneError, match=r"<rod 0 'cable'> is no support"):
        reactions[cable]
    with pytest.raises(ddg.SceneError, match=r"no support is named 'rigt'"):
        reactions["rigt"]


@pytest.mark.parametrize("joined", [False, True])
@pytest.mark.parametrize("closed_form", ["tip force", "torque"])
def test_resultants_of_a_cantilever(joined, closed_form, device):
    """Beam theory: M(s) = P (L - s) about y, shear -P along z, under a tip force -P; constant T under a twisting moment T."""
    force, torque = 1e-3, 2e-4
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    if joined:
        rods = [scene.add_rod(0.5 * straight(11), **SOFT), scene.add_rod(0.5 * straight(11, start=1.0), **SOFT)]
        scene.join([(rods[0], -1), (rods[1], 0)])
    else:
        rods = [scene.add_rod(straight(21), **SOFT)]
    support = scene.clamp_end(rods[0], name="wall")
    if closed_form == "tip force":
        scene.add_force(rods[-1], -1, (0.0, 0.0, -force))
    else:
        scene.add_twisting_moment(rods[-1], -1, torque)
    model = scene.build(device, "float64")
    state = statics.solve(model)
    each = [model.stresses(state).rod(rod) for rod in rods]
    moment, twisting = (np.concatenate([getattr(one, name) for one in each]) for name in ("moment", "torque"))
    shear = np.concatenate([one.shear for one in each])
    s = np.concatenate([np.linspace(0.0, 0.5, 11), np.linspace(0.5, 1.0, 11)]) if joined else np.linspace(0.0, 1.0, 21)
    if closed_form == "tip force":
        np.testing.assert_allclose(moment[:, 1], force * (LENGTH - s), rtol=1e-3, atol=1e-9)  # deflection 4e-3 L
        np.testing.assert_allclose(shear[:, 2], -force, rtol=1e-3)
        np.testing.assert_allclose(twisting, 0.0, atol=1e-12)
        reaction = model.reactions(state)[support]
        np.testing.assert_allclose(reaction.force, [0.0, 0.0, force], atol=1e-8)
        np.testing.assert_allclose(-reaction.moment[1], moment[0, 1], rtol=1e-3)
    else:
        np.testing.assert_allclose(twisting[:-1], torque, rtol=1e-6)
        assert np.isnan(twisting[-1])
        np.testing.assert_allclose(moment[:-1], 0.0, atol=1e-9)
    assert each[0].units["shear"] == "N"


@pytest.mark.parametrize(("options", "dimension"), [({}, 3), ({"twist": False}, 3), ({}, 2)])
def test_resultants_of_a_bar_under_tension(options, dimension, device):
    """N = F along a bar, without moment or shear; nothing is known at the outer node of the clamped edge."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension)
    rod = scene.add_rod(straight(6), name="bar", **SOFT, **options)
    scene.clamp(rod)
    scene.add_force(rod, -1, (3.0, 0.0, 0.0))
    scene.add_force(rod, -1, (0.0, 0.0, -1e-3))
    model = scene.build(device, "float64")
    bar = model.stresses(statics.solve(model)).rod("bar")
    assert [values.shape for values in vars(bar).values()] == [(5,), (5, 3), (6, 3), (6,)]
    np.testing.assert_allclose(bar.axial_force[1:], 3.0, rtol=1e-5)
    assert np.isnan(bar.moment[0]).all()
    assert np.isnan(bar.shear[0]).all()
    assert (bar.moment[1:-1, 1] > 0.0).all()
    np.testing.assert_allclose(bar.moment[-1], 0.0)


@pytest.mark.parametrize("joined", [False, True])
def test_resultants_of_worlds_have_an_axis(joined, device):
    """N of each world follows the positions there; springs carry neither moment nor shear."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(straight(4), **SOFT)
    spring = scene.add_rod(straight(3, start=1.0), bend=False, **SOFT)
    if joined:
        scene.join([(rod, -1), (spring, 0)], rigid=False)
    scene.clamp(rod)
    scene.fix(spring, [0, -1])
    model = scene.build(device, "float64", worlds=2)
    points = model.state().points()
    points[1, 6:, 0] += 1e-3  # last node of the spring, over edges of 0.5 m
    stresses = model.stresses(model.state(points=points))
    stretched = stresses.rod(spring)
    expected = YOUNG * np.pi * RADIUS**2 * 1e-3 / 0.5
    np.testing.assert_allclose(stretched.axial_force, [[0.0, 0.0], [0.0, expected]], rtol=1e-9, atol=1e-9)
    for values in (stretched.shear, stretched.moment, stretched.torque):
        np.testing.assert_array_equal(values, np.zeros(values.shape))
    assert [values.shape for values in vars(stresses.rod(rod)).values()] == [(2, 3), (2, 3, 3), (2, 4, 3), (2, 4)]


def test_resultants_of_a_bent_ring(device):
    """M = EI / r about the axis of a ring of radius r from a straight rod, and no shear."""
    n, r = 60, 0.5
    angle = 2.0 * np.pi * np.arange(n) / n
    points = r * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    rod = scene.add_rod(points, closed=True, natural="straight", **SOFT)
    model = scene.build(device, "float64")
    ring = model.stresses(model.state()).rod(rod)
    bending = YOUNG * np.pi * RADIUS**4 / 4.0
    np.testing.assert_allclose(ring.moment[:, 2], bending / r, rtol=2e-3)  # 2 tan(phi / 2) / l of the polygon
    np.testing.assert_allclose(ring.shear, 0.0, atol=1e-12)


def test_membrane_forces_of_an_inflated_sphere(device):
    """N = p r / 2 in every direction, and the equivalent stress is N / h."""
    pressure, radius, thickness = 100.0, 0.5, 1e-3
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    points, triangles = meshes.sphere(3, radius)
    ball = scene.add_shell(
        points, triangles, thickness=thickness, material=ddg.Material(young=1e9, poisson=0.3), name="ball"
    )
    scene.add_pressure(ball, pressure)
    scene.hold(ball, [0])
    scene.hold(ball, [1], "xy")
    scene.hold(ball, [2], "x")
    model = scene.build(device, "float64")
    stresses = model.stresses(statics.solve(model)).shell("ball")
    expected = 0.5 * pressure * radius
    np.testing.assert_allclose(
        np.median(stresses.membrane_force, 0), [expected, expected, 0.0], rtol=1e-2, atol=0.02 * expected
    )
    np.testing.assert_allclose(np.median(stresses.von_mises), expected / thickness, rtol=0.03)
    assert stresses.units == {"membrane_force": "N/m", "moment": "N", "von_mises": "Pa"}


def test_displacements_by_rod_and_node(device):
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    first, rod = scene.add_rod(straight(4), **SOFT), scene.add_rod(straight(6, y=1.0), name="beam", **SOFT)
    for each in (first, rod):
        scene.clamp(each)
    scene.add_force(rod, -1, (0.0, 0.0, -1e-3))
    model = scene.build(device, "float64")
    tip = {"row": ddg.Displacement.of(9, "z"), "node": ddg.Displacement.of(("beam", -1), "z"), "d": (rod, 5)}
    run = continuation.Continuation(model, tip)
    point = run.trace(stop=ddg.StopCriterion(load=(-0.1, 0.5))).points[-1]
    assert point.values["row"] == point.values["node"] == point.values["d.z"] < 0.0
    assert set(point.values) == {"row", "node", "d.x", "d.y", "d.z"}
    with pytest.raises(ddg.SceneError, match=r"stop at 'd': it is not watched"):
        run.trace(stop=ddg.StopCriterion(displacement=("d", 0.0, 1.0)))
    with pytest.raises(ddg.SceneError, match=r"node 6 does not exist: <rod 1 'beam'> has 6"):
        continuation.Continuation(model, {"d": (rod, 6)})


def test_rods_of_unequal_counts_equal_those_added_one_by_one(device):
    counts, radii = (4, 4, 6, 3), np.array([[1.0], [2.0], [3.0], [4.0]]) * 1e-3
    points = [straight(n, y=k) for k, n in enumerate(counts)]
    directors = np.array([[0.0, 1.0, 1.0]] * 2 + [[0.0, 1.0, 2.0]] * 2)
    states = []
    for together in (True, False):
        scene = ddg.Scene()
        if together:
            rods = scene.add_rods(
                points, section=ddg.Circle(radii), material=SOFT["material"], director=directors, name="hair"
            )
            assert list(rods) == [0, 1, 2, 3] == rods == range(4)
            assert isinstance(rods[2], Handle)
        else:
            for each, radius, director in zip(points, radii[:, 0], directors, strict=True):
                scene.add_rod(
                    each, section=ddg.Circle(radius), material=SOFT["material"], director=director, name="hair"
                )
        scene.clamp(range(4))
        model = scene.build(device, "float64")
        states.append(ddg.Integrator(model).step(model.state(), 0.01))
    np.testing.assert_array_equal(states[0].points(), states[1].points())
    np.testing.assert_array_equal(states[0].directors(), states[1].directors())
    scene = ddg.Scene()
    with pytest.raises(ddg.SceneError, match="has no length"):
        scene.add_rods([straight(4), np.zeros((3, 3))], **SOFT)
        scene.build(device)


def test_wrenches_of_steps_go_by_name_and_handle(device):
    scene = ddg.Scene()
    cable = scene.add_rod(straight(11), **SOFT)
    left = scene.clamp(cable, edges=[0], name="left")
    scene.clamp(cable, edges=[-1], name="right")
    integrator = ddg.Integrator(scene.build(device))
    integrator.watch_wrenches()
    integrator.step(integrator.model.state(), 0.01)
    wrenches = integrator.wrenches()
    assert wrenches["left"] is wrenches[left] is wrenches[0]
    assert (wrenches["right"].force == wrenches[1].force).all()
    with pytest.raises(ddg.SceneError, match="did you mean 'right'"):
        wrenches["rihgt"]
