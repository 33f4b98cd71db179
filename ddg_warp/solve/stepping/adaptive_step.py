"""Time-step controller: step lengths from a local error tolerance."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.capture_lock import launches, stays_here
from ddg_warp.errors import SceneError
from ddg_warp.model.controls import Controls, checked
from ddg_warp.model.state import State, check_state
from ddg_warp.solve.forces.prescribed_motion import poses_between
from ddg_warp.solve.stepping.integrator import Integrator

HALVINGS = 4
MOST_HALVINGS = 40  # beyond this a step is lost in the rounding of the time
ROOM = 0.8  # fraction of the tolerance that permits doubling the step


@argument_checks.sealed
@stays_here
@launches
class AdaptiveStepper:
    """Time-step controller for implicit Euler: halve or double steps by a local error estimate.

        steps = AdaptiveStepper(Integrator(model), error=5e-3)
        while state.time < 2.0:
            state = steps.advance(state, 1 / 60)

    The local error of implicit Euler in a step of length h is -h^2/2 x'' (Hairer and Wanner, Solving Ordinary Differential Equations
    II, 1996, IV.3). So the error rate of positions is h |x''| / 2, half the velocity change of the step. The estimate is its
    mass-weighted root mean square over nodes, in the worst world. Step lengths are repeated halves of dt that keep it below `error`,
    equal in all worlds. A step with a larger estimate is not repeated; the next ones are shorter. In free fall the error stays below
    `error`. At impacts velocity jumps do not depend on the step length, so steps take the shortest length.

    Args:
        integrator: integrator with the scheme implicit Euler.
        error: tolerated error rate of positions [m/s].
        halvings: limit of halvings of the step length of `advance`.

    Attributes:
        level: number of halvings of the next step, at first the limit.
        estimate: error estimate of the last step [m/s].
        lengths: number of steps of each length [s].

    Raises:
        SceneError: an invalid argument, another scheme, or a model without mass.
    """

    def __init__(self, integrator: Integrator, error: float, halvings: int = HALVINGS):
        if not isinstance(integrator, Integrator):
            raise SceneError(
                f"AdaptiveStepper steps by an Integrator, not by {type(integrator).__name__}; give Integrator(model)"
            )
        if integrator.scheme != "implicit_euler":
            raise SceneError(f"AdaptiveStepper estimates the error of 'implicit_euler', not of {integrator.scheme!r}")
        self.integrator, self.model = integrator, integrator.model
        self.error = argument_checks.positive("AdaptiveStepper: error", error, "m/s")
        self.halvings = argument_checks.count(
            "AdaptiveStepper: halvings (0 for steps of one length)", halvings, 0, MOST_HALVINGS
        )
        self.level, self.estimate, self.lengths = self.halvings, math.inf, Counter()
        self._changes, self._version = integrator.watch_changes(), None

    def advance(
        self, state: State, dt: float, controls: Controls | None = None, start: Controls | None = None
    ) -> State:
        """Return the state dt [s] later, by steps of dt / 2^k.

        Args:
            state, controls: as for `Integrator.step`. Grips move and rotate at constant rates from the state to the poses of the
                controls; loads, gravity and field are constant over dt.
            start: loads, gravity and field at the start, interpolated linearly to `controls`. Missing entries of either are zero, or
                the gravity of the scene.

        Raises:
            SolverError, SceneError: as for `Integrator.step`.
        """
        dt = argument_checks.positive("AdaptiveStepper: dt", dt, "s")
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
        """Return the controls of a step as a function of the end fraction of dt."""
        model = self.model
        check_state("AdaptiveStepper.advance", model, state)
        end, begin = (checked(values, model, "AdaptiveStepper.advance") for values in (controls, start))
        if "poses" in begin:
            raise SceneError("AdaptiveStepper.advance: poses begin where the state has them; leave them out of start")
        if "fields" in begin:
            raise SceneError(
                "AdaptiveStepper.advance: fields of controls are constant over the advance; leave them out of start"
            )
        usual = {"gravity": np.array(model.scene.gravity, float)[None]}
        ramps = {
            name: [inputs.get(name, usual.get(name, 0.0)) for inputs in (begin, end)]
            for name in ((begin | end).keys() - {"poses", "fields"} if begin else ())
        }
        poses = poses_between(state, end["poses"], 0.0, 1.0) if "poses" in end else None

        def at(part: float) -> Controls | None:
            values = {name: (1.0 - part) * first + part * last for name, (first, last) in ramps.items()}
            if poses:
                values["poses"] = poses(part)
            return replace(controls or Controls(), **values) if values else controls

        return at

    def _judge(self) -> None:
        """Update the error estimate and the level of the next step."""
        if self.model.version != self._version:
            self._version, self._mass = self.model.version, self._changes.masses()
            if not (self._mass > 0.0).all():
                raise SceneError("AdaptiveStepper weights errors by mass, and the model has none")
        self.estimate = 0.5 * math.sqrt((self._changes.squares() / self._mass).max())
        if not self.estimate <= self.error:
            times = math.ceil(math.log2(self.estimate / self.error)) if math.isfinite(self.estimate) else self.halvings
            self.level = min(self.level + times, self.halvings)
        elif self.level and 2.0 * self.estimate <= ROOM * self.error:
            self.level -= 1
