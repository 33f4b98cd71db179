"""Central differences of steps and equilibria by every input, for the tests of gradients."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.adjoint.implicit import Adjoint

DEVICE = "cpu"  # of the models of these tests; see `conftest`
CHANGE = 1e-5  # of the loss, by a step of differences
TIGHT = {"rtol": 1e-13}
CLOSE = 1e-6  # tolerated relative error of a gradient
# A difference of fourth order: so many steps along a direction, each a world of one model, and the weights of the losses there.
SIDES, WEIGHTS = (2.0, 1.0, -1.0, -2.0), (-1.0 / 12.0, 2.0 / 3.0, -2.0 / 3.0, 1.0 / 12.0)
LARGEST = 1e-3  # relative change of a parameter by a step of differences


def built(scene):
    """A model in float64."""
    return scene.build(device=DEVICE, precision="float64")


def entries(state) -> dict[str, object]:
    """All arrays of a state by name that hold something."""
    return {name: array for name, array in state.arrays().items() if array.size > 1}


class StateMask:
    """Mask of the state entries that may be perturbed.

    Left out are rates of fixed dofs, padding, joint rotations, and entries that only serve as initial guesses.
    """

    def __init__(self, model):
        self.model = model

    def keep(self, name: str, values: np.ndarray) -> np.ndarray:
        part, _, name = name.partition("/")
        if name in ("a", "alpha"):
            return 0.0 * values
        return (
            self._coupled(name, values)
            if part == "net"
            else self._rod_group(self.model.groups[int(part)], name, values)
        )

    def _rod_group(self, group, name: str, values: np.ndarray) -> np.ndarray:
        host, kind = group.host, group.kind
        fixed = np.tile(host.fixed, (1, group.worlds))
        node = np.arange(group.nodes)[:, None] < np.tile(host.count, group.worlds)
        edge = np.arange(group.nodes)[:, None] < np.tile(host.count - (0 if kind.closed else 1), group.worlds)
        if name in ("x", "v"):
            fixed_components = np.stack([(fixed >> d) & 1 for d in range(kind.dim)], -1) == 1
            return np.where(fixed_components & (name == "v"), 0.0, values) * node[..., None]
        if name == "omega":
            return np.where((fixed >> kind.dim) & 1, 0.0, values) * edge
        if name == "last":
            for (*_, row), term in zip(kind.places(), kind.terms, strict=True):
                values[row : row + len(term.measure.strains)] *= (
                    np.roll(edge, 1 - term.measure.span, axis=0) | kind.closed
                )
        if name == "frame":
            values[6] = 0.0  # the lagged twist only selects the branch of the angle
        return values * edge

    def _coupled(self, name: str, values: np.ndarray) -> np.ndarray:
        host = self.model.coupled.host
        if name in ("q", "v"):
            active = np.ones((host.blocks, 3), bool)
            active[host.nodes :, 1:] = False
            active[host.blocks - host.spins :] = False
            if name == "v":
                active &= ~host.fixed & (host.mass > 0.0)
            return np.where(np.tile(active, (self.model.worlds, 1)), values, 0.0)
        if name.startswith("data") or (name == "frame" and not self.model.coupled.edges):
            return 0.0 * values
        if name.startswith("lag"):
            part = self.model.coupled.sets[int(name[4:])]
            values[6 * (len(part.host.lag) // 7) :] = 0.0  # angles, as of rod groups: of a joint after its ghost
        return values


def directions(model, state, seed: int, strains: float = 1e-3) -> dict[str, np.ndarray]:
    """Return a random direction in the state entries that may be perturbed."""
    random, mask = np.random.default_rng(seed), StateMask(model)
    result = {}
    for name, array in entries(state).items():
        size = strains if "last" in name else 1.0
        result[name] = size * mask.keep(name, random.normal(size=device_arrays.download(array).shape))
    return result


def put(state, values: dict[str, np.ndarray], factor: float = 1.0) -> None:
    """Add values to the entries of a state."""
    for name, array in entries(state).items():
        device_arrays.assign(array, device_arrays.download(array) + factor * values[name])


def product(state, values: dict[str, np.ndarray]) -> float:
    """Sum of the entries of a state times values."""
    return sum(float((device_arrays.download(array) * values[name]).sum()) for name, array in entries(state).items())


def cotangent(model, weights: dict[str, np.ndarray]):
    """Return the cotangent, a state, of the loss `product(state, weights)`."""
    state = model.empty_state()
    put(state, weights)
    return state


def along(gradient: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Return a direction of the magnitudes of `direction` along which no terms of a gradient cancel."""
    return np.where(gradient < 0.0, -1.0, 1.0) * np.abs(direction)


@dataclass
class Shift:
    """A direction in one input array of a step.

    Attributes:
        name: of the array.
        values: of one world, the world's axis included.
        gradient: derivatives of the loss by the values.
        direction: of the same shape, along which no terms of the gradient cancel.
        write: `write(model, state, values)` puts the values of all worlds into a model of several worlds, or a state of that model.
        axis: of the worlds; None of an array without worlds.
    """

    name: str
    values: np.ndarray
    gradient: np.ndarray
    direction: np.ndarray
    write: Callable
    axis: int | None

    @property
    def slope(self) -> float:
        """Derivative of the loss along the direction."""
        return float((self.gradient * self.direction).sum())

    def by_worlds(self, step: float) -> np.ndarray:
        """Values of all worlds, shifted by SIDES steps."""
        return np.concatenate([self.values + side * step * self.direction for side in SIDES], self.axis)


def world_axis(model, name: str, values: np.ndarray) -> int | None:
    """Axis of the worlds of an array of a state; None of a placeholder, which is one for all worlds."""
    group, _, name = name.partition("/")
    if group != "net":
        axis = 2 if name in ("frame", "last") else 1
        columns = model.groups[int(group)].columns
        return axis if values.ndim > axis and values.shape[axis] == columns else None
    if name in ("q", "v", "a"):
        return 0
    elements = model.coupled.edges if name == "frame" else model.coupled.sets[int(name.rpartition("_")[2])].elements
    return 1 if values.shape[1] == model.worlds * elements else None


class Difference:
    """The loss `product(after, weights)` of steps from a state, as a function of their inputs.

    Args:
        advance: state -> state after all steps, with a separate solver.
        advancing: model -> `advance` of a model with the same scene.
    """

    def __init__(self, model, state, weights, advance, advancing=None):
        self.model, self.state, self.weights, self.advance, self.advancing = model, state, weights, advance, advancing

    def loss(self) -> float:
        return product(self.advance(self.state.copy()), self.weights)

    def by(self, change, step: float) -> float:
        """Return the fourth-order central difference by a number that `change(x)` offsets by x; the number is restored."""
        losses = []
        for side in SIDES:
            change(side * step)
            losses.append(self.loss())
        change(0.0)
        return float(np.dot(losses, WEIGHTS)) / step

    def along(self, shifts: list[Shift], step: float) -> float:
        """Return the fourth-order central difference along the sum of directions; the worlds of one model take the SIDES steps."""
        wide = self.model.scene.build(device=DEVICE, precision="float64", worlds=len(SIDES))
        state = wide.state()
        state.time = self.state.time
        axes = {}
        for name, array in self.state.arrays().items():
            values, new = device_arrays.download(array), state.arrays()[name]
            size = device_arrays.download(new).shape
            axes[name] = world_axis(self.model, name, values) if size != values.shape else None
            device_arrays.assign(
                new, np.tile(values, [all_ // one for all_, one in zip(size, values.shape, strict=True)])
            )
        for name, array in (self.model.coupled.contact_parameters if self.model.coupled else {}).items():
            wide.coupled.contact_parameters[name].assign(
                np.tile(array.numpy(), (len(SIDES),) + (1,) * (array.ndim - 1))
            )
        for shift in (shift for shift in shifts if shift.axis is not None):
            shift.write(wide, state, shift.by_worlds(step))
        after, losses = self.advancing(wide)(state), np.zeros(len(SIDES))
        for name, array in entries(after).items():
            if axes[name] is not None:
                pieces = np.split(device_arrays.download(array), len(SIDES), axes[name])
                losses += [float((piece * self.weights[name]).sum()) for piece in pieces if name in self.weights]
        return float(losses @ WEIGHTS) / step

    def by_length(self, dt: float, step: float, scheme: str = "implicit_euler") -> float:
        """Return the derivative by the length dt of a single step; each length takes a new integrator."""
        before = self.advance

        def longer(x):
            self.advance = lambda start: ddg.Integrator(self.model, scheme=scheme, **TIGHT).step(start, dt + x)

        derivative = self.by(longer, step)
        self.advance = before
        return derivative


def moving_state(model, steps: int = 3, dt: float = 0.01, speed: float = 0.3, spin: float = 3.0, **options):
    """Return a moving state with random velocities: nonzero strains, rates and frame rotations everywhere."""
    integrator, state = ddg.Integrator(model, **TIGHT, **options), model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    state, random, mask = state.copy(), np.random.default_rng(3), StateMask(model)
    for name, array in entries(state).items():
        rate = name.rpartition("/")[2]
        if rate in ("v", "omega"):
            values = device_arrays.download(array)
            more = random.normal(size=values.shape) * (spin if rate == "omega" else speed)
            if name == "net/v":
                more[model.coupled.host.nodes :] *= spin / speed
            device_arrays.assign(array, values + mask.keep(name, more))
    return state


def vjp_of_steps(model, state, dt: float, steps: int, scheme: str = "implicit_euler"):
    """Return gradients by the first state and by the inputs of each step (last first), and the `Difference` of the loss."""
    weights = directions(model, state, 5)

    def advancing(model):
        integrator = ddg.Integrator(model, scheme=scheme, **TIGHT)

        def advance(start):
            for _ in range(steps):
                start = integrator.step(start, dt)
            return start

        return advance

    adjoint = Adjoint(ddg.Integrator(model, scheme=scheme, **TIGHT))
    tapes, current = [], state
    for _ in range(steps):
        current, tape = adjoint.step(current, dt)
        tapes.append(tape)
    grad_state, inputs = cotangent(model, weights), []
    for tape in reversed(tapes):
        grad_state, read = adjoint.vjp(tape, grad_state)
        inputs.append(read)
    return grad_state, inputs, Difference(model, state.copy(), weights, advancing(model), advancing)


def tables(model) -> list:
    """Return the parameter tables of all rod groups and element sets."""
    return [group.parameters for group in model.groups] + (
        [part.parameters for part in model.coupled.sets] if model.coupled else []
    )


def by_parameters(model, inputs: list) -> list[np.ndarray]:
    """Derivatives by the parameters of each table, (rows, ...)."""
    gradients = [device_arrays.download(group_inputs.parameters) for group_inputs in inputs[: len(model.groups)]]
    return gradients + ([rows.numpy() for rows in inputs[-1].parameters] if model.coupled else [])


def shared(values: np.ndarray, shape: tuple) -> np.ndarray:
    """Sum derivatives of elements to the shape of the values, elements along the first axis."""
    for axis in (0, 1):
        if shape[axis] == 1:
            values = values.sum(axis, keepdims=True)
    return values


def state_shifts(model, gradient, state) -> list[Shift]:
    """Return a direction in every array of the first state."""
    shifts = []
    for name, direction in directions(model, state, 7).items():
        values, slopes = device_arrays.download(entries(state)[name]), device_arrays.download(entries(gradient)[name])

        def write(_model, wide, new, name=name):
            device_arrays.assign(wide.arrays()[name], new)

        shifts.append(Shift(name, values, slopes, along(slopes, direction), write, world_axis(model, name, values)))
    return shifts


def parameter_shifts(model, inputs: list) -> list[Shift]:
    """Return a direction in every parameter of every table; `inputs` were read by the steps."""
    shifts, random = [], np.random.default_rng(11)
    per_step = [by_parameters(model, read) for read in inputs]
    for number, table in enumerate(tables(model)):
        total = sum(read[number] for read in per_step)
        of_rods = number < len(model.groups)
        for row, (name, values) in enumerate(table.values.items()):
            by_element = total[row] if of_rods else total[row].reshape(model.worlds, -1)
            worlds = 1 if of_rods else 0
            if of_rods:  # a column a rod, of every world
                values = np.broadcast_to(values, (values.shape[0], by_element.shape[1]))
            slopes = shared(by_element, values.shape)
            size = random.uniform(0.5, 1.0, values.shape) * (np.abs(values).max() or 1.0)

            def write(wide, _state, new, number=number, name=name):
                wide.note_change(tables(wide)[number].set(**{name: new}))

            shifts.append(Shift(f"{number}: {name}", values, slopes, along(slopes, size), write, worlds))
    return shifts


def check(difference: "Difference", shifts: list[Shift]) -> None:
    """Compare the derivative along the sum of all directions, each of one size in the loss, with the difference along it.

    A parameter changes by at most LARGEST a step and so may count for less. Where the two differ, each direction is tried alone.
    """
    for shift in shifts:
        slope = abs(shift.slope)
        largest = LARGEST / CHANGE if ":" in shift.name else np.inf
        shift.direction = shift.direction * (min(1.0 / slope, largest) if slope > 1e-9 else 1.0)
    wanted = sum(shift.slope for shift in shifts)
    slope_difference = difference.along(shifts, CHANGE)
    if not close(wanted, slope_difference):
        alone = {shift.name: (shift.slope, difference.along([shift], CHANGE)) for shift in shifts}
        raise AssertionError(f"gradient {wanted:.12g}, difference {slope_difference:.12g}; each alone: {alone}")


def close(value: float, expected: float, scale: float = 0.0) -> bool:
    return abs(value - expected) <= CLOSE * max(abs(expected), scale)


def check_state(model, gradient, difference, *shifts: Shift) -> None:
    """Check the derivatives by every array of the first state, and by others."""
    check(difference, [*state_shifts(model, gradient, difference.state), *shifts])


def check_length(step_inputs, difference: Difference, dt: float, step: float, scheme: str = "implicit_euler") -> None:
    """Check the derivative by the length dt of one step, from the gradients of one subsystem's inputs."""
    grad_inverse_step = sum(
        float(array.numpy().sum()) for array in (step_inputs.rate, *getattr(step_inputs, "elements_rate", ()))
    )
    per_step = 2.0 if scheme == "implicit_midpoint" else 1.0  # rate of the implicit Euler step that is solved, times dt
    assert close(-per_step * grad_inverse_step / dt**2, difference.by_length(dt, step, scheme))
