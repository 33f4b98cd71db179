"""Steps that are as long as an error allows."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.model import validate
from ddg_warp.model.controls import Controls, checked
from ddg_warp.model.state import State
from ddg_warp.solve.dynamics import Integrator
from ddg_warp.solve.motion import poses_between
from ddg_warp.threads import launches, stays_here

HALVINGS = 4
MOST_HALVINGS = 40  # beyond which a step is lost in the rounding of the time
ROOM = 0.8  # of the error, that the estimate of a step twice as long has to leave


@arguments.sealed
@stays_here
@launches
class StepControl:
    """Advances a state by steps that are halved while motion changes fast, and doubled while it is calm.

        steps = StepControl(Integrator(model), error=5e-3)
        while state.time < 2.0:
            state = steps.advance(state, 1 / 60)

    Implicit Euler errs by -h^2/2 x'' in a step of length h, to second order (Hairer and Wanner, Solving Ordinary Differential
    Equations II, 1996, IV.3), so positions go astray at the speed h |x''| / 2, half of what the step changes of the velocity. The
    estimate is the root of the mean of its square over all mass, of nodes, in the world in which that is the largest. Lengths are
    those halved again and again that keep it below `error`; all of one world go by one, whatever is in it. A step of a larger
    estimate is not taken back: those that follow are shorter. So what falls freely errs by no more than `error`; where things hit
    each other velocities change at once, by as much in short steps as in long ones, and steps are as short as they may be.

    Args:
        integrator: what steps; its scheme is implicit Euler.
        error: speed at which positions may go astray [m/s].
        halvings: how many times the length that `advance` is given may be halved.

    Attributes:
        level: how many times the next step is halved, at first as often as it may be.
        estimate: of the last step [m/s].
        lengths: how many steps there were of each length [s].

    Raises:
        SceneError: an argument is not what it should be, the scheme is another one, or nothing in the model has mass.
    """

    def __init__(self, integrator: Integrator, error: float, halvings: int = HALVINGS):
        if not isinstance(integrator, Integrator):
            raise SceneError(
                f"StepControl steps by an Integrator, not by {type(integrator).__name__}; give Integrator(model)"
            )
        if integrator.scheme != "implicit_euler":
            raise SceneError(f"StepControl estimates the error of 'implicit_euler', not of {integrator.scheme!r}")
        self.integrator, self.model = integrator, integrator.model
        self.error = arguments.positive("StepControl: error", error, "m/s")
        self.halvings = arguments.count("StepControl: halvings (0 for steps of one length)", halvings, 0, MOST_HALVINGS)
        self.level, self.estimate, self.lengths = self.halvings, math.inf, Counter()
        self._changes, self._version = integrator.watch_changes(), None

    def advance(
        self, state: State, dt: float, controls: Controls | None = None, start: Controls | None = None
    ) -> State:
        """Return the state dt [s] later, by steps of dt / 2^k.

        Args:
            state, controls: as of `Integrator.step`. Grips move evenly from where they are in the state to the poses of the controls,
                and turn at a constant rate; loads, gravity and field are constant over dt, as in one step of it.
            start: loads, gravity and field at the start, from which they go linearly to those of `controls`; what only one of both
                gives is zero, or the gravity of the scene, in the other.

        Raises:
            SolverError, SceneError: as of `Integrator.step`.
        """
        dt = arguments.positive("StepControl: dt", dt, "s")
        between = self._between(state, controls, start)
        units, done = 2**self.halvings, 0
        while done < units:
            while done % (units >> self.level):  # steps begin at multiples of their length
                self.level += 1
            part = units >> self.level
            after = self.integrator.step(state, dt * part / units, between((done + part) / units))
            self.lengths[dt * part / units] += 1
            self._judge()
            state, done = after, done + part
        return state

    def _between(self, state: State, controls: Controls | None, start: Controls | None) -> Callable:
        """Controls of a step by the part of dt at its end."""
        model = self.model
        validate.check_state("StepControl.advance", model, state)
        end, begin = (checked(given, model, "StepControl.advance") for given in (controls, start))
        if "poses" in begin:
            raise SceneError("StepControl.advance: poses begin where the state has them; leave them out of start")
        usual = {"gravity": np.array(model.scene.gravity, float)[None]}
        ramps = {
            name: [own.get(name, usual.get(name, 0.0)) for own in (begin, end)]
            for name in ((begin | end).keys() - {"poses"} if begin else ())
        }
        poses = poses_between(state, end["poses"], 0.0, 1.0) if "poses" in end else None

        def at(part: float) -> Controls | None:
            given = {name: (1.0 - part) * first + part * last for name, (first, last) in ramps.items()}
            if poses:
                given["poses"] = poses(part)
            return replace(controls or Controls(), **given) if given else controls

        return at

    def _judge(self) -> None:
        """How long the next step is, by what the last one has changed."""
        if self.model.version != self._version:
            self._version, self._mass = self.model.version, self._changes.masses()
            if not (self._mass > 0.0).all():
                raise SceneError("StepControl weighs errors by mass, and nothing in the model has any")
        self.estimate = 0.5 * math.sqrt((self._changes.squares() / self._mass).max())
        if not self.estimate <= self.error:
            times = math.ceil(math.log2(self.estimate / self.error)) if math.isfinite(self.estimate) else self.halvings
            self.level = min(self.level + times, self.halvings)
        elif self.level and 2.0 * self.estimate <= ROOM * self.error:
            self.level -= 1
