"""Steps that are as long as an error allows."""

import math
from collections import Counter

from ddg_warp import arguments
from ddg_warp.errors import SceneError
from ddg_warp.model.controls import Controls
from ddg_warp.model.state import State
from ddg_warp.solve.dynamics import Integrator
from ddg_warp.threads import launches

HALVINGS = 4
ROOM = 0.8  # of the error, that the estimate of a step twice as long has to leave


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
        self.halvings = arguments.count("StepControl: halvings (0 for steps of one length)", halvings, 0)
        self.level, self.estimate, self.lengths = self.halvings, math.inf, Counter()
        self._changes, self._version = integrator.watch_changes(), None

    def advance(self, state: State, dt: float, controls: Controls | None = None) -> State:
        """The state dt [s] later, by steps of dt / 2^k; controls act in all of them.

        Raises:
            SolverError, SceneError: as of `Integrator.step`.
        """
        dt = arguments.positive("StepControl: dt", dt, "s")
        units, done = 2**self.halvings, 0
        while done < units:
            while done % (units >> self.level):  # steps begin at multiples of their length
                self.level += 1
            part = units >> self.level
            after = self.integrator.step(state, dt * part / units, controls)
            self.lengths[dt * part / units] += 1
            self._judge()
            state, done = after, done + part
        return state

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
