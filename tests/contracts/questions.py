"""Questions: queries and operations on any object; a question raises if the answer is wrong."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from objects import UP, Object

import ddg_warp as ddg
from ddg_warp.kernels.terms import ALL, AXISYMMETRIC, SHELLS
from ddg_warp.postprocess import quantities
from ddg_warp.solve.equilibrium import stability, statics
from ddg_warp.solve.equilibrium.continuation import Continuation
from ddg_warp.solve.equilibrium.tangent import Tangent

DT = 0.004


@dataclass(frozen=True)
class Variant:
    """Build options of a scene."""

    device: str = "cpu"
    precision: str = "float64"
    worlds: int = 1

    @property
    def exact(self) -> float:
        """Relative error that rounding of the state may cause."""
        return 1e-9

    def build(self, scene) -> ddg.Model:
        return scene.build(self.device, self.precision, worlds=self.worlds)

    def each(self, values) -> np.ndarray:
        """Return values with a leading axis of worlds, which results of one world lack."""
        values = np.asarray(values, float)
        if self.worlds == 1:
            return values[None]
        assert values.shape[:1] == (self.worlds,), f"{values.shape} has no axis of {self.worlds} worlds"
        return values


def elastic_energy(model, state, variant) -> np.ndarray:
    """Return the elastic energy of every world [J]."""
    names = model.energies(state)
    return sum(variant.each(value) for name, value in names.items() if name not in ("kinetic", "gravity", "contact"))


def body_masses(model) -> np.ndarray:
    """Return the masses of rigid bodies with carried nodes (bodies,) [kg]."""
    host = model.coupled.host if model.scene.bodies else None
    return host.mass[host.rigid_bodies.origins, 0] if host else np.zeros(0)


def assert_close(values, expected, rtol: float = 1e-9, atol: float = 0.0, message: str = "") -> None:
    np.testing.assert_allclose(values, expected, rtol=rtol, atol=atol, err_msg=message)


def rest_model(kind: Object, variant: Variant, **options):
    """Return a model without gravity, its rest state, and the record of the added objects."""
    scene, added = kind.scene(**({"gravity": (0.0, 0.0, 0.0)} | options))
    model = variant.build(scene)
    return model, model.state(), added


def strained_state(model, variant: Variant, size: float = 1e-3):
    """Return a state strained in every element, equal in all worlds."""
    points = variant.each(model.state().points())[0]
    wave = np.sin(7.0 * points + np.arange(len(points))[:, None] + [0.3, 1.1, 2.0])
    if model.scene.axisymmetric_shells:
        wave[:, 1] = 0.0
        wave[points[:, 0] == 0.0, 0] = 0.0
    return model.state(points=points + size * wave)


# Queries of a state.


def energies(kind, variant):
    """Elastic energy is zero at rest, kinetic energy m v^2 / 2 and potential energy -m g . x, in each world."""
    scene, _ = kind.scene(gravity=(0.0, 0.0, -5.0))
    model = variant.build(scene)
    rest = model.energies(model.state())
    mass = _mass(model)
    points = variant.each(model.state().points())
    for name, value in rest.items():
        if name not in ("kinetic", "gravity"):
            assert np.abs(variant.each(value)).max() < 1e-18, (name, value)
    assert_close(
        variant.each(rest["gravity"]), (mass[:, None] * points * [0.0, 0.0, 5.0]).sum((1, 2)), rtol=1e-6, atol=1e-9
    )
    speed = np.zeros_like(points)
    speed[..., 2] = (1.0 + np.arange(variant.worlds))[:, None]
    moving = model.energies(model.state(velocities=speed if variant.worlds > 1 else speed[0]))
    assert_close(variant.each(moving["kinetic"]), 0.5 * mass.sum() * (1.0 + np.arange(variant.worlds)) ** 2, rtol=1e-6)


def _mass(model) -> np.ndarray:
    """Return the mass of every point (P,) [kg], divided among points with a common node."""
    from ddg_warp.solve.equilibrium.tangent import Tangent

    tangent = Tangent(model)
    dofs = tangent.point_dofs()
    along = dofs[:, 2]
    return tangent.mass[along] / np.bincount(along)[along]


def reactions(kind, variant):
    """Reactions of supports and gravity sum to zero in z, in every world."""
    scene, _ = kind.scene(gravity=(0.0, 0.0, -0.5))
    model = variant.build(scene)
    state = statics.solve(model)
    lift = sum(variant.each(reaction.force)[:, 2] for reaction in model.reactions(state))
    assert_close(
        lift,
        0.5 * (_mass(model).sum() + body_masses(model).sum()),
        rtol=1e-4 if variant.precision == "float32" else 1e-5,
    )


def stresses(kind, variant):
    """Every rod and shell has stresses, zero at rest and finite when strained, with one entry per world."""
    model, rest, added = rest_model(kind, variant)
    at_rest, strained = model.stresses(rest), model.stresses(strained_state(model, variant))
    assert strained
    owners = set()
    for name, values in strained.items():
        for index, value in enumerate(values):
            if value is not None:
                assert np.isfinite(variant.each(value)).all()
                assert variant.each(value).ndim == 3
                assert np.abs(variant.each(at_rest[name][index])).max() < 1e-6 * np.abs(value).max() + 1e-12, name
                owners.add((_kind_of_term(name), index))
    expected = {("rods", i) for i in added.rods} | {("shells", i) for i in added.shells}
    assert owners == expected | {("rings", i) for i in added.rings}


def _kind_of_term(term: str) -> str:
    return "shells" if term in SHELLS else "rings" if term in AXISYMMETRIC else "rods"


def total_twist(kind, variant):
    """The total twist of the first rod is zero at rest with transported directors."""
    model, state, _ = rest_model(kind, variant)
    assert np.abs(variant.each(quantities.total_twist(model, state, 0))).max() < 1e-9 or model.scene.batches[0].closed


def fields(kind, variant):
    """Triangle fields (strain, curvature, energy) are zero at rest and positive where the surface is strained."""
    model, rest, _ = rest_model(kind, variant)
    for name, values in quantities.triangle_fields(model, rest).items():
        assert values.shape[0] == variant.worlds, name
        assert np.abs(values).max() < 1e-9
    assert quantities.triangle_fields(model, strained_state(model, variant))["strain"].max() > 1e-5


def report(kind, variant):
    """The report names every term of the model."""
    model, _, _ = rest_model(kind, variant)
    text = model.report()
    for name in {key.split("/")[1] for key in model.parameters() if key.count("/") == 2}:
        assert f"  {name}: " in text, name


# Parameters and rest shapes.


def parameters(kind, variant):
    """Parameters of every term are listed by name, with finite values."""
    model, _, _ = rest_model(kind, variant)
    values = model.parameters()
    terms = {key.split("/")[1] for key in values if key.count("/") == 2}
    assert terms
    assert terms <= ALL.keys()
    assert all(np.isfinite(value).all() for value in values.values())


def set_parameter(kind, variant):
    """Stiffness scaled by a factor per world scales the elastic energy of that world."""
    model, _, _ = rest_model(kind, variant)
    state = strained_state(model, variant)
    names = {tuple(key.split("/")[1:]) for key in model.parameters() if "/stiffness" in key}
    results = []
    for factors in (1.0, 2.0 + np.arange(variant.worlds) if variant.worlds > 1 else 2.0):
        for number, (term, parameter) in enumerate(sorted(names)):
            model.set_parameter(term, parameter, (30.0 + number) * factors)
        results.append(elastic_energy(model, state, variant))
    assert_close(results[1], results[0] * factors)


def set_rest(kind, variant):
    """A deformed state as rest shape lowers the energy; only bending without rest shape keeps some."""
    model, _, added = rest_model(kind, variant)
    state = strained_state(model, variant)
    before = elastic_energy(model, state, variant)
    points, rod_nodes = variant.each(state.points())[0], int(model.curves.counts.sum())
    counts = [len(shell.points) for shell in model.scene.shells]
    for shell in added.shells or [0]:
        first = rod_nodes + sum(counts[:shell])
        model.set_rest(
            shell, points=points[first : first + len(model.scene.shells[shell].points)] if counts else points
        )
    assert (elastic_energy(model, state, variant) < before).all()


# Supports, loads, damping.


def _steps(model, count: int = 4, dt: float = DT, scheme: str = "implicit_euler", **options):
    integrator = ddg.Integrator(model, scheme=scheme, **options)
    state = model.state()
    for _ in range(count):
        state = integrator.step(state, dt)
    integrator.check(state)
    outcomes = integrator.statistics()["outcomes"]
    assert set(outcomes) <= {"converged", "converged_to_rounding"}, outcomes
    assert np.isfinite(state.points()).all()
    return state


def motion(kind, variant):
    """Supports follow the prescribed motion; in equilibrium the object hangs at the new position as before."""
    shift = (0.0, 0.0, 0.02) if kind.axis == UP else (0.01, 0.0, 0.02)
    weight = {"gravity": (0.0, 0.0, -0.5)}
    before, _, _ = rest_model(kind, variant, **weight)
    after, _, _ = rest_model(
        kind, variant, motion=ddg.Motion(translation=lambda t: tuple(t * np.array(shift))), **weight
    )
    hung, moved = statics.solve(before), statics.solve(after)
    if after.touch:  # an obstacle is in the path
        assert_equilibrium(after, moved, 0.5 * _mass(after).sum(), variant)
        return
    assert_close(variant.each(moved.points()), variant.each(hung.points()) + shift, atol=1e-6)
    assert_close(elastic_energy(after, moved, variant), elastic_energy(before, hung, variant), rtol=1e-4, atol=1e-9)


def turned_clamp(kind, variant):
    """A rotating clamp rotates the object rigidly in statics; dynamic steps count full rotations."""
    turn = ddg.Motion(angle=lambda t: 0.4 * t, axis=kind.axis)
    model, rest, _ = rest_model(kind, variant, motion=turn)
    state = statics.solve(model, load_steps=2)
    if model.touch:  # an obstacle is in the path
        assert_equilibrium(model, state, 1.0, variant)
    elif kind.turns:
        expected = turn.place(1.0, variant.each(rest.points())[0])[None]
        assert_close(
            variant.each(state.points()), np.broadcast_to(expected, (variant.worlds, *expected.shape[1:])), atol=1e-5
        )
        assert elastic_energy(model, state, variant).max() < 1e-7
    _steps(model)


def load(kind, variant):
    """A force displaces the loaded node in the direction of the force; a time-dependent one has no effect before its time."""
    scene, added = kind.scene(gravity=(0.0, 0.0, 0.0))
    added.load(scene, 1e-3, None)
    model = variant.build(scene)
    state = statics.solve(model)
    work = (variant.each(state.points()) - variant.each(model.state().points()))[..., 2]
    assert (work.min(1) < -1e-9).all()
    assert_close(work, np.broadcast_to(work[:1], work.shape), atol=1e-9)
    scene, added = kind.scene(gravity=(0.0, 0.0, 0.0))
    added.load(scene, 1e-3, lambda t: 0.0 if t < 1.0 else 1.0)
    model = variant.build(scene)
    assert_close(_steps(model, 2).points(), model.state().points(), atol=1e-12)


def couple(kind, variant):
    """A couple on a rod edge is balanced by the moments of supports."""
    scene, added = kind.scene(gravity=(0.0, 0.0, -0.5))
    about = np.array([0.0, 1e-3, 0.0])
    rod = added.rods[-1] if added.rods else 0
    scene.add_couple(rod, scene.batches[-1].edges // 2 if added.rods else 0, about)
    model = variant.build(scene)
    state = statics.solve(model)
    total = sum(variant.each(reaction.moment) for reaction in model.reactions(state, point=(0.0, 0.0, 0.0)))
    weight = _mass(model)[:, None] * np.array([0.0, 0.0, -0.5])
    total = total + np.cross(variant.each(state.points()), weight).sum(1)
    for k, mass in enumerate(body_masses(model)):
        total = total + np.cross(variant.each(state.body(k).position), mass * np.array([0.0, 0.0, -0.5]))
    if model.touch:  # friction acts on centrelines, which leaves a couple
        assert_equilibrium(model, state, 0.5 * _mass(model).sum(), variant)
    else:
        assert_close(total[:, 1], -about[1], rtol=1e-4)
    _steps(model, 2)


def pressure(kind, variant):
    """Follower pressure loads every shell; supports carry it."""
    scene, added = kind.scene(gravity=(0.0, 0.0, 0.0))
    for shell in added.shells or ([] if added.rings else [0]):
        scene.add_pressure(shell, 0.05)
    for shell in added.rings:
        scene.add_axisymmetric_pressure(shell, -0.05)
    model = variant.build(scene)
    state = statics.solve(model)
    forces = sum(np.abs(variant.each(reaction.force)) for reaction in model.reactions(state))
    assert (forces.max(1) > 1e-3).all()
    _steps(model, 2)


def mass_damping(kind, variant):
    """Velocity decays as v = v0 / (1 + alpha h) in a step h too short for forces to act."""
    h, alpha = 1e-6, 1e5
    scene, _ = kind.scene(gravity=(0.0, 0.0, 0.0), mass_damping=alpha)
    model = variant.build(scene)
    speed = np.zeros((model.points_count, 3))
    speed[:, 2] = 1e-3
    state = ddg.Integrator(model).step(model.state(velocities=speed), h)
    # the median leaves out supports and their neighbours
    assert_close(np.median(variant.each(state.velocities())[..., 2], axis=1), 1e-3 / (1.0 + alpha * h), rtol=1e-4)


def strain_rate_damping(kind, variant):
    """Viscosity lowers the kinetic energy that a strained state gains on release."""
    kept = []
    for viscosity in (0.0, 0.05):
        scene, _ = kind.scene(viscosity=viscosity, gravity=(0.0, 0.0, 0.0))
        model = variant.build(scene)
        integrator = ddg.Integrator(model)
        state = strained_state(model, variant)
        for _ in range(3):
            state = integrator.step(state, 1e-5)
        kept.append(variant.each(model.energies(state)["kinetic"]))
    assert (kept[1] < 0.9 * kept[0]).all()


def drag(kind, variant):
    """Drag takes power from moving rods or shells, in each world by its velocity, and slows their fall."""
    scene, added = kind.scene(gravity=(0.0, 0.0, -1.0))
    scene.drag(added.rods or None, tangential=1.0, normal=2.0, rotational=1e-4 if added.rods else 0.0)
    model = variant.build(scene)
    speed, factors = np.zeros((variant.worlds, model.points_count, 3)), 1.0 + np.arange(variant.worlds)
    speed[:, :, 2] = factors[:, None]
    result = model.drag(model.state(velocities=speed if variant.worlds > 1 else speed[0]))
    power = variant.each(result.power)
    assert (power < 0.0).all()
    assert_close(power, power[0] * factors**2, rtol=1e-6)
    assert_close(variant.each(result.force)[..., 2].sum(1), power / factors, rtol=1e-6)
    _steps(model, 2)


# Analyses.


def _assert_fall(kind, variant, scheme: str):
    scene, _ = kind.scene(gravity=(0.0, 0.0, -1.0))
    model = variant.build(scene)
    points = variant.each(_steps(model, scheme=scheme).points())
    assert_close(points, np.broadcast_to(points[:1], points.shape), atol=1e-9, message="worlds differ")
    assert (points - variant.each(model.state().points()))[..., 2].min() < -1e-6


def implicit_euler(kind, variant):
    """Implicit Euler converges, with equal results in all worlds."""
    _assert_fall(kind, variant, "implicit_euler")


def implicit_midpoint(kind, variant):
    """The implicit midpoint rule converges, with equal results in all worlds."""
    _assert_fall(kind, variant, "implicit_midpoint")


def equilibrium(kind, variant):
    """The residual at free dofs is below the tolerance, in every world."""
    scene, _ = kind.scene(gravity=(0.0, 0.0, -0.5))
    model = variant.build(scene)
    assert_equilibrium(model, statics.solve(model), 0.5 * _mass(model).sum(), variant)


def assert_equilibrium(model, state, scale: float, variant: Variant) -> None:
    """Assert that loads, stresses, contact and friction are in equilibrium at free dofs."""
    tangent = Tangent(model)
    residual = tangent.loads(1.0, tangent.dofs(state)) - tangent.gradient(state) + tangent.friction(state)
    assert np.abs(residual[tangent.free]).max() < (1e-3 if variant.precision == "float32" else 1e-6) * scale


def spectrum(kind, variant):
    """Supported structures with small sag are stable: positive frequencies in ascending order."""
    scene, _ = kind.scene(gravity=(0.0, 0.0, -0.5))
    model = variant.build(scene)
    modes = stability.spectrum(model, statics.solve(model), 3)
    assert modes.stable, modes.eigenvalues
    assert (np.diff(modes.eigenvalues) >= -1e-9 * modes.eigenvalues[-1]).all()
    assert (modes.frequencies > 1e-3).all()


def continuation(kind, variant):
    """The first points of a path from rest under a small load are regular and stable."""
    scene, added = kind.scene(gravity=(0.0, 0.0, 0.0))
    added.load(scene, 1e-2, None)
    model = variant.build(scene)
    path = Continuation(model, {"z": ddg.Displacement.of(-1, "z")}).trace(stop=ddg.StopCriterion(steps=3))
    assert len(path.points) >= 3
    assert path.points[-1].load > 0.0
    assert all(point.stable for point in path.points)


# Files.


def record(kind, variant):
    """Recorded data are read back bit for bit; a resumed run equals the uninterrupted one."""
    from ddg_warp.io.hdf5 import TrajectoryReader

    def run(model, directory, count, **options):
        integrator = ddg.Integrator(model, check_every=1)
        recorded = []
        with ddg.Recorder(model, directory, block=2, **options) as recorder:
            state = model.state()
            if options.get("resume"):
                with TrajectoryReader(Path(directory) / "trajectory.h5") as reader:
                    state = model.restore(reader.checkpoint())
            recorder.record(state)
            while round(state.time / DT) < count:
                state = integrator.step(state, DT)
                recorder.record(state)
                recorded.append(state.points().copy())
        return state, recorded

    scene, _ = kind.scene()
    model = variant.build(scene)
    with tempfile.TemporaryDirectory() as folder:
        straight, recorded = run(model, f"{folder}/a", 5)
        run(model, f"{folder}/b", 3)
        resumed, _ = run(model, f"{folder}/b", 5, resume=True)
        with TrajectoryReader(Path(folder) / "a" / "trajectory.h5") as reader:
            assert len(reader) == 6
            for frame, points in enumerate(recorded, 1):
                assert_close(reader.points[frame], points, rtol=1e-6, atol=1e-6)
        for name, values in straight.snapshot().items():
            compare = np.testing.assert_array_equal if variant.device == "cpu" else np.testing.assert_allclose
            compare(values, resumed.snapshot()[name], err_msg=name)


def export(kind, variant):
    """The scene exported from a recorded run is valid USD."""
    from ddg_warp.io.usd_check import validate
    from ddg_warp.run.cli import main

    scene, _ = kind.scene()
    model = variant.build(scene)
    with tempfile.TemporaryDirectory() as folder:
        with ddg.Recorder(model, folder) as recorder:
            recorder.record(model.state())
            recorder.record(_steps(model, 1))
        assert not validate(f"{folder}/scene.usdc")
        assert main(["export", folder, "--to", f"{folder}/out.usda"]) == 0
        assert not validate(f"{folder}/out.usda")


def failure(kind, variant):
    """A step that cannot converge names the object and the outcome; the error carries the last good state."""
    model, _, _ = rest_model(kind, variant)
    integrator = ddg.Integrator(model, max_iterations=1, retry_limit=0, check_every=1)
    state = strained_state(model, variant, 0.03)
    try:
        for _ in range(3):
            state = integrator.step(state, 0.05)
    except ddg.SolverError as error:
        assert error.outcome, error
        assert error.outcome in str(error)
        assert any(word in str(error) for word in ("rod", "shell", "node", "vertex", "joint", "body")), error
        assert error.state is not None
        assert np.isfinite(error.state.points()).all()
    else:
        raise AssertionError("one iteration a step was enough")


# Different controls per world.


def _gripped(kind, variant):
    """Return a gripped model, an integrator, and the controls of step k: each world lifts at its own rate."""
    scene, _ = kind.scene(gravity=(0.0, 0.0, -1.0), motion=ddg.Grip())
    model = variant.build(scene)

    def controls(k):
        poses = np.zeros((variant.worlds, 1, 6))
        poses[:, 0, 2] = k * DT * (1.0 + np.arange(variant.worlds))
        return ddg.Controls(poses)

    return model, ddg.Integrator(model, failures="flag"), controls


def grip(kind, variant):
    """A grip moves supports in every world as a prescribed motion of the same rate; the equilibrium hangs as before."""
    model, integrator, controls = _gripped(kind, variant)
    state = model.state()
    for k in range(1, 4):
        state = integrator.step(state, DT, controls(k))
    for world, points in enumerate(variant.each(state.points())):
        motion = ddg.Motion(lambda t, w=world: (0.0, 0.0, (1.0 + w) * t))
        alone, _, _ = rest_model(
            kind, Variant(variant.device, variant.precision), gravity=(0.0, 0.0, -1.0), motion=motion
        )
        assert_close(points, _steps(alone, 3).points(), atol=1e-9)
    assert set(integrator.outcomes()) == {"converged"}
    again = statics.solve(model, state)
    if model.touch:  # an obstacle is in the path
        assert_equilibrium(model, again, _mass(model).sum(), variant)
        return
    hung, hangs = variant.each(statics.solve(model).points()), variant.each(again.points())
    lift = np.zeros_like(hung)
    lift[..., 2] = 3 * DT * (1.0 + np.arange(variant.worlds))[:, None]
    assert_close(hangs, hung + lift, atol=1e-5)


def controls(kind, variant):
    """Gravity as a control, or as forces on all points, acts as gravity of the scene, in each world."""
    factors = 0.5 + np.arange(variant.worlds)
    model, _, _ = rest_model(kind, variant)
    down = np.outer(factors, (0.0, 0.0, -1.0))
    weight = _mass(model)[:, None] * down[:, None]
    on_bodies = {}
    if model.scene.bodies:
        loads = np.zeros((variant.worlds, len(model.scene.bodies), 6))
        loads[..., :3] = body_masses(model)[:, None] * down[:, None]
        on_bodies["wrenches"] = loads
    for step_controls in (ddg.Controls(gravity=down), ddg.Controls(forces=weight, **on_bodies)):
        integrator, state = ddg.Integrator(model), model.state()
        for _ in range(3):
            state = integrator.step(state, DT, step_controls)
        for world, points in enumerate(variant.each(state.points())):
            alone, _, _ = rest_model(kind, Variant(variant.device, variant.precision), gravity=tuple(down[world]))
            assert_close(points, _steps(alone, 3).points(), atol=1e-8)


def reset(kind, variant):
    """The last world is reset to a fresh state of the same time, bit for bit on the CPU; the others continue."""
    model, integrator, controls = _gripped(kind, variant)
    state, last = model.state(), np.arange(variant.worlds) == variant.worlds - 1
    for k in range(1, 3):
        state = integrator.step(state, DT, controls(k))
    fresh, continued = model.state(), ddg.Integrator(model).step(state, DT, controls(3))
    fresh.time = state.time
    state = integrator.step(integrator.reset(state, last), DT, controls(3))
    fresh = ddg.Integrator(model).step(fresh, DT, controls(3))
    compare = np.testing.assert_array_equal if variant.device == "cpu" else assert_close
    for world in range(variant.worlds):
        expected = fresh if last[world] else continued
        for values, wanted in ((state.points(), expected.points()), (state.velocities(), expected.velocities())):
            compare(variant.each(values)[world], variant.each(wanted)[world])


QUESTIONS = {
    function.__name__.replace("_", " "): function
    for function in (
        *(energies, reactions, stresses, total_twist, fields, report),
        *(parameters, set_parameter, set_rest),
        *(motion, turned_clamp, load, couple, pressure, mass_damping, strain_rate_damping, drag),
        *(implicit_euler, implicit_midpoint, equilibrium, spectrum, continuation),
        *(record, export, failure),
        *(grip, controls, reset),
    )
}
