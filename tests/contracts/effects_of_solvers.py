"""Arguments of integrators, equilibria, paths, queries and states; see `effects`."""

from functools import cache

import numpy as np
from effects import ARC, CALLS, DEVICE, DT, MAGNET, RUBBER, SHEET, Call, Change, line, observe_state

import ddg_warp as ddg
from ddg_warp.postprocess import quantities
from ddg_warp.solve.equilibrium import continuation, stability, statics
from ddg_warp.solve.equilibrium.arc_length_corrector import ContinuationOptions
from ddg_warp.solve.equilibrium.statics import StaticsOptions
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.stepping.adaptive_step import AdaptiveStepper


@cache
def model(kind: str = "arc", worlds: int = 1):
    """Return a small model, built once."""
    scene = ddg.Scene(mass_damping=0.1)
    if kind == "sheet":
        scene.add_shell(**SHEET, thickness=0.05, material=RUBBER, bending="hinge")
        scene.clamp_boundary(0, [0, 1, 2])
    elif kind == "dof sheet":
        scene.add_shell(**SHEET, thickness=0.05, material=RUBBER)
        scene.clamp_boundary(0, [0, 1, 2])
    elif kind == "column":
        scene = ddg.Scene(gravity=(0.0, 0.0, -1.0), dimension=2)
        scene.add_rod(line()[:, [2, 1, 0]], section=ddg.Circle(0.01), material=RUBBER)
        scene.clamp(0)
        scene.add_force(0, -1, (0.0, 0.0, -0.5))
    elif kind == "arch":
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
        x = np.linspace(-0.5, 0.5, 9)
        scene.add_rod(np.column_stack([x, 0.0 * x, 0.1 * np.cos(np.pi * x)]), section=ddg.Circle(0.01), material=RUBBER)
        scene.fix(0, [0, -1])
        scene.add_force(0, 4, (0.0, 0.0, -1.0))
    elif kind == "held":
        scene.add_rod(ARC, section=MAGNET)
        scene.clamp(0, motion=ddg.Grip())
        scene.magnetize(0, 1e5)
        scene.magnetic_field((0.0, 0.0, 0.0))
        scene.prescribe("curl", "rod_bend_twist.rest_1")
    elif kind == "touching":
        scene.add_rod(line(), section=ddg.Circle(0.01), material=RUBBER, name="low")
        scene.add_rod(line(6, 0.021), section=ddg.Circle(0.01), material=RUBBER, name="high")
        scene.clamp([0])
        scene.contact(range=5e-3)
    elif kind == "couple":
        scene.add_rod(ARC, section=ddg.Circle(0.02), material=RUBBER)
        scene.clamp(0)
        scene.add_couple(0, -1, (0.0, 0.1, 0.1))
    elif kind == "falling":
        scene.add_rod(line(), section=ddg.Circle(0.02), material=RUBBER)
        scene.fix(0, [0])
    else:
        scene.add_rod(ARC, section=ddg.Rectangle(0.03, 0.02), material=RUBBER)
        scene.clamp(0)
        scene.add_force(0, -1, (0.0, 1.0, 1.0))
    return scene.build(DEVICE, "float64", worlds=worlds)


# --- integrators ---
ODD = ARC + 0.3 * np.random.default_rng(0).standard_normal(ARC.shape) * (np.arange(6) > 1)[:, None]  # far from rest


def observe_integrator(
    kind: str = "arc", dt: float = 0.05, steps: int = 2, spins: float = 0.0, points=None, **options
) -> list:
    """Observe some steps: state, statistics, number of completed steps and outcome."""
    made = model(kind)
    integrator = ddg.Integrator(made, **options)
    state = made.state(points, spins=np.full(made.order.edges_count, spins) if spins else None)
    done, ended = 0, ""
    for _ in range(steps):
        try:
            state = integrator.step(state, dt)
        except ddg.SolverError as error:
            ended = error.outcome
            break
        done += 1
    return [*observe_state(state), integrator.statistics(), done, ended, integrator.outcomes().tolist()]


FAILS = {"max_iterations": 1, "retry_limit": 1, "rtol": 1e-12}
CALLS["Integrator"] = Call(ddg.Integrator, observe_integrator, {}, {
    "scheme": "implicit_midpoint", "solver": "projective", "linear": "cyclic_reduction",
    "retry_limit": Change(0, {"max_iterations": 2}, 20),
    "energy_bound": Change(1e-9, {"scheme": "implicit_midpoint"}), "check_every": Change(2, FAILS), "failures": Change("flag", FAILS),
    "gyroscopic": Change(False, {"kind": "falling", "spins": 500.0}), "rtol": 1e-2, "floor_factor": Change(1e9, {"rtol": 1e-14}),
    "max_iterations": 1, "max_halvings": Change(1, {"points": ODD, "dt": 1.0, "rotation_cap": 20.0, "retry_limit": 1}),
    "rotation_cap": 1e-2,
    "linear_rtol": Change(1e-1, {"kind": "sheet"}), "psd": "project", "unconverged_fraction": Change(0.1, refused=True)},
    subjects=("model",), kinds=(NewtonOptions,))  # fmt: skip


def observe_controls(**named) -> list:
    """Observe a step of a gripped, magnetised rod under controls."""
    made = model("held")
    return observe_state(ddg.Integrator(made).step(made.state(), DT, ddg.Controls(**named)))


CALLS["Controls"] = Call(ddg.Controls, observe_controls, {}, {
    "poses": [[0.1, 0, 0, 0, 0.1, 0]], "forces": np.full((6, 3), 0.1), "moments": np.full(5, 0.1), "gravity": (1, 0, 0),
    "field": (0, 0.1, 0), "fields": {"curl": 1.0}})  # fmt: skip


def observe_adaptive_steps(**named) -> list:
    """Observe adaptive steps."""
    made = model("falling")
    steps = AdaptiveStepper(ddg.Integrator(made), **named)
    state = steps.advance(made.state(), 0.1)
    return [*observe_state(state), sorted(steps.lengths.items()), steps.estimate]


CALLS["AdaptiveStepper"] = Call(
    AdaptiveStepper,
    observe_adaptive_steps,
    {"error": 0.2, "halvings": 3},
    {"error": 10.0, "halvings": 2},
    ("integrator",),
)


# --- states and questions ---
def observe_initial_state(kind: str = "arc", **named) -> list:
    """Observe an initial state, and a step from it."""
    made = model(kind)
    state = made.state(**named)
    return [*observe_state(state), observe_state(ddg.Integrator(made).step(state, DT))]


CALLS["model.state"] = Call(ddg.Model.state, observe_initial_state, {}, {
    "points": ARC + [0, 0.1, 0] * ARC, "velocities": np.full((6, 3), 0.1), "spins": np.full(5, 0.1),
    "angles": np.linspace(0, 1, 5)})  # fmt: skip


def observe_reactions(**named) -> list:
    """Observe reactions."""
    return [
        (reaction.force, reaction.moment, reaction.point)
        for reaction in quantities.reactions(model(), model().state(), **named)
    ]


CALLS["reactions"] = Call(
    quantities.reactions, observe_reactions, {}, {"point": (1, 0, 0), "factor": 2.0}, ("model", "state")
)


def observe_overlap_resolution(**named) -> list:
    """Observe an overlap resolution."""
    state, distance = model("touching").resolve_overlaps(model("touching").state(), **named)
    return [state.points(), distance]


CALLS["resolve_overlaps"] = Call(ddg.Model.resolve_overlaps, observe_overlap_resolution, {}, {"gap": 2e-3}, ("state",))


def observe_rest_shape(kind: str = "dof sheet", **named) -> list:
    """Observe a sheet with a changed rest shape, in a separate model."""
    made = model(kind).scene.build(DEVICE, "float64")
    made.set_rest(0, **named)
    return observe_state(ddg.Integrator(made).step(made.state(), DT))


STRETCHED = SHEET["points"] * 1.05
METRIC = np.tile([0.3, 0.0, 0.3], (8, 1))
CALLS["set_rest"] = Call(ddg.Model.set_rest, observe_rest_shape, {"points": SHEET["points"]}, {
    "points": STRETCHED, "metric": METRIC, "curvature": np.full((8, 3), 0.1),
    "angle": Change(np.full(16, 0.1), {"kind": "sheet"})}, ("shell",))  # fmt: skip


def observe_parameter(**named) -> list:
    """Observe a rod with a changed parameter, in a separate model."""
    made = model().scene.build(DEVICE, "float64")
    made.set_parameter(**named)
    return observe_state(ddg.Integrator(made).step(made.state(), DT))


CALLS["set_parameter"] = Call(ddg.Model.set_parameter, observe_parameter, {
    "term": "rod_bend_twist", "parameter": "stiffness_1", "values": 0.2}, {
    "term": Change("rod_stretch", {"parameter": "measure"}, "rod_bend_twist"), "parameter": "stiffness_2", "values": 0.3})  # fmt: skip


# --- equilibria ---
def observe_equilibrium(kind: str = "arc", way=None, controls=None, cuts: bool = False, **named) -> list:
    """Observe an equilibrium, its outcome and iterations."""
    made, history = model(kind), []
    if way is not None:
        named["way"] = history
    if named.get("state") == "moved":
        named["state"] = made.state(points=made.state().points() * [1.0, 1.0, -1.0])
    if named.get("rest"):
        made = made.scene.build(DEVICE, "float64")
    options = {name: named.pop(name) for name in [each.name for each in _fields()] if name in named}
    if "progress" in named:
        return statics.solve(made, progress=named["progress"]).points()
    solver = statics.Equilibrium(made, StaticsOptions(**options))
    state = named.pop("state", None) or made.state()
    result = solver.load(state, controls=controls, **named)
    return [
        *observe_state(result),
        str(result.outcome),
        str(result.stable),
        solver.iterations,
        len(history),
        solver.pcg_iterations,
    ]


def _fields():
    from dataclasses import fields

    return fields(StaticsOptions)


PUSH = ddg.Controls(forces=np.full((6, 3), 0.1))
# Progress shows after ten seconds.
PROGRESS = Change("no", refused=True)
CALLS["statics.solve"] = Call(statics.solve, observe_equilibrium, {}, {
    "progress": PROGRESS,
    "state": Change("moved", {"kind": "arch", "end": 0.01}), "controls": PUSH, "load_steps": 2,
    "start": Change(0.5, {"load_steps": 2}), "end": 0.5, "way": [],
    "rest": Change({0: {"angle": np.full(16, 0.1)}}, {"kind": "sheet"}), "rtol": 1e-2,
    "floor_factor": Change(1e15, {"rtol": 1e-30}, refused=True),
    "max_iterations": Change(2, {"max_cuts": 1}, refused=True), "rotation_cap": 0.1, "mode": Change("follow", {"kind": "column"}),
    "max_cuts": Change(1, {"max_iterations": 3}, 10, refused=True), "solver": Change("pcg", refused=True)},
    subjects=("model",), kinds=(StaticsOptions,))  # fmt: skip


def observe_spectrum(kind: str = "arc", **named) -> list:
    """Observe the eigenvalues at the initial state of a model."""
    made = model(kind)
    modes = stability.spectrum(made, made.state(), **named)
    return [modes.eigenvalues, modes.negative]


CALLS["spectrum"] = Call(stability.spectrum, observe_spectrum, {}, {
    "count": 2, "metric": "unit", "load": Change(2.0, {"kind": "couple"})}, ("model", "state", "tangent"))  # fmt: skip


@cache
def at_load(load: float):
    """Return the column at a load parameter."""
    return model("column"), statics.solve(model("column"), end=load, mode="follow")


def observe_buckling(free: float = 0.0, loaded: float = 0.1, count: int = 1) -> list:
    """Observe buckling factors between two loads."""
    return [stability.buckling(model("column"), at_load(free)[1], at_load(loaded)[1], count)]


CALLS["buckling"] = Call(
    stability.buckling, observe_buckling, {}, {"free": 0.01, "loaded": 0.2, "count": 2}, ("model",)
)
CALLS["critical"] = Call(stability.critical, stability.critical, {
    "equilibrium_at": at_load, "low": 0.0, "high": 1.0, "tolerance": 1e-2}, {
    "equilibrium_at": lambda load: at_load(2.0 * load), "low": 0.05, "high": 1.2, "tolerance": 1e-6})  # fmt: skip


# --- paths ---
def observe_path(kind: str = "arch", tip: int = 4, trace=None, **named) -> list:
    """Observe a path."""
    made = model(kind)
    watch = named.pop("watch", {"tip": ddg.Displacement.of(tip, "z")})
    followed = continuation.Continuation(made, watch, **named)
    path = followed.trace(**({"stop": ddg.StopCriterion(steps=3)} | (trace or {})))
    return [path.load, path.arclength, path.negative, path.kinds, [list(point.values.items()) for point in path.points], path.outcome,
            [point.iterations for point in path.points]]  # fmt: skip


CALLS["Continuation"] = Call(continuation.Continuation, observe_path, {}, {
    "watch": {"side": ddg.Displacement.of(3, "x")}, "step": 0.01, "max_step": 0.021, "min_step": Change(0.5, refused=True),
    "load_scale": 0.3, "iterations": 2, "max_iterations": Change(1, {"min_step": 1e-2}, refused=True), "rotation_cap": 1e-2,
    "tolerance": Change(0.1, {"trace": {"stop": ddg.StopCriterion(steps=40, limit_points=1)}, "max_step": 0.3}), "rtol": 1e-2,
    "floor_factor": Change(1e12, {"rtol": 1e-30})}, ("model",), (ContinuationOptions,))  # fmt: skip


def observe_trace(**named) -> list:
    """Observe a path by the arguments of `trace`."""
    made = model("arch")
    if named.get("state"):
        named["state"] = made.state(points=made.state().points() * [1.0, 1.0, -1.0])
    return observe_path(trace=named)


CALLS["trace"] = Call(continuation.Continuation.trace, observe_trace, {"stop": ddg.StopCriterion(steps=3)}, {
    "progress": PROGRESS,
    "state": True, "start": 0.01, "direction": -1, "stop": ddg.StopCriterion(steps=2)})  # fmt: skip
CALLS["Stop at limit points"] = Call(
    ddg.StopCriterion, lambda **named: observe_path(trace={"stop": ddg.StopCriterion(**named)}, max_step=0.3), {
    "steps": 30}, {"limit_points": 1})  # fmt: skip


def observe_control(displacement="tip", values=(-0.01,), state=None, start=0.0, max_cuts=10) -> list:
    """Observe a path under displacement control."""
    made = model("arch")
    watch = {"tip": ddg.Displacement.of(4, "z"), "side": ddg.Displacement.of(3, "z")}
    begin = made.state(points=made.state().points() * [1.0, 1.0, -1.0]) if state else None
    path = continuation.Continuation(made, watch).control(displacement, values, begin, start=start, max_cuts=max_cuts)
    return [path.load, path.points[-1].state.points(), [point.iterations for point in path.points]]


CALLS["control"] = Call(continuation.Continuation.control, observe_control, {}, {
    "displacement": "side", "values": (-0.02,), "state": Change(True, {"values": (-0.21,), "max_cuts": 0}), "start": 0.01,
    "max_cuts": Change(0, {"values": (-0.25,)}, refused=True)})  # fmt: skip


@cache
def bifurcated_path():
    """Return a path of the column through the first bifurcation."""
    followed = continuation.Continuation(model("column"), max_step=0.3)
    return followed, followed.trace(stop=ddg.StopCriterion(load=(-1.0, 1.0))).bifurcations[0]


def observe_branch(**named) -> list:
    """Observe a branch."""
    followed, fork = bifurcated_path()
    path = followed.switch(fork, **({"stop": ddg.StopCriterion(steps=2)} | named))
    return [path.load, path.points[-1].state.points()]


CALLS["switch"] = Call(continuation.Continuation.switch, observe_branch, {}, {
    "side": -1, "step": 0.05, "stop": ddg.StopCriterion(steps=1)}, ("bifurcation",))  # fmt: skip
