"""Controls: stepwise control inputs of worlds equal functions of time in models of one world."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp import statics
from ddg_warp.geometry import meshes
from ddg_warp.postprocess import quantities
from tests.pairwise import covering

RUBBER = ddg.Material(young=1e7, poisson=0.35, density=1000.0)
SECTION = ddg.Rectangle(0.04, 0.02)
DT, STEPS = 0.01, 6
AXIS, PIVOT = np.array([1.0, 0.5, 0.2]) / np.linalg.norm([1.0, 0.5, 0.2]), (0.0, 0.1, 0.0)
SHIFTS, RATES = np.array([0.3, -1.0, 2.0]), np.array([3.0, -8.0, 15.0])  # [m/s, rad/s] of each world
GRAVITY = np.array([(0.0, 0.0, -9.81), (0.0, 0.0, 0.0), (1.0, 2.0, -3.0)])
FORCE, MOMENT = np.array([0.0, 0.5, -0.2]), np.array([0.0, 0.01, -0.02])
SCHEMES = pytest.mark.parametrize("scheme", ["implicit_euler", "implicit_midpoint"])


def line(start, end, n=12) -> np.ndarray:
    return np.linspace(np.asarray(start, float), np.asarray(end, float), n)


def shift(world: int, t: float) -> tuple:
    return (SHIFTS[world] * t, 0.0, 20.0 * SHIFTS[world] * t * t)


def motion(world: int) -> ddg.Motion:
    return ddg.Motion(lambda t: shift(world, t), lambda t: RATES[world] * t, tuple(AXIS), PIVOT)


def poses(t: float) -> np.ndarray:
    return np.array([[[*shift(world, t), *(RATES[world] * t * AXIS)]] for world in range(3)])


def one_rod(scene, moved):
    scene.clamp_end(scene.add_rod(line((0, 0, 0), (1, 0, 0)), section=SECTION, material=RUBBER), motion=moved)


def some_rods(scene, moved):
    """Add rods of several rod groups: clamped edges, a ring, a rod without twist."""
    one_rod(scene, moved)
    scene.clamp(scene.add_rod(line((0, 1, 0), (0.5, 1, 0), 7), section=SECTION, material=RUBBER), motion=moved)
    angle = 2.0 * np.pi * np.arange(10) / 10
    ring = 0.3 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
    scene.clamp(scene.add_rod(ring, section=SECTION, material=RUBBER, closed=True), motion=moved)
    plain = scene.add_rod(line((0, 2, 0), (1, 2, 0)), section=ddg.Circle(0.02), material=RUBBER, twist=False)
    scene.clamp(plain, motion=moved)


def joined(scene, moved):
    one_rod(scene, moved)
    scene.add_rod(line((1, 0, 0), (2, 0, 0)), section=SECTION, material=RUBBER)
    scene.join([(0, -1), (1, 0)])


def sheet(scene, moved):
    points, triangles = meshes.rectangle(4, 3, (0.8, 0.5))
    shell = scene.add_shell(points, triangles, thickness=0.01, material=RUBBER)
    scene.clamp_boundary(shell, points[:, 0] <= points[:, 0].min() + 1e-9, motion=moved)


def everything(scene, moved):
    some_rods(scene, moved)
    sheet(scene, moved)


KINDS = pytest.mark.parametrize(
    "build", [one_rod, some_rods, joined, sheet, everything], ids=lambda build: build.__name__
)


def model_of(build, moved, device, worlds: int = 1, gravity=(0.0, 0.0, -9.81), load=None, precision="float64"):
    scene = ddg.Scene(gravity=tuple(gravity))
    build(scene, moved)
    if load is not None:
        load(scene)
    return scene.build(device, precision, worlds=worlds)


def run(model, steps: int = STEPS, scheme: str = "implicit_euler", controls=lambda k: None, **options):
    integrator, state = ddg.Integrator(model, scheme, **options), model.state()
    for k in range(steps):
        state = integrator.step(state, DT, controls(k + 1))
    return state, integrator


@covering(1, build=(one_rod, some_rods, joined, sheet, everything), scheme=("implicit_euler", "implicit_midpoint"))
def test_worlds_are_models_with_functions(device, build, scheme):
    """Grips, gravity, forces and moments of three worlds equal motions, gravity and loads of three single models."""
    model = model_of(build, ddg.Grip(PIVOT), device, worlds=3)
    forces, edges = np.zeros((3, model.points_count, 3)), model.order.edges_count
    forces[:, -1, 1], forces[:, 5, 2] = FORCE, FORCE
    moments = np.zeros((3, edges))
    twisted = bool(model.scene.rod_count)
    if twisted:
        moments[:, 4] = MOMENT
    result, _ = run(
        model, STEPS, scheme, lambda k: ddg.Controls(poses(k * DT), forces, moments if twisted else None, GRAVITY)
    )
    for world in range(3):

        def load(scene, world=world):
            if scene.shells:
                scene.add_vertex_force(0, [len(scene.shells[0].points) - 1], (0.0, FORCE[world], 0.0))
            else:
                scene.add_force(scene.rod_count - 1, -1, (0.0, FORCE[world], 0.0))
            if scene.rod_count:
                scene.add_force(0, 5, (0.0, 0.0, FORCE[world]))
                scene.add_twisting_moment(0, 4, MOMENT[world])
            else:
                scene.add_vertex_force(0, [5], (0.0, 0.0, FORCE[world]))

        expected, _ = run(model_of(build, motion(world), device, 1, GRAVITY[world], load), STEPS, scheme)
        np.testing.assert_allclose(result.points()[world], expected.points(), rtol=0.0, atol=1e-11)
        np.testing.assert_allclose(result.velocities()[world], expected.velocities(), rtol=0.0, atol=1e-8)
        if twisted:
            np.testing.assert_allclose(result.angles()[world], expected.angles(), rtol=0.0, atol=1e-10)


def test_a_planar_rod_and_a_shell_of_revolution(device):
    """Objects with two components receive loads and poses in the xz plane."""

    def planar(scene, moved):
        scene.dimension = 2
        scene.clamp(scene.add_rod(line((0, 0, 0), (1, 0, 0)), section=SECTION, material=RUBBER), motion=moved)

    def dome(scene, moved):
        angle = np.linspace(0.0, 0.8, 9)
        points = np.column_stack([np.sin(angle), np.cos(angle)])
        scene.hold_ring(scene.add_axisymmetric_shell(points, thickness=0.02, material=RUBBER), -1, motion=moved)

    for build in (planar, dome):
        model = model_of(build, ddg.Grip(), device, worlds=2)
        rotates = 0.0 if build is dome else 1.0
        rates, gravity = np.array([2.0, -1.0]), np.array([(0.0, 0.0, -2.0), (0.0, 0.0, 5.0)])

        def controls(k, rates=rates, gravity=gravity, rotates=rotates):
            t = k * DT
            return ddg.Controls([[[0.0, 0.0, r * t * t, 0.0, rotates * r * t, 0.0]] for r in rates], gravity=gravity)

        result, _ = run(model, STEPS, controls=controls)
        for world, rate in enumerate(rates):
            moved = ddg.Motion(
                lambda t, r=rate: (0.0, 0.0, r * t * t), lambda t, r=rate, a=rotates: a * r * t, (0.0, 1.0, 0.0)
            )
            expected, _ = run(model_of(build, moved, device, 1, gravity[world]))
            np.testing.assert_allclose(result.points()[world], expected.points(), rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("build", [one_rod, joined, sheet], ids=lambda build: build.__name__)
def test_control_gravity_counts_in_the_load_scale(device, build):
    """A scene given gravity by controls converges like one with gravity: equal tolerance and iterations."""
    controlled, counts = run(
        model_of(build, None, device, gravity=(0, 0, 0)), controls=lambda k: ddg.Controls(gravity=(0, 0, -9.81))
    )
    reference, expected = run(model_of(build, None, device))
    assert counts.statistics()["newton_iterations"] == expected.statistics()["newton_iterations"]
    np.testing.assert_allclose(controlled.points(), reference.points(), rtol=0.0, atol=1e-12)
    weightless, _ = run(model_of(build, None, device), controls=lambda k: ddg.Controls(gravity=(0, 0, 0)))
    np.testing.assert_allclose(weightless.points(), weightless.model.state().points(), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("build", [one_rod, joined], ids=lambda build: build.__name__)
def test_the_scene_s_own_loads_stay(device, build):
    """Timed loads and couples act in addition to controls; a step without controls is unaffected by earlier ones."""

    def load(scene):
        scene.add_force(0, -1, (0.0, 0.0, 0.3), lambda t: 1.0 + t)
        scene.add_couple(0, 6, (0.0, 0.2, 0.1))

    model = model_of(build, None, device, worlds=2, load=load)
    forces = np.zeros((model.points_count, 3))
    forces[6] = (0.0, 0.4, 0.0)
    result, integrator = run(model, 4, controls=lambda k: ddg.Controls(forces=forces))
    both = model_of(build, None, device, load=lambda scene: (load(scene), scene.add_force(0, 6, (0.0, 0.4, 0.0))))
    expected, _ = run(both, 4)
    for world in range(2):
        np.testing.assert_allclose(result.points()[world], expected.points(), rtol=0.0, atol=1e-12)
    after = integrator.step(result.copy(), DT)
    fresh = ddg.Integrator(model).step(result, DT)
    for name, values in fresh.snapshot().items():
        np.testing.assert_array_equal(after.snapshot()[name], values, err_msg=name)


def test_a_step_is_a_function_of_state_and_controls(device):
    """A step from a copied or restored state repeats bit for bit; a grip without input stays."""
    model = model_of(everything, ddg.Grip(PIVOT), device, worlds=3)
    state, integrator = run(model, 3, controls=lambda k: ddg.Controls(poses(k * DT)))
    kept = state.copy()
    np.testing.assert_array_equal(kept.poses(), poses(3 * DT))
    later = integrator.step(integrator.step(state, DT, ddg.Controls(poses(4 * DT))), DT).snapshot()
    for start in (kept, model.restore(kept.snapshot())):
        fresh = ddg.Integrator(model)
        again = fresh.step(fresh.step(start, DT, ddg.Controls(poses(4 * DT))), DT)
        for name, values in again.snapshot().items():
            np.testing.assert_array_equal(later[name], values, err_msg=name)
    np.testing.assert_array_equal(again.poses(), poses(4 * DT))
    grip_points = again.points()[:, :1]
    np.testing.assert_array_equal(fresh.step(again, DT).points()[:, :1], grip_points)


def test_three_revolutions_in_steps(device):
    """An end is wound up by less than half a revolution a step.

    Angles of 0 to 6 pi and angles wrapped to a revolution give the same twist of 3 revolutions.
    """
    points = line((0, 0, 0), (1, 0, 0), 11)
    results = []
    for wrap in (False, True):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
        rod = scene.add_rod(points, section=SECTION, material=RUBBER)
        scene.clamp(rod, [0])
        scene.clamp(rod, [-1], motion=ddg.Grip())
        model = scene.build(device, "float64", worlds=2)
        integrator, state = ddg.Integrator(model), model.state()
        for k in range(15):
            angles = 2.0 * np.pi * 0.2 * (k + 1) * np.array([1.0, -0.5])
            if wrap:
                angles = np.arctan2(np.sin(angles), np.cos(angles))
            poses_given = np.zeros((2, 1, 6))
            poses_given[:, 0, 3] = angles
            state = integrator.step(state, 10.0, ddg.Controls(poses_given))  # so slow that the twist is uniform
        np.testing.assert_allclose(quantities.total_twist(model, state), [3.0, -1.5], atol=1e-9)
        np.testing.assert_allclose(state.angles()[:, -1], [6.0 * np.pi, -3.0 * np.pi], atol=1e-9)
        results.append(state.points())
    np.testing.assert_allclose(*results, atol=1e-9)


@SCHEMES
def test_substeps_move_a_grip_at_constant_rates(device, scheme):
    """Substeps after a failure move a grip like a motion at constant rates."""
    end = np.array([0.1, 0.05, 0.0, *(2.5 * AXIS)])
    moved = ddg.Motion(lambda t: tuple(end[:3] * t / 0.1), lambda t: 25.0 * t, tuple(AXIS), PIVOT)
    options = {"max_iterations": 6, "energy_bound": None}
    results = []
    for support, controls in ((moved, None), (ddg.Grip(PIVOT), ddg.Controls([end]))):
        model = model_of(one_rod, support, device)
        integrator = ddg.Integrator(model, scheme, **options)
        results.append((integrator.step(model.state(), 0.1, controls), integrator.statistics()))
    assert results[0][1]["retries"] == results[1][1]["retries"] > 1
    np.testing.assert_allclose(results[1][0].points(), results[0][0].points(), rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(results[1][0].velocities(), results[0][0].velocities(), rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("build", [one_rod, joined, sheet], ids=lambda build: build.__name__)
def test_equilibria_use_the_grip_poses_of_the_state(device, build):
    """Equilibria and reactions take supports at the grip poses of a state, which differ between worlds."""
    small = 0.2 * poses(0.02)
    model = model_of(build, ddg.Grip(PIVOT), device, worlds=3, gravity=(0.0, 0.0, -0.5))
    state = ddg.Integrator(model).step(model.state(), 1.0, ddg.Controls(small))
    equilibrium = statics.solve(model, state)
    np.testing.assert_array_equal(equilibrium.poses(), small)
    reactions = sum(reaction.force for reaction in model.reactions(equilibrium))
    for world in range(3):
        angle_end = np.linalg.norm(small[world, 0, 3:]) * np.sign(RATES[world])
        to = ddg.Motion(lambda t, w=world: tuple(t * small[w, 0, :3]), lambda t, a=angle_end: a * t, tuple(AXIS), PIVOT)
        single = model_of(build, to, device, gravity=(0.0, 0.0, -0.5))
        expected = statics.solve(single)
        np.testing.assert_allclose(equilibrium.points()[world], expected.points(), rtol=0.0, atol=1e-6)
        force = sum(reaction.force for reaction in single.reactions(expected))
        np.testing.assert_allclose(reactions[world], force, rtol=1e-5, atol=1e-6)


def test_a_run_with_grips_is_recorded_and_resumed(device, tmp_path):
    """Poses are stored in checkpoints."""
    from ddg_warp.io.hdf5 import TrajectoryReader

    model = model_of(one_rod, ddg.Grip(PIVOT), device, worlds=3)
    state, _ = run(model, 2, controls=lambda k: ddg.Controls(poses(k * DT)))
    with ddg.Recorder(model, tmp_path) as recorder:
        recorder.record(state)
    with TrajectoryReader(tmp_path / "trajectory.h5") as reader:
        again = model.restore(reader.checkpoint())
    after, expected = (
        ddg.Integrator(model).step(start, DT, ddg.Controls(poses(3 * DT))).snapshot() for start in (again, state)
    )
    for name, values in expected.items():
        np.testing.assert_array_equal(after[name], values, err_msg=name)
