"""Steps that are as long as an error allows."""

import math
from collections import Counter

import numpy as np
import warp as wp

from ddg_warp import arguments, arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.step_error import differ_kernel
from ddg_warp.model.controls import Controls
from ddg_warp.model.state import State
from ddg_warp.solve.dynamics import Integrator
from ddg_warp.solve.net.system import Sums
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
        self._parts = [_Part(self.model, group) for group in self.model.groups]
        self._parts += [] if self.model.net is None else [_Part(self.model, None)]
        self._version = None
        arrays.load_kernels([kernel for part in self._parts for kernel in part.kernels], self.model.wp_device)

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
            self._judge(state, after)
            state, done = after, done + part
        return state

    def _judge(self, before: State, after: State) -> None:
        """How long the next step is, by what the last one has changed."""
        if self.model.version != self._version:
            self._version = self.model.version
            self._mass = sum(part.masses() for part in self._parts)
            if not (self._mass > 0.0).all():
                raise SceneError("StepControl weighs errors by mass, and nothing in the model has any")
        squares = sum(part(*states) for part, states in zip(self._parts, _velocities(before, after), strict=True))
        self.estimate = 0.5 * math.sqrt((squares / self._mass).max())
        if not self.estimate <= self.error:
            times = math.ceil(math.log2(self.estimate / self.error)) if math.isfinite(self.estimate) else self.halvings
            self.level = min(self.level + times, self.halvings)
        elif self.level and 2.0 * self.estimate <= ROOM * self.error:
            self.level -= 1


def _velocities(before: State, after: State):
    """Those at both ends of a step, of every group and of the net."""
    yield from ((one.v, other.v) for one, other in zip(before.groups, after.groups, strict=True))
    if before.net is not None:
        net = before.model.net
        yield net.points(before.net.v), net.points(after.net.v)


class _Part:
    """Sums over a group of rods, or over the nodes of the net if that is None, by world."""

    def __init__(self, model, group):
        self._of, net, device, real = group or model.net, model.net, model.wp_device, model.types.real
        self._rows, self._columns = (net.host.nodes, net.worlds) if group is None else (group.nodes, group.columns)
        self._width = self._columns // model.worlds
        self._threads = arrays.takers(self._rows, device) if group is None else 1
        self._kernel = differ_kernel(3 if group is None else group.dim, real)
        self._sums = wp.zeros((model.worlds, self._width * self._threads), dtype=real, device=device)
        self._sum = Sums(*self._sums.shape, real, device)
        self._total = wp.zeros(model.worlds, dtype=real, device=device)
        self.kernels, self._device = [self._kernel, *self._sum.kernels], device

    def masses(self) -> np.ndarray:
        """Of the worlds (worlds,) [kg]."""
        mass = arrays.download(self._of.node_mass).astype(float)[: self._rows]
        return mass.sum(0).reshape(-1, self._width).sum(1)

    def __call__(self, before: wp.array, after: wp.array) -> np.ndarray:
        """Sums of m |v1 - v0|^2 (worlds,) [J]. Reads from the device."""
        inputs = [before, after, self._of.node_mass, self._rows, self._width, self._threads]
        wp.launch(self._kernel, (self._threads, self._columns), inputs, [self._sums], device=self._device)
        self._sum(self._sums, self._total)
        return self._total.numpy().astype(float)
