"""Choice of step and rtol for a requested error at the end of a run, by pilot runs."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from ddg_warp.errors import SolverError

RTOLS = (1e-2, 1e-4, 1e-6)
TIGHT = 1e-8  # rtol of pilot runs that estimate the error of the steps
SOLVES = 0.1  # fraction of the error left to the nonlinear solves
SAFETY = 1.25  # of extrapolation from three runs (Roache, Journal of Fluids Engineering 116, 1994)
STILL = 1e-2  # fraction of the error below which differences of pilot runs show no order
HALVINGS = 10
ORDERS = {"implicit_euler": 1, "implicit_midpoint": 2}


@dataclass(frozen=True)
class StepChoice:
    """Step and rtol chosen for a requested error, with the estimated error.

    Attributes:
        error: Requested error [m].
        halvings: Number of halvings of dt.
        step: Step length [s].
        rtol: Tolerance of the nonlinear solves.
        steps_error: Estimated error of the steps [m].
        solves_error: Estimated error of the nonlinear solves [m].
        pilot_runs: Number of pilot runs.
        wall_time: Time of the pilot runs [s].
    """

    error: float
    halvings: int
    step: float
    rtol: float
    steps_error: float
    solves_error: float
    pilot_runs: int
    wall_time: float

    def line(self) -> str:
        """Return the choice as a line of text."""
        return (
            f"error of {self.error:g} m requested: steps of {self.step:g} s, rtol {self.rtol:g}; estimated error "
            f"{self.steps_error:.2g} m of the steps and {self.solves_error:.2g} m of the solves, by {self.pilot_runs} pilot runs "
            f"in {self.wall_time:.3g} s"
        )


def choose_step(model, start, dt: float, steps: int, error: float, options: Mapping, bar) -> StepChoice:
    """Choose step and rtol of a run by pilot runs.

    Args:
        model, start: Model and initial state.
        dt: Longest step [s].
        steps: Number of steps of dt to the end.
        error: Largest error of a node at the end [m].
        options: Keyword arguments of the `Integrator`, but rtol.
        bar: Progress bar, which describes the pilot run.

    Raises:
        SolverError: No step down to dt / 2^11 and no rtol down to 1e-6 are estimated to suffice, or a pilot run fails.
    """
    from ddg_warp.solve.stepping.integrator import Integrator

    began, runs, scheme = time.perf_counter(), 0, options.get("scheme", "implicit_euler")

    def end_of(halvings: int, rtol: float) -> np.ndarray:
        """Return the points at the end of a run."""
        nonlocal runs
        integrator, state, runs = Integrator(model, **{**options, "rtol": rtol}), start, runs + 1
        bar.set_description(f"pilot run {runs}, steps of {dt / 2**halvings:g} s")
        for _ in range(steps * 2**halvings):
            state = integrator.step(state, dt / 2**halvings)
        integrator.check(state)
        return state.points()

    halvings, rtol, errors = search(cache(end_of), error, ORDERS[scheme])
    return StepChoice(error, halvings, dt / 2**halvings, rtol, *errors, runs, time.perf_counter() - began)


def search(end_of: Callable, error: float, order: int) -> tuple[int, float, tuple[float, float]]:
    """Search halvings of the step and an rtol with an estimated error of at most `error`.

    Steps are halved until the differences of successive ends shrink as the order of the scheme predicts, to within a factor of
    sqrt(2). Richardson extrapolation by the observed ratio then gives the error of the shortest step, times a safety factor. At most
    one halving is extrapolated beyond the pilot runs. The estimate is of the whole run, so it includes how the motion amplifies or
    damps local errors. The error of the solves is the distance of the ends by rtol and by `TIGHT`, at the chosen step or the shortest
    of the pilot runs. It is at most a tenth of `error`.

    Args:
        end_of: (halvings, rtol) -> points (..., 3) at the end [m].
        error: Requested error [m].
        order: Order of the scheme.

    Returns:
        Halvings, rtol, and estimated errors of steps and solves [m].

    Raises:
        SolverError: See `choose_step`.
    """
    room, last = (1.0 - SOLVES) * error, math.nan
    ends = [end_of(0, TIGHT)]
    for tried in range(1, HALVINGS + 1):
        ends.append(end_of(tried, TIGHT))
        before, last = last, _distance(*ends[-2:])
        ratio = _ratio(before, last, 2.0**order, STILL * error)
        if not ratio:
            continue
        remaining = SAFETY * last / (ratio - 1.0)
        errors = [_distance(end, ends[-1]) + remaining for end in ends] + [remaining / ratio]
        halvings = next((number for number, estimate in enumerate(errors) if estimate <= room), None)
        if halvings is not None:
            rtol, solves_error = _rtol(end_of, min(halvings, tried), error)
            return halvings, rtol, (errors[halvings], solves_error)
        if tried + math.log(remaining / room, ratio) > HALVINGS + 1:
            break
    raise SolverError(
        f"an error of {error:g} m at the end needs steps shorter than dt / {2 ** (HALVINGS + 1)}: two pilot runs with steps of "
        f"dt / {2 ** (tried - 1)} and dt / {2**tried} end {last:.2g} m apart. Give a shorter dt or a larger error; where contact, "
        "buckling or chaos amplify errors, leave error out and give dt and rtol",
        outcome="error_not_reached",
    )


def _rtol(end_of: Callable, halvings: int, error: float) -> tuple[float, float]:
    """Return the largest rtol with a solve error of at most a tenth of `error`, and that solve error [m]."""
    for rtol in RTOLS:
        distance = _distance(end_of(halvings, rtol), end_of(halvings, TIGHT))
        if distance <= SOLVES * error:
            return rtol, distance
    raise SolverError(
        f"an error of {error:g} m at the end needs an rtol below {RTOLS[-1]:g}, by which the run ends {distance:.2g} m off; give a "
        "larger error, or leave it out and give dt and rtol",
        outcome="error_not_reached",
    )


def _ratio(before: float, after: float, expected: float, still: float) -> float:
    """Return the ratio of two successive differences, at most the expected ratio; 0 for an unexpected one."""
    if max(before, after) <= still:
        return expected
    return min(before / after, expected) if math.sqrt(2.0) * before >= expected * after > 0.0 else 0.0


def _distance(first: np.ndarray, second: np.ndarray) -> float:
    """Return the largest distance of a node in two arrays of points [m]."""
    return float(np.linalg.norm(first - second, axis=-1).max())
