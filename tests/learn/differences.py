"""Central differences of steps and equilibria by every input of theirs, for the tests of gradients."""

import numpy as np

import ddg_warp as ddg
from ddg_warp import arrays
from ddg_warp.learn.adjoint import Adjoint

DEVICE = "cpu"  # what models of these tests are built for; see `conftest`
CHANGE = 1e-5  # of the loss, by a step of differences
TIGHT = {"rtol": 1e-13}
CLOSE = 1e-6  # relative error of a gradient, as asked


def built(scene):
    """A model in float64."""
    return scene.build(device=DEVICE, precision="float64")


def entries(state) -> dict[str, object]:
    """All arrays of a state by name that hold something."""
    return {name: array for name, array in state.arrays().items() if array.size > 1}


class Meaning:
    """Which entries of a state mean something and may be perturbed: rates of free dofs, no padding, no joints' rotations, and nothing
    from which solves only start."""

    def __init__(self, model):
        self.model = model

    def keep(self, name: str, values: np.ndarray) -> np.ndarray:
        part, _, name = name.partition("/")
        if name in ("a", "alpha"):
            return 0.0 * values
        return self._net(name, values) if part == "net" else self._chain(self.model.groups[int(part)], name, values)

    def _chain(self, group, name: str, values: np.ndarray) -> np.ndarray:
        host, kind = group.host, group.kind
        fixed = np.tile(host.fixed, (1, group.worlds))
        node = np.arange(group.nodes)[:, None] < np.tile(host.count, group.worlds)
        edge = np.arange(group.nodes)[:, None] < np.tile(host.count - (0 if kind.closed else 1), group.worlds)
        if name in ("x", "v"):
            held = np.stack([(fixed >> d) & 1 for d in range(kind.dim)], -1) == 1
            return np.where(held & (name == "v"), 0.0, values) * node[..., None]
        if name == "omega":
            return np.where((fixed >> kind.dim) & 1, 0.0, values) * edge
        if name == "last":
            for (*_, row), term in zip(kind.places(), kind.terms, strict=True):
                values[row : row + len(term.measure.strains)] *= (
                    np.roll(edge, 1 - term.measure.span, axis=0) | kind.closed
                )
        if name == "frame":
            values[6] = 0.0  # the lagged twist only says which turn it is of
        return values * edge

    def _net(self, name: str, values: np.ndarray) -> np.ndarray:
        host = self.model.net.host
        if name in ("q", "v"):
            felt = np.ones((host.blocks, 3), bool)
            felt[host.nodes :, 1:] = False
            felt[host.blocks - host.spins :] = False
            if name == "v":
                felt &= ~host.fixed & (host.mass > 0.0)
            return np.where(np.tile(felt, (self.model.worlds, 1)), values, 0.0)
        if name.startswith("data") or (name == "frame" and not self.model.net.edges):
            return 0.0 * values
        if name.startswith("lag"):
            part = self.model.net.sets[int(name[4:])]
            values[6 * (len(part.host.lag) // 7) :] = 0.0  # angles, as of chains: of a joint behind its ghost
        return values


def directions(model, state, seed: int, strains: float = 1e-3) -> dict[str, np.ndarray]:
    """A random direction in the entries of a state that mean something."""
    random, meaning = np.random.default_rng(seed), Meaning(model)
    result = {}
    for name, array in entries(state).items():
        size = strains if "last" in name else 1.0
        result[name] = size * meaning.keep(name, random.normal(size=arrays.download(array).shape))
    return result


def put(state, values: dict[str, np.ndarray], factor: float = 1.0) -> None:
    """Add values to the entries of a state."""
    for name, array in entries(state).items():
        arrays.assign(array, arrays.download(array) + factor * values[name])


def product(state, values: dict[str, np.ndarray]) -> float:
    """Sum of the entries of a state times values."""
    return sum(float((arrays.download(array) * values[name]).sum()) for name, array in entries(state).items())


def cotangent(model, weights: dict[str, np.ndarray]):
    """A state that holds the derivatives by one of the loss `product(state, weights)`."""
    state = model.empty_state()
    put(state, weights)
    return state


def along(gradient: np.ndarray, meant: np.ndarray) -> np.ndarray:
    """A random direction in the entries that a direction `meant` has, along which nothing in a gradient cancels."""
    return np.where(gradient < 0.0, -1.0, 1.0) * np.abs(meant)


class Difference:
    """The loss `product(after, weights)` of steps from a state, as a function of what they read.

    Args:
        advance: state -> state after all steps, with a solver of its own.
    """

    def __init__(self, model, state, weights, advance):
        self.model, self.state, self.weights, self.advance = model, state, weights, advance

    def loss(self) -> float:
        return product(self.advance(self.state.copy()), self.weights)

    def by(self, change, step: float) -> float:
        """Derivative, of fourth order, by a number that `change(x)` sets to x beyond its value; it is left as it was."""
        values = {}
        for side in (2.0, 1.0, -1.0, -2.0):
            change(side * step)
            values[side] = self.loss()
        change(0.0)
        near, far = ((values[side] - values[-side]) / (2.0 * side * step) for side in (1.0, 2.0))
        return (4.0 * near - far) / 3.0

    def by_entry(self, name: str, direction: np.ndarray, about: float) -> float:
        """Along a direction in an array of the first state, where it is `about` as large; by steps that change the loss by CHANGE."""
        array, step = entries(self.state)[name], CHANGE / max(abs(about), 1e-6)
        values = arrays.download(array)
        return self.by(lambda x: arrays.assign(array, values + x * direction), step)

    def by_parameter(self, table, name: str, direction: np.ndarray, step: float) -> float:
        """Along a direction in the values of a parameter of a group or an element set."""
        values = table[name].copy()

        def change(x):
            table.set(**{name: values + x * direction})
            self.model.version += 1

        return self.by(change, step)

    def by_length(self, dt: float, step: float, scheme: str = "implicit_euler") -> float:
        """By the length of the one step from the state, dt long; each length is one integrator's."""
        before = self.advance

        def longer(x):
            self.advance = lambda start: ddg.Integrator(self.model, scheme=scheme, **TIGHT).step(start, dt + x)

        found = self.by(longer, step)
        self.advance = before
        return found


def lively(model, steps: int = 3, dt: float = 0.01, speed: float = 0.3, spin: float = 3.0, **options):
    """A state on the way, with random velocities: strains, rates and turns of frames everywhere."""
    integrator, state = ddg.Integrator(model, **TIGHT, **options), model.state()
    for _ in range(steps):
        state = integrator.step(state, dt)
    state, random, meaning = state.copy(), np.random.default_rng(3), Meaning(model)
    for name, array in entries(state).items():
        rate = name.rpartition("/")[2]
        if rate in ("v", "omega"):
            values = arrays.download(array)
            more = random.normal(size=values.shape) * (spin if rate == "omega" else speed)
            if name == "net/v":
                more[model.net.host.nodes :] *= spin / speed
            arrays.assign(array, values + meaning.keep(name, more))
    return state


def pulled(model, state, dt: float, steps: int, scheme: str = "implicit_euler"):
    """Derivatives of the loss of some steps by the first state, what each step read, the last first, and the loss's `Difference`."""
    weights = directions(model, state, 5)
    # one for all differences, as a graph takes longer than its steps
    integrator = ddg.Integrator(model, scheme=scheme, **TIGHT)

    def advance(start):
        for _ in range(steps):
            start = integrator.step(start, dt)
        return start

    adjoint = Adjoint(ddg.Integrator(model, scheme=scheme, **TIGHT))
    tapes, at = [], state
    for _ in range(steps):
        at, tape = adjoint.step(at, dt)
        tapes.append(tape)
    given, inputs = cotangent(model, weights), []
    for tape in reversed(tapes):
        given, read = adjoint.pull(tape, given)
        inputs.append(read)
    return given, inputs, Difference(model, state.copy(), weights, advance)


def close(found: float, wanted: float, scale: float = 0.0) -> bool:
    return abs(found - wanted) <= CLOSE * max(abs(wanted), scale)


def check_state(model, gradient, difference) -> None:
    """By every array of the first state, along a direction in which nothing cancels."""
    for entry, meant in directions(model, difference.state, 7).items():
        values = arrays.download(entries(gradient)[entry])
        direction = along(values, meant)
        found = float((values * direction).sum())
        assert close(found, difference.by_entry(entry, direction, found)), entry


def check_length(own, difference: Difference, dt: float, step: float, scheme: str = "implicit_euler") -> None:
    """What one part read of a step, dt long, against the derivative of the loss by its length."""
    by_rate = sum(float(array.numpy().sum()) for array in (own.rate, *getattr(own, "elements_rate", ())))
    per_step = 2.0 if scheme == "implicit_midpoint" else 1.0  # rate of the implicit Euler step that is solved, times dt
    assert close(-per_step * by_rate / dt**2, difference.by_length(dt, step, scheme))
