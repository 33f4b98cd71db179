"""Equilibria under controls equal scenes with the same loads, world by world."""

import numpy as np
import pytest
from test_controls import AXIS, GRAVITY, PIVOT, joined, model_of, one_rod, sheet, some_rods

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.errors import SceneError
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions

TIGHT = {"rtol": 1e-12}
FORCES = np.array([(0.0, 0.3, -0.2), (0.0, 0.0, 0.0), (0.1, -0.2, 0.4)])
MOMENTS = np.array([0.01, 0.0, -0.02])
NODE, EDGE = 6, 4


def controls_of(model, moments: bool = True) -> ddg.Controls:
    """Return a force on a point, a moment on an edge and gravity for each world of a model."""
    forces, twisting = np.zeros((3, model.points_count, 3)), np.zeros((3, model.order.edges_count))
    forces[:, NODE] = FORCES
    if moments:
        twisting[:, EDGE] = MOMENTS
    return ddg.Controls(forces=forces, moments=twisting, gravity=GRAVITY)


def add_loads(scene, world: int) -> None:
    """Add the loads of one world to a scene of one world."""
    if not scene.shells:
        scene.add_force(0, NODE, FORCES[world])
        scene.add_twisting_moment(0, EDGE, MOMENTS[world])
    else:
        scene.add_vertex_force(0, [NODE], FORCES[world])


@pytest.mark.parametrize(
    ("build", "solver"),
    [
        pytest.param(one_rod, "direct", marks=pytest.mark.slow),
        (some_rods, "direct"),
        pytest.param(joined, "direct", marks=pytest.mark.slow),
        (joined, "pcg"),
        (sheet, "direct"),
        pytest.param(sheet, "pcg", marks=pytest.mark.slow),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_equilibrium_under_controls_equals_scene_loads(device, build, solver):
    model = model_of(build, None, device, worlds=3)
    options = TIGHT | {"solver": solver, "load_steps": 3}
    equilibrium = statics.solve(model, controls=controls_of(model, build is not sheet), **options)
    for world in range(3):
        single = model_of(build, None, device, 1, GRAVITY[world], lambda scene, w=world: add_loads(scene, w))
        expected = statics.solve(single, **options)
        size = np.ptp(expected.points(), axis=0).max()
        np.testing.assert_allclose(equilibrium.points()[world], expected.points(), rtol=0.0, atol=1e-9 * size)
        if solver == "direct":
            assert expected.stable == equilibrium.stable[world]


@pytest.mark.parametrize("solver", ["direct", "pcg"])
def test_follower_loads_add_to_controls(device, solver):
    def load(scene):
        scene.add_pressure(0, 20.0)

    model = model_of(sheet, None, device, worlds=3, load=load)
    options = TIGHT | {"solver": solver, "load_steps": 4}
    equilibrium = statics.solve(model, controls=controls_of(model, False), **options)
    for world in range(3):
        single = model_of(
            sheet, None, device, 1, GRAVITY[world], lambda scene, w=world: (load(scene), add_loads(scene, w))
        )
        expected = statics.solve(single, **options)
        np.testing.assert_allclose(equilibrium.points()[world], expected.points(), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("build", "solver"),
    [
        (some_rods, "direct"),
        pytest.param(joined, "direct", marks=pytest.mark.slow),
        (joined, "pcg"),
        (sheet, "direct"),
        pytest.param(sheet, "pcg", marks=pytest.mark.slow),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_grips_reach_the_end_of_motions(device, build, solver):
    """Poses of worlds equal motions by load parameter in single scenes; a solve without controls keeps them."""
    rotations, shifts = np.array([0.3, -0.5, 0.0]), np.array([[0.02, 0.0, 0.01], [0.0, -0.01, 0.03], [0.0, 0.0, 0.0]])
    model = model_of(build, ddg.Grip(PIVOT), device, worlds=3, gravity=(0.0, 0.0, -1.0))
    poses = np.concatenate([shifts, rotations[:, None] * AXIS], axis=1)[:, None]
    options = TIGHT | {"solver": solver, "load_steps": 2}
    equilibrium = statics.solve(model, controls=ddg.Controls(poses), **options)
    np.testing.assert_array_equal(equilibrium.poses(), poses)
    for world in range(3):
        moved = ddg.Motion(
            lambda t, w=world: tuple(t * shifts[w]), lambda t, w=world: t * rotations[w], tuple(AXIS), PIVOT
        )
        expected = statics.solve(model_of(build, moved, device, gravity=(0.0, 0.0, -1.0)), **options)
        np.testing.assert_allclose(equilibrium.points()[world], expected.points(), rtol=0.0, atol=1e-8)
    kept = statics.solve(model, equilibrium, start=1.0, **TIGHT | {"solver": solver})
    np.testing.assert_array_equal(kept.poses(), poses)
    np.testing.assert_allclose(kept.points(), equilibrium.points(), rtol=0.0, atol=1e-8)


def rod_and_sheet(scene, moved) -> None:
    """Add one rod and a sheet."""
    one_rod(scene, moved)
    sheet(scene, moved)


def test_controls_apply_to_one_solve(device):
    """A solve without controls after one with controls equals a fresh solver bitwise, and repeats."""
    model = model_of(rod_and_sheet, None, device, worlds=3)
    solver = Equilibrium(model, StaticsOptions(rtol=1e-10))
    first = solver.load(model.state(), 1, controls=controls_of(model)).snapshot()
    plain = solver.load(model.state(), 1).snapshot()
    again = solver.load(model.state(), 1, controls=controls_of(model)).snapshot()
    fresh = Equilibrium(model, StaticsOptions(rtol=1e-10)).load(model.state(), 1).snapshot()
    for name, values in first.items():
        np.testing.assert_array_equal(again[name], values, err_msg=name)
        np.testing.assert_array_equal(plain[name], fresh[name], err_msg=name)
    assert (first["0/x"] != plain["0/x"]).any()


def test_mismatched_controls_are_refused(device):
    model = model_of(one_rod, None, device, worlds=3)
    for controls, message in (
        (3, "statics: controls are 3; give Controls"),
        (ddg.Controls(forces=np.zeros((2, 3))), r"forces have shape \(2, 3\)"),
        (ddg.Controls(poses=np.zeros((0, 6))), "poses of no grip"),
    ):
        with pytest.raises(SceneError, match=message):
            statics.solve(model, controls=controls)
