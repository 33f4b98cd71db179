"""Run and record the analysis of a scene. The loop is short on purpose: copy it for variants."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SolverError
from ddg_warp.io.observed import checked_observed
from ddg_warp.model.controls import Controls, TimedControls, controls_at
from ddg_warp.progress import Heartbeat, progress_bar
from ddg_warp.run.check import Check
from ddg_warp.run.run_directory import SUMMARY, RunDirectory
from ddg_warp.run.scene_registry import RUN_SETTINGS, InputError
from ddg_warp.scene.descriptions import Dynamics, PathAnalysis, Statics
from ddg_warp.scene.equilibrium_path import Path as EquilibriumPath
from ddg_warp.scene.scene import Scene
from ddg_warp.typing import Device, FilePath, Floats, Numbers, Option, Precision

if TYPE_CHECKING:
    from ddg_warp.model.model import Model
    from ddg_warp.model.state import State
    from ddg_warp.run.step_choice import StepChoice
    from ddg_warp.solve.stepping.wrenches import Reactions

MOST_STEPS = 2**53  # consecutive integers that floats distinguish


@dataclass(repr=False)
class Result:
    """Result of a run, tested by `check(result)` of a scene.

    Values of a resumed run are of the whole run, unless stated otherwise.

    Attributes:
        scene: The scene.
        model: The model.
        state: The last good state.
        times: Time of each recorded state [s] (states,), the initial one first. In statics the load parameter, along a path the arc
            length.
        series: Observed values by name, arrays (states,).
        statistics: `integrator.statistics()`, or the like of a static run.
        energies: Energies by term [J] at "start" and "end"; None at the start if `counted_from` is set.
        dt: Time step [s]; None in statics.
        step_times: Time of each step since the start or resumption [s], by the clock of the run; the first includes compilation.
        wall_time: Time from the scene to the end [s].
        compile_time: Time from the scene to the end of the first step, less a steady step [s]; includes pilot runs.
        counted_from: Time [s] from which statistics and times count, if the run was resumed from a file without counters.
        failure: Reason of an early end, or "".
        outcome: "converged", or the name of the outcome that ended the run early.
        path: Followed path of equilibria (`ddg_warp.scene.equilibrium_path.Path`), if that was the analysis.
        choice: Step and rtol (`ddg_warp.run.step_choice.StepChoice`) chosen for `Dynamics(error=...)`; None without. The `step_times`
            are then times of all steps within dt.
        learned: Data that the scene's check learned from the run, for its plot; None without.
        checks: Checks of the run (`Check`), if a check was given.
        name, parameters: Name of the scene and parameters of its `build`, from the provenance.
        directory: Directory of the recorded run; None if it was not recorded.
        kept_wrenches: See `wrenches`; None unless requested.
    """

    scene: Scene
    model: Model
    state: State
    times: Floats = field(default_factory=lambda: np.zeros(0))
    series: dict[str, Floats] = field(default_factory=dict)
    statistics: dict[str, object] = field(default_factory=dict)
    energies: dict[str, dict[str, float | Floats]] = field(default_factory=dict)
    dt: float | None = None
    step_times: list[float] = field(default_factory=list)
    wall_time: float = 0.0
    compile_time: float = 0.0
    counted_from: float | None = None
    failure: str = ""
    outcome: str = "converged"
    path: EquilibriumPath | None = None
    choice: StepChoice | None = None
    learned: object = None
    checks: list[Check] = field(default_factory=list)
    name: str = "scene"
    parameters: dict[str, object] = field(default_factory=dict)
    directory: Path | None = None
    kept_wrenches: Reactions | None = None

    def __repr__(self) -> str:
        reached = f"{self.times[0]:g} to {self.times[-1]:g}" if len(self.times) else "none"
        names = ", ".join(self.series) or "nothing"
        ended = f"; failed: {self.failure}" if self.failure else ""
        size = f"{argument_checks.number_of(len(self.times), 'state')} on {self.model.device}"
        return f"<Result: {size}, times {reached}, observed {names}, {self.wall_time:.3g} s of wall time{ended}>"

    def _repr_html_(self) -> str | None:
        """Return a page of the last state for notebooks; None without viser or a state."""
        from ddg_warp.view.notebook import state_frame

        return state_frame(self.model, self.state)

    def fail(self, error: SolverError, said: str = "") -> None:
        """Store failure and outcome of an early end."""
        self.failure, self.outcome = f"{said}{error}", error.outcome or "failed"

    @property
    def wrenches(self) -> Reactions:
        """Forces and moments of supports and obstacles by index, name or handle, with an axis of states in front.

        A state after a step has the wrenches of `Integrator.wrenches`, the first state and load steps have `Model.reactions`. A resumed
        run has no states from before.

        Raises:
            InputError: The run kept none.
        """
        if self.kept_wrenches is None:
            raise InputError("wrenches: the run kept none; call simulate(..., wrenches=True)")
        return self.kept_wrenches

    @property
    def seconds_per_step(self) -> float:
        """Mean time of a step [s], if possible without the first two, which compile and capture."""
        steady = self.step_times[2:] or self.step_times
        return sum(steady) / len(steady) if steady else 0.0

    def summary(self) -> dict[str, object]:
        """Return the content of summary.json; see `ddg_warp.run.summary`."""
        from ddg_warp.run.summary import summary

        return summary(self.name, self.parameters, self, self.checks)

    def to_pandas(self):
        """Return the series as a `pandas.DataFrame`, a row a recorded state.

        Its index is the time [s], in statics the load parameter, along a path the arc length.

        Raises:
            ModuleNotFoundError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ModuleNotFoundError:
            raise ModuleNotFoundError(
                "to_pandas needs pandas, which is not installed: `pip install pandas`; or take `result.series`, arrays by name"
            ) from None
        axis = "arc length" if self.path is not None else "load parameter" if self.dt is None else "time"
        return pd.DataFrame(self.series, index=pd.Index(self.times, name=axis))

    def at(self, t: float, name: str) -> float:
        """Return the observed value `name` at time t [s], to a thousandth of a step.

        Raises:
            KeyError: No state was recorded at that time.
        """
        index = self._index(t)
        if index is None:
            raise KeyError(f"no state was recorded at {t} s")
        return self.series[name][index]

    def reached(self, t: float) -> bool:
        """Return True if a state was recorded at time t [s]."""
        return self._index(t) is not None

    def _index(self, t: float) -> int | None:
        if not len(self.times):
            return None
        nearest = int(np.argmin(np.abs(np.asarray(self.times) - t)))
        return nearest if abs(self.times[nearest] - t) <= 1e-3 * (self.dt or 1e-6) else None


def simulate(
    scene: Scene,
    *,
    device: Device = None,
    precision: Precision | None = None,
    worlds: int = 1,
    out: FilePath | RunDirectory | None = None,
    dt: float | None = None,
    duration: float | None = None,
    resume: FilePath | None = None,
    force: bool = False,
    fields: Sequence[str] = (),
    usd: bool = True,
    observe: Callable[[Model, State], Mapping[str, Numbers]] | None = None,
    check: Callable[[Result], Sequence[Check]] | None = None,
    module: object = None,
    picture: bool = True,
    provenance: Mapping[str, object] | None = None,
    options: Mapping[str, Option] | None = None,
    controls: TimedControls = None,
    wrenches: bool = False,
    clock: Callable[[], float] | None = None,
    progress: bool = True,
    every: int | None = None,
    fps: float | None = None,
    physics: bool = False,
) -> Result:
    """Run the analysis of a scene, as `ddg-warp run` does: record, check, and draw.

    Args:
        scene: The scene.
        device: Warp device; by default CUDA if there is one.
        precision: "float64", "mixed" or "float32"; by default the scene's, else by device.
        worlds: Independent copies.
        out: Directory for trajectory.h5, scene.usdc, summary.json and picture.png, or a `RunDirectory`; None records nothing.
        dt: Time step [s] instead of the scene's.
        duration: End of the run [s] instead of the scene's or the resumed run's.
        resume: Directory of an earlier run to continue, with its time step, precision, worlds and fields. A finished run is not
            stepped or written: the result is as recorded.
        force: Whether to replace a run in `out`.
        fields: Fields to record in addition to positions: "velocities", "directors", "contacts" and names of
            `ddg_warp.postprocess.fields`.
        usd: Whether to record scene.usdc, too.
        observe: (model, state) -> values by name, taken at the start and after every step.
        check: Function of the result that returns its checks (`Check`), called at the end.
        module: Module with `observe`, `check`, and options of pictures, as a scene file has them; see `run.outputs.draw`.
        picture: Whether to draw picture.png into `out`, if matplotlib is installed.
        provenance: Attributes of the trajectory: scene, parameters, command.
        options: Keyword arguments of the `Integrator` or of `StaticsOptions`: rtol, instead of the scene's, and others.
        controls: `Controls` of every step or load step, or a function of the time (load parameter) at its end that returns them.
        wrenches: Whether to keep forces and moments of supports, see `Result.wrenches`.
        clock: Clock of `step_times` [s]; by default wall time, synchronised on CUDA.
        progress: Whether to show progress: a bar on a terminal, a line every ten seconds elsewhere.
        every: Steps from one recorded state to the next, by default 1, or as in the resumed run; the number of steps is a multiple.
            `Result.times` has all steps, but of a resumed run the recorded ones.
        fps: Time codes per second of scene.usdc; by default one time code a recorded state.
        physics: Whether rods and shells of scene.usdc are deformable bodies with materials; see `io.usd_physics`.

    Returns:
        The result, with `failure` if the run ended early.

    Raises:
        SceneError: The scene cannot be built, or an argument is invalid.
        InputError: The duration is no whole number of steps, or the scene is static but has a time step. Or the run to resume has
            other settings or is longer.
    """
    began = time.perf_counter()
    observe, check = observe or getattr(module, "observe", None), check or getattr(module, "check", None)
    if not isinstance(scene, Scene):
        raise InputError(f"the scene is {type(scene).__name__}; `build` returns a Scene")
    _check(
        worlds,
        fields,
        every,
        fps,
        flags={
            "force": force,
            "usd": usd,
            "physics": physics,
            "progress": progress,
            "picture": picture,
            "wrenches": wrenches,
        },
        functions={"observe": observe, "check": check, "clock": clock},
        mappings={"provenance": provenance, "options": options},
        paths={"out": out, "resume": resume},
    )
    analysis = scene.analysis
    dynamic = isinstance(analysis, Dynamics)
    if not dynamic and any(each is not None for each in (dt, duration, resume, every)):
        raise InputError("this scene is static: it takes no dt, no duration, no every and nothing to resume")
    if isinstance(analysis, PathAnalysis) and (controls is not None or wrenches):
        raise InputError(
            "a path takes no controls and no wrenches; leave them out, and call model.reactions(point.state, factor=point.load) for "
            "each point of result.path"
        )
    if controls is not None and not (isinstance(controls, Controls) or callable(controls)):
        raise InputError(f"controls are {controls!r}; give Controls(...), or a function of the time that returns it")
    if dynamic:
        if analysis.error is not None:
            _check_error(scene, resume, options or {}, controls)
        stored = {"dt": analysis.dt, "duration": analysis.duration}
        if resume is not None:
            if force or (out is not None and Path(out) != Path(resume)):
                raise InputError(
                    "a resumed run goes on in its directory, and replaces nothing: leave out `force` and `out`"
                )
            asked = {"dt": dt, "precision": precision, "worlds": worlds, "fields": set(fields) or None, "every": every}
            stored |= settings_to_resume(Path(resume), asked)
            every = stored["every"]
            precision, fields = stored["precision"], ()
        dt = stored["dt"] if dt is None else dt
        duration = stored["duration"] if duration is None else duration
        run, steps = advance, step_count(dt, duration)
    elif isinstance(analysis, Statics):
        run, steps = equilibrate, analysis.load_steps
    else:
        run, steps = follow, analysis.stop.steps

    every = 1 if every is None else every
    if steps % every:
        raise InputError(
            f"every = {every}: the run has {steps} steps; give a divisor, so that the last state is recorded"
        )
    model = scene.build(device=device, precision=precision, worlds=worlds)
    about = provenance or {}
    result = Result(scene, model, model.state(), dt=dt, name=about.get("scene", "scene"), times=[])
    result.parameters = dict(about.get("parameters", {}))
    result.directory = Path(out if out is not None else resume) if (out, resume) != (None, None) else None
    if scene.initial:
        try:
            result.state = scene.initial(model)  # may set parameters, hence also in a resumed run
        except SolverError as error:
            result.fail(error, "the first state could not be found: ")
            _finish(result, None, out, module, False)
            return result
    counts = continue_from(result, Path(resume), duration) if resume is not None else {}
    done = every * max(0, len(result.times) - 1)
    earlier = {name: float(counts.get(f"clock/{name}", 0.0)) for name in ("wall", "compile")}
    counted: Callable[[], dict[str, np.ndarray]] | None = None

    def clocks() -> dict[str, float]:
        """Return wall time and compile time so far [s], resumptions included."""
        compiled = max(0.0, result.compile_time - result.seconds_per_step)
        return {"wall": earlier["wall"] + time.perf_counter() - began, "compile": earlier["compile"] + compiled}

    def tallied() -> dict[str, np.ndarray]:
        """Return the counters of the run for a checkpoint; {} if unknown since the start."""
        if counted is None or result.counted_from is not None:
            return {}
        start = {f"energy/{name}": np.array(value) for name, value in result.energies["start"].items()}
        return counted() | start | {f"clock/{name}": np.array(value) for name, value in clocks().items()}

    options, reactions = dict(options or {}), []
    with ExitStack() as stack:
        recorder = None
        if resume is not None and done >= steps:
            progress = False  # and nothing to record
        elif out is not None or resume is not None:
            attributes = {**(provenance or {}), "dt": dt or 0.0, "precision": model.precision, "worlds": worlds}
            attributes |= {"duration": duration} if dynamic else {}
            attributes |= {"every": every} if every > 1 else {}
            keywords = {"provenance": attributes, "force": force, "fields": fields, "usd": usd, "counts": tallied}
            keywords |= {"every": every, "fps": fps, "physics": physics}
            recorder = stack.enter_context(open_recorder(model, out, resume, dt, **keywords))
        if resume is not None:
            for callback in scene.callbacks:  # restore parameters that depend on time
                callback(result.state)
        else:
            result.energies["start"] = energies(model, result.state)
        if recorder is not None and dynamic:
            options.setdefault("check_every", 1)  # recording synchronises every step anyway
        bar = stack.enter_context(progress_bar(steps, done, progress))

        def keep(state, observed: Mapping | None = None, counts: Callable | None = None, integrator=None) -> None:
            """Record a state, with observed values and the counters of `counts()`; `integrator` has wrenches of its step."""
            nonlocal counted
            counted = counts
            if len(result.step_times) == 1:
                result.compile_time = time.perf_counter() - began
                bar.set_description(refresh=False)
            values = dict(observed or {}) | checked_observed(None if observe is None else observe(model, state))
            values = checked_observed(values, result.series.keys() if len(result.times) else None)
            result.state = state
            result.times.append(float(state.time))
            if wrenches:
                factor = 1.0 if dynamic else state.time
                reactions.append(integrator.wrenches() if integrator else model.reactions(state, factor=factor))
            for name, value in values.items():
                result.series.setdefault(name, []).append(value)
            if recorder is not None:
                recorder.record(state, observed=values)

        try:
            keywords = {"options": options, "clock": clock or wall_clock(model.device), "bar": bar}
            if not isinstance(analysis, PathAnalysis):
                keywords["controls"] = controls
            run(result, steps, keep, **keywords, **({"counts": counts, "wrenches": wrenches} if dynamic else {}))
        except SolverError as error:
            result.fail(error)
            result.state = error.state if error.state is not None else result.state
    result.wall_time, result.compile_time = clocks().values()
    result.energies["end"] = energies(model, result.state)
    if reactions:
        result.kept_wrenches = type(reactions[0]).series(reactions, model.scene)
    directory = out if out is not None else resume
    if resume is not None and done >= steps and (Path(resume) / SUMMARY).exists():
        directory = None  # a finished run stays as it is
    _finish(result, check, directory, module, picture)
    return result


def _finish(result: Result, check: Callable | None, directory, module, picture: bool) -> None:
    """Convert the series to arrays, run the checks, and write summary and pictures to a directory, if any."""
    from ddg_warp.run.outputs import draw, run_checks
    from ddg_warp.run.summary import write_json

    result.times = np.array(result.times, float)
    result.series = {name: np.array(values) for name, values in result.series.items()}
    result.checks = run_checks(check, result)
    if directory is not None:
        write_json(Path(directory) / SUMMARY, result.summary())
        if picture and len(result.times):
            draw(Path(directory), module, result)


def _check(
    worlds, fields, every, fps, *, flags: Mapping, functions: Mapping, mappings: Mapping, paths: Mapping
) -> None:
    """Raise an error that names the first invalid argument of `simulate`."""
    argument_checks.count("worlds", worlds)
    if every is not None:
        argument_checks.count("every", every)
    if fps is not None:
        argument_checks.positive("fps", fps, "1/s")
    for name, value in flags.items():
        argument_checks.flag(name, value)
    for name, value in functions.items():
        if value is not None and not callable(value):
            raise InputError(f"{name} is {value!r}; give a function, or leave it out")
    for name, value in mappings.items():
        if value is not None and not (isinstance(value, Mapping) and all(isinstance(key, str) for key in value)):
            raise InputError(f"{name} is {value!r}; give values by name, or leave it out")
    if not isinstance(fields, list | tuple | set) or not all(isinstance(name, str) for name in fields):
        raise InputError(f"fields = {fields!r}; give a list of names, such as ['velocities']")
    for name, value in paths.items():
        if value is not None and not isinstance(value, str | os.PathLike):
            raise InputError(f"{name} is {value!r}; give the path of a directory")


def _check_error(scene: Scene, resume, options: Mapping, controls: TimedControls) -> None:
    """Refuse settings that do not go with `Dynamics(error=...)`."""
    if resume is not None:
        raise InputError("a run with Dynamics(error=...) is not resumed; record it again, or give dt and rtol instead")
    if controls is not None:
        raise InputError("Dynamics: error takes pilot runs, which have no controls; leave out controls or error")
    if scene.callbacks:
        raise InputError(
            "Dynamics: error takes pilot runs, and callbacks of the scene would be called in each; leave out callbacks or error"
        )
    for name in ("rtol", "unconverged_fraction"):
        if name in options:
            raise InputError(f"options: {name} does not go with Dynamics(error=...); leave out one of them")
    if options.get("failures", "raise") != "raise":
        raise InputError("options: failures='flag' does not go with Dynamics(error=...); leave out one of them")


def advance(
    result: Result,
    steps: int,
    keep: Callable,
    *,
    options: Mapping,
    clock,
    bar,
    counts: Mapping,
    controls: TimedControls,
    wrenches: bool,
) -> None:
    """Step to the end and `keep` each state. The scene's callbacks run inside of `integrator.step`.

    Args:
        result: Result so far.
        steps: Number of steps of the whole run.
        keep, options, clock, bar, controls, wrenches: See `simulate`.
        counts: Counters of a resumed run, see `counts_of`.
    """
    from ddg_warp.run.counts import counts_of, repeat, statistics
    from ddg_warp.run.step_choice import choose_step
    from ddg_warp.solve.stepping.integrator import Integrator

    analysis = result.scene.analysis
    settings = {name: getattr(analysis, name) for name in ("scheme", "rtol", "unconverged_fraction")}
    if analysis.error is not None:
        result.choice = choose_step(
            result.model, result.state, result.dt, steps, analysis.error, settings | options, bar
        )
        settings["rtol"] = result.choice.rtol
    substeps = 2**result.choice.halvings if result.choice else 1
    integrator = Integrator(result.model, **settings | options)
    if wrenches:
        integrator.watch_wrenches()
    counted = partial(counts_of, integrator)
    if not len(result.times):
        keep(result.state, counts=counted)
    state = repeat(integrator, result.state, result.dt, counts) if counts else result.state
    try:
        for _ in range(round(float(state.time) / result.dt), steps):
            started = clock()
            for _ in range(substeps):
                length = result.dt / substeps
                state = integrator.step(state, length, controls_at(controls, state.time + length))
            result.step_times.append(clock() - started)
            keep(state, counts=counted, integrator=integrator)
            bar.update()
        integrator.check(state)
    finally:
        result.statistics = statistics(integrator, counts)


def equilibrate(
    result: Result, steps: int, keep: Callable, *, options: Mapping, clock, bar, controls: TimedControls
) -> None:
    """Solve all load steps and `keep` each equilibrium."""
    from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions, progress_of

    keep(result.state)
    equilibrium = Equilibrium(result.model, StaticsOptions(**options))
    state, iterations, outcomes = result.state, [], Counter()
    try:
        for step in range(steps):
            started, before = clock(), equilibrium.iterations
            with Heartbeat("statics", partial(progress_of, equilibrium), not bar.disable):
                end = (step + 1) / steps
                state = equilibrium.load(state, 1, step / steps, end, controls_at(controls, end))
            result.step_times.append(clock() - started)
            iterations.append(equilibrium.iterations - before)
            outcomes[equilibrium.outcome] += 1
            keep(state)
            bar.update()
    except SolverError as error:
        outcomes[error.outcome] += 1
        raise
    finally:
        mean = sum(iterations) / max(1, len(iterations))
        newton = {"mean": mean, "max": max(iterations, default=0)}
        counts = {"newton_iterations": newton, "pcg_iterations": equilibrium.pcg_iterations}
        result.statistics = {**counts, "outcomes": dict(outcomes), **equilibrium.statistics()}


def follow(result: Result, steps: int, keep: Callable, *, options: Mapping, clock, bar) -> None:
    """Follow the path of equilibria and `keep` each point, with load parameter and watched values."""
    from ddg_warp.solve.equilibrium.continuation import Continuation

    analysis, started, continuation = result.scene.analysis, clock(), None
    settings = {name: getattr(analysis, name) for name in ("step", "max_step", "load_scale")}
    try:
        continuation = Continuation(result.model, analysis.watch, **{**settings, **options})
        result.path = continuation.trace(result.state, stop=analysis.stop, progress=not bar.disable)
    except SolverError as error:
        result.path = getattr(error, "path", None)
        raise
    finally:
        points = result.path.points if result.path is not None else []
        for point in points:
            state = point.state.copy()
            state.time = point.arclength
            state.stable = point.stable
            keep(state, {"load": point.load, **point.values})
            bar.update()
        result.step_times = [(clock() - started) / max(1, len(points))] * len(points)
        iterations = [point.iterations for point in points]
        newton = {"mean": sum(iterations) / max(1, len(iterations)), "max": max(iterations, default=0)}
        outcomes = dict(Counter(point.kind for point in points))
        contact = continuation.statistics(points) if continuation else {}
        result.statistics = {"newton_iterations": newton, "pcg_iterations": 0, "outcomes": outcomes, **contact}


def step_count(dt: float, duration: float) -> int:
    """Return the number of steps of dt [s] in `duration` [s].

    Raises:
        InputError: A value is not positive, or the number is not whole.
    """
    for value in (dt, duration):
        number = isinstance(value, Real) and not isinstance(value, bool)
        if not (number and 0.0 < value < float("inf")):
            raise InputError(f"dt = {dt} s and duration = {duration} s must be positive and finite numbers")
    if duration / dt > MOST_STEPS:
        raise InputError(f"a duration of {duration} s is {duration / dt:.3g} steps of dt = {dt} s; take longer steps")
    steps = round(duration / dt)
    if steps < 1 or abs(steps * dt - duration) > 1e-6 * dt:
        raise InputError(f"a duration of {duration} s is no whole number of steps of {dt} s; change one of them")
    return steps


def settings_to_resume(directory: Path, asked: Mapping[str, object] | None = None) -> dict[str, object]:
    """Return time step [s], precision, worlds and end [s] of the run in a directory.

    Args:
        directory: Directory of the run.
        asked: Requested settings and fields by name; None for the recorded ones.

    Raises:
        InputError: The directory has no run, or one with other settings than requested.
    """
    from ddg_warp.io.hdf5 import TrajectoryReader

    path = directory / "trajectory.h5"
    if not path.is_file():
        raise InputError(f"there is no run to resume in {directory}: {path} is missing")
    with TrajectoryReader(path) as reader:
        stored = reader.provenance
        fields = {*reader.recorded, *reader.fields, *(["contacts"] if reader.contacts is not None else [])}
    if not {*RUN_SETTINGS} <= stored.keys():
        raise InputError(f"{path} is not of `simulate`: resume it where it was made, with Recorder(resume=True)")
    settings = {name: stored[name] for name in (*RUN_SETTINGS, "duration") if name in stored}
    settings["every"] = int(stored.get("every", 1))
    always = ("points", "obstacle_points", "body_poses")
    recorded = {name for name in fields if name not in always and "/" not in name}
    for name, value in (asked or {}).items():
        recorded_value = settings.get(name, recorded)
        if value is not None and value != recorded_value:
            recorded_value = ", ".join(sorted(recorded)) or "none" if name == "fields" else recorded_value
            raise InputError(
                f"the run in {directory} has {name} = {recorded_value}; resume it with these, not with others"
            )
    return settings


def continue_from(result: Result, directory: Path, duration: float) -> dict[str, np.ndarray]:
    """Restore checkpoint and observed values of the run in `directory` to a new result.

    Returns:
        Counters of the run for `advance`; {} if the file has none.

    Raises:
        InputError: The run is longer than `duration` [s].
    """
    from ddg_warp.io.hdf5 import TrajectoryReader

    with TrajectoryReader(directory / "trajectory.h5") as reader:
        frames, counts = reader.checkpoint_frame, reader.run_counts()
        end = float(reader.time[frames - 1])
        if end > duration + 0.5 * result.dt:
            raise InputError(
                f"the run in {directory} is recorded up to {end:g} s; a duration of {duration:g} s would cut it: give a longer one, or "
                "record another run"
            )
        result.state = result.model.restore(reader.checkpoint())
        result.times = reader.time[:frames].tolist()
        result.series = {name: values[:frames].tolist() for name, values in reader.series.items()}
    start = {
        name.removeprefix("energy/"): value.tolist() for name, value in counts.items() if name.startswith("energy/")
    }
    result.energies["start"] = start or None
    result.counted_from = None if counts else end
    return counts


def open_recorder(model, out, resume, dt, *, provenance, fields, every=1, fps=None, **options):
    """Return the recorder of a run in `out`, or of the run to resume."""
    from ddg_warp.run.recorder import Recorder, frame_rate

    again = resume is not None
    if again:  # provenance stays, except the duration
        provenance = {name: provenance[name] for name in provenance.keys() & {"duration"}}
    asked = {name: name in fields for name in ("velocities", "directors", "contacts")}
    fields = [name for name in fields if name not in asked]
    options |= {"fps": fps or (frame_rate(every * dt) if dt else None), "every": every}
    options |= {"resume": again, "fields": fields, "provenance": provenance}
    return Recorder(model, out if out is not None else resume, **options, **asked)


def wall_clock(device: str) -> Callable[[], float]:
    """Return a clock of wall time [s] that synchronises the device first."""
    import warp as wp

    if not wp.get_device(device).is_cuda:
        return time.perf_counter

    def finished() -> float:
        wp.synchronize_device(device)
        return time.perf_counter()

    return finished


def energies(model, state) -> dict[str, float]:
    """Return energies by term and in total [J]; one value a world if there are several."""
    terms = model.energies(state)
    return {**terms, "total": sum(terms.values())}
