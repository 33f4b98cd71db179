"""Gradient check cases: an object under an analysis, with inputs and a loss; see `ddg_warp.torch.gradient_check`."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import torch

from ddg_warp.errors import SceneError
from ddg_warp.scene.grip import Grip
from ddg_warp.torch.gradient_check_scenes import scene_of
from ddg_warp.torch.named_parameters import MASSES, of_sections
from ddg_warp.torch.rotations import matrix, quaternion
from ddg_warp.torch.simulator import Simulator, WorldState

WORLDS, DT, STEPS = 2, 0.01, 2
TIGHT = {"rtol": 1e-13}
REAL = torch.float64


@dataclass
class Change:
    """Tensors given to two worlds: of the first state (None: as it is), parameters and controls, by name."""

    values: tuple | list | None = None
    parameters: dict = field(default_factory=dict)
    controls: dict = field(default_factory=dict)


@dataclass
class Input:
    """Input of steps, moved along a direction.

    Attributes:
        name: name of the input.
        size: size of a change as large as the input itself, for scaling x.
        change: x -> the `Change` that moves the input by x along the direction, x a tensor (); None if the input is no tensor.
        loss: x -> the loss with the input moved by a number x; None if differences use `change`.
        gradient: () -> the derivative at zero, for an input without `change`.
        start: True if the first state changes.
    """

    name: str
    size: float
    change: Callable | None = None
    loss: Callable | None = None
    gradient: Callable | None = None
    start: bool = False


class Case:
    """Object under an analysis, with inputs and a loss.

    Args:
        name: a key of `OBJECTS`.
        analysis: one of `ANALYSES`.
    """

    def __init__(self, name: str, analysis: str, device: str):
        self.name, self.analysis, self.device = name, analysis, device
        self.statics = analysis == "statics"
        self.random = torch.Generator("cpu").manual_seed(5)
        self.simulator = self.built()
        self.engine = self.simulator.engine(WORLDS)
        self.model = self.engine.model
        contact = self.model.coupled.host.contact_parameters if self.model.coupled is not None else None
        self.slides = self.statics and contact is not None and contact.has_friction
        axisymmetric = bool(self.model.scene.axisymmetric_shells)  # gravity is along z
        flat = axisymmetric or self.model.scene.dimension == 2
        self.place = self.engine.source[0].device
        self.axes = self._tensor([1.0, 0.0, 1.0] if flat else [1.0, 1.0, 1.0])
        self.down = self._tensor([0.0, 0.0, 1.0]) if axisymmetric else self.axes
        points, edges = self.model.points_count, self.model.order.edges_count
        shape = (WORLDS, points, 3)
        self.weights = self._normal(*shape), 0.1 * self._normal(*shape), 0.1 * self._normal(WORLDS, edges)
        bodies = self.bodies = len(self.model.scene.bodies)
        self.body_weights = self._normal(WORLDS, bodies, 3, 4), 0.1 * self._normal(WORLDS, bodies, 6)
        # start poses of equilibria: angles are measured from frames transported to there
        self.poses = 1e-3 * self._normal(WORLDS, len(self.model.grips), 6)
        self.posed = {"poses": self.poses} if self.model.grips else {}
        self.usual = {}  # controls of worlds in which others move
        self.state = self._first()

    def built(self, **changes) -> Simulator:
        """Return a simulator of the scene with changes; see `scene_of`."""
        model = scene_of(self.name, **changes).build(device=self.device, precision="float64")
        return Simulator(model, DT, scheme="implicit_euler" if self.statics else self.analysis, **TIGHT)

    def _normal(self, *shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=self.random, dtype=REAL, device="cpu").to(self.place)

    def _tensor(self, values) -> torch.Tensor:
        return torch.as_tensor(values, dtype=REAL, device=self.place)

    def _first(self) -> WorldState:
        """Return an equilibrium, or a state in motion with random velocities and spins."""
        with torch.no_grad():
            if self.slides:  # the equilibrium depends on the load path
                return self.simulator.initial_state(WORLDS)
            if self.statics:
                return self.simulator.equilibrium(None, self.posed, batch=WORLDS, **TIGHT)
            state = self.simulator.initial_state(WORLDS)
            for _ in range(3):
                state = self.simulator.step(state)
            values = self.engine.layout.put_points(state.values, "v", "v", state.velocities + self._rates())
            values = self.engine.layout.turn_edges(
                values, "omega", "v", 3.0 * self._normal(WORLDS, self.model.order.edges_count)
            )
            if self.bodies:
                rates = self._normal(WORLDS, self.bodies, 6) * self._tensor([0.3] * 3 + [3.0] * 3)
                values = self.engine.layout.bodies.put(values, None, state.body_rates + rates)
        return replace(state, values=tuple(values))

    def _rates(self) -> torch.Tensor:
        """Return random velocities (worlds, P, 3), within the planes of skew supports."""
        rates = 0.3 * self._normal(WORLDS, self.model.points_count, 3) * self.axes
        frames = self.model.coupled.host.frames if self.model.coupled is not None else {}
        for row, block in zip(*self.model.order.coupled_rows, strict=True) if frames else ():
            if block in frames:
                normals = self._tensor(frames[block][self.model.coupled.host.fixed[block]])
                rates[:, row] -= rates[:, row] @ normals.T @ normals
        return rates

    def loss(self, state: WorldState) -> torch.Tensor:
        """Return the losses of a final state, one for every WORLDS worlds."""
        pairs = [(self.weights[0], state.positions)]
        if not self.slides:  # with friction angles depend on the transport of frames
            pairs.append((self.weights[2], state.angles))
        if not self.statics:
            pairs.append((self.weights[1], state.velocities))
        if self.bodies:
            pairs += zip(self.body_weights, (state.body_poses, state.body_rates), strict=True)
        copies = len(state.codes) // WORLDS
        return sum((values.view(copies, *weights.shape) * weights).flatten(1).sum(1) for weights, values in pairs)

    def losses(self, inputs: Sequence[Input], moved: torch.Tensor) -> torch.Tensor:
        """Return the losses with each input moved alone, input i by `moved[i]`, in worlds of one batch."""
        changes = [each.change(x) for each, x in zip(inputs, moved, strict=True)]
        states = [change.values or self.state.values for change in changes]
        like = self.simulator.engine(WORLDS * len(inputs)).target
        values = [
            torch.cat(alike, entry.axis) if alike[0].shape != wide.shape else alike[0]
            for entry, wide, *alike in zip(self.engine.fields, like, *states, strict=True)
        ]
        parameters = {name: self.engine.tables.value(name) for change in changes for name in change.parameters}
        parameters = _joined([parameters | change.parameters for change in changes])
        controls = _joined([self.posed | self.usual | change.controls for change in changes])
        return self.loss(self.end(self.simulator, values, parameters, controls, len(inputs)))

    def derivatives(self, inputs: Sequence[Input]) -> list[float]:
        """Return the derivatives of the loss by inputs with a `change`, at zero; zero if torch finds no dependence."""
        moved = torch.zeros(len(inputs), dtype=REAL, device=self.place, requires_grad=True)
        loss = self.losses(inputs, moved).sum()
        return torch.autograd.grad(loss, moved)[0].tolist() if loss.requires_grad else [0.0] * len(inputs)

    def end(self, simulator: Simulator, values=None, parameters=None, controls=None, copies: int = 1) -> WorldState:
        """Return the final state of `copies` times WORLDS worlds for given tensors of the first one."""
        engine = simulator.engine(WORLDS * copies)
        state = WorldState.begun(values or self.state.values, self.state.time, engine)
        controls = self.posed if controls is None else controls
        if self.statics:
            begin = {"start": 0.0, "load_steps": STEPS} if self.slides else {"start": 1.0}
            return simulator.equilibrium(parameters, controls, state=state, **begin, **TIGHT)
        *_, state = simulator.rollout(state, parameters, controls, steps=STEPS)
        return state

    def inputs(self) -> Iterator[Input]:
        """Yield all inputs of the object."""
        points, edges = self.model.points_count, self.model.order.edges_count
        coupled = self.model.coupled
        twisted = any(group.kind.twist for group in self.model.groups) or bool(coupled is not None and coupled.edges)
        gravity = self._tensor(self.model.scene.gravity)
        place = self._normal(WORLDS, points, 3) * self.axes
        yield self._state("positions", 0.1, lambda x: self._moved("x", "q", x * place))
        if twisted:
            angle = self._normal(WORLDS, edges)
            yield self._state(
                "angles", 1.0, lambda x: self.engine.layout.turn_edges(self.state.values, "theta", "q", x * angle)
            )
        if not self.statics:
            rate = self._rates()
            yield self._state("velocities", 1.0, lambda x: self._moved("v", "v", x * rate))
            if twisted:
                spin = self._normal(WORLDS, edges)
                yield self._state(
                    "spins", 10.0, lambda x: self.engine.layout.turn_edges(self.state.values, "omega", "v", x * spin)
                )
            yield from self._of_bodies()
        for name in self.engine.tables.names():
            yield self._parameter(name)
        yield self._control("forces", 1e-2, self._normal(WORLDS, points, 3) * self.axes)
        if twisted:
            yield self._control("moments", 1e-4, self._normal(WORLDS, edges))
        if self.model.grips:
            yield self._control("poses", 0.1, self._normal(WORLDS, len(self.model.grips), 6), self.poses)
        if self.bodies:
            size, shape = self._tensor([1.0] * 3 + [1e-2] * 3), (WORLDS, self.bodies, 6)
            usual = 0.0 if self.statics else 0.3 * self._normal(*shape) * size  # moments have no potential
            yield self._control("wrenches", 0.1, self._normal(*shape) * size, usual)
        if hinges := len(self.model.drives.joints):
            yield self._control("torques", 1e-3, self._normal(WORLDS, hinges))
            drives = self.model.drives
            direction = self._normal(WORLDS, hinges) * self._tensor(drives.driven)
            usual = self._tensor([joint.angle or 0.0 for joint in drives.joints])
            yield replace(self._control("angles", 0.1, direction, usual), name="hinge angles")
        if not any(joint.first < 0 for joint in self.model.scene.body_joints):  # whose weight is a load
            yield self._control("gravity", 10.0, self._normal(WORLDS, 3) * self.down, gravity)
        if self.model.magnetic:
            yield self._control("field", 1e-2, self._normal(WORLDS, 3) * self.axes)
        if not self.statics:
            yield self._shared("time step", DT, self._by_step, self._without_step())
            yield self._shared("mass damping", 1.0, lambda x: self.end(self.built(mass_damping=0.7 + x)))
        if not self.bodies:  # which carry masses of rods
            yield self._density()

    def _of_bodies(self) -> Iterator[Input]:
        """Yield poses and rates of rigid bodies; pinned ones rotate about their joint with the world."""
        if not self.bodies:
            return
        layout, rigid = self.engine.layout.bodies, self.model.coupled.host.rigid_bodies
        rotation, place = self.state.body_poses.split([3, 1], -1)
        pinned = torch.as_tensor(rigid.pinned, device=self.place)[:, None, None]
        pivot = self._tensor(self.model.coupled.host.rest[rigid.origins])[..., None]
        shift, axis, rate = (self._normal(WORLDS, self.bodies, 3) for _ in range(3))

        def posed(poses: tuple) -> list:
            return layout.put(self.state.values, torch.cat(poses, -1), self.state.body_rates)

        def turned(x) -> list:
            turn = matrix(quaternion(x * axis))
            return posed((turn @ rotation, torch.where(pinned, pivot + turn @ (place - pivot), place)))

        def shifted(x) -> list:
            return posed((rotation, torch.where(pinned, place, place + x * shift[..., None])))

        def moved(x, k: int) -> list:
            more = torch.cat([rate * x * float(k == 0), rate * x * float(k == 1)], -1)
            return layout.put(self.state.values, None, self.state.body_rates + more)

        yield self._state("body positions", 0.1, shifted)
        yield self._state("body orientations", 1.0, turned)
        yield self._state("body velocities", 1.0, lambda x: moved(x, 0))
        yield self._state("body angular velocities", 10.0, lambda x: moved(x, 1))

    def _moved(self, array: str, blocks: str, shift: torch.Tensor) -> list:
        points = self.engine.layout.points(self.state.values, array, blocks)
        return self.engine.layout.put_points(self.state.values, array, blocks, points + shift)

    def _state(self, name: str, size: float, values: Callable) -> Input:
        return Input(name, size, lambda x: Change(values(x)), start=True)

    def _parameter(self, name: str) -> Input:
        usual, values = self.engine.tables.value(name), None
        if name == "contact.range":  # bounded by the search distance
            usual = 0.9 * usual
            values = self._begun(name, usual)
        size = float(usual.abs().max()) or self._size_of_family(name)
        if self.engine.tables.rule(name)[0] == "not negative":  # differences need smaller values, too
            usual = torch.where(usual > 0.0, usual, size)
        direction = 0.5 + torch.rand(usual.shape, generator=self.random, dtype=REAL, device="cpu").to(self.place)

        return Input(name, size, lambda x: Change(values, {name: usual + x * direction}))

    def _begun(self, name: str, value: torch.Tensor) -> tuple | None:
        """Return a start equilibrium with another parameter value, since angles depend on the path from the start."""
        if not self.statics or self.slides:
            return None
        with torch.no_grad():
            return self.end(self.simulator, None, {name: value}).values

    def _size_of_family(self, name: str) -> float:
        """Return the largest value of a parameter family, such as the components of a metric; 1 if all are zero."""
        family = name.rstrip("0123456789")
        alike = [member for member in self.engine.tables.names() if member.rstrip("0123456789") == family]
        return max(float(self.engine.tables.value(member).abs().max()) for member in alike) or 1.0

    def _control(self, name: str, size: float, direction: torch.Tensor, usual=0.0) -> Input:
        self.usual[name] = usual + 0.0 * direction
        return Input(name, size, lambda x: Change(controls={name: usual + x * direction}))

    def _density(self) -> Input:
        """Return the input that scales masses and inertia as parameters; differences rebuild the scene."""
        names = set(self.engine.tables.names())

        def scaled(x: torch.Tensor) -> dict[str, torch.Tensor]:
            masses = {name: self._tensor(of_sections(self.model, name)) for name in names.intersection(MASSES)}
            more = {name: self.engine.tables.value(name) + x * base for name, base in masses.items()}
            inertia = {name: self.engine.tables.value(name) * (1.0 + x) for name in names.intersection(["rod.inertia"])}
            return more | inertia

        return Input(
            "density",
            1.0,
            lambda x: Change(parameters=scaled(x)),
            lambda x: self.loss(self.end(self.built(density=1.0 + x))),
        )

    def _without_step(self) -> str:
        """Return the reason why step lengths have no derivative; empty if they have one."""
        field = self.model.scene.applied_field
        moved = [motion for motion in self.model.motions if not isinstance(motion, Grip)]
        parts = [*self.model.groups, *([self.model.coupled] if self.model.coupled is not None else [])]
        loads = any(part.host.timed for part in parts)
        timed = field is not None and not (field.value.constant and field.gradient.constant)
        if moved or loads or timed or callable(self.model.scene.flow):
            return "the reverse does not differentiate motions, loads, flows and fields that are functions of time"
        return ""

    def _by_step(self, x: float) -> WorldState:
        """Return the final state of steps that are longer by x [s]."""
        try:
            self.simulator.dt = DT + x
            return self.end(self.simulator)
        finally:
            self.simulator.dt = DT

    def _shared(self, name: str, size: float, end: Callable, why: str = "") -> Input:
        """Return an input that is no tensor; `end(x)` is the final state, `why` the reason if there is no derivative."""

        def gradient() -> float:
            if why:
                raise SceneError(why)
            return float(self.reverse()[name])

        return Input(name, size, loss=lambda x: self.loss(end(x)), gradient=gradient)

    def reverse(self) -> dict[str, float]:
        """Return derivatives with respect to inputs that are no tensors, from the backward pass of every step."""
        self.engine.tables.write((), [])  # parameters of the model
        states, results, sums = [self.state], [], {"time step": 0.0, "mass damping": 0.0}
        for _ in range(STEPS):
            states.append(self.simulator.step(states[-1], None, self.posed))
            results.append([*self.engine.smooth_flags(), states[-1].codes, *self.engine.lagged()])
        cotangent = self._by_end(states[-1])
        for before, after, entry in zip(states[-2::-1], states[:0:-1], results[::-1], strict=True):
            cotangent, read, _ = self.engine.backward(
                before.time, DT, before.values, after.values, entry, cotangent, self.posed
            )
            for each in read:
                grad_inverse_step = sum(
                    entry.numpy().sum() for entry in (each.rate, *getattr(each, "elements_rate", ()))
                )
                # an implicit step is over dt, the midpoint rule's over half of it
                sums["time step"] -= grad_inverse_step / DT**2 * (2.0 if self.analysis == "implicit_midpoint" else 1.0)
                sums["mass damping"] += each.damping.numpy().sum()
        return sums

    def _by_end(self, state: WorldState) -> list[torch.Tensor]:
        leaves = [value.detach().requires_grad_() for value in state.values]
        loss = self.loss(replace(state, values=tuple(leaves)))
        gradients = torch.autograd.grad(loss, leaves, allow_unused=True)
        return [
            torch.zeros_like(leaf) if gradient is None else gradient
            for leaf, gradient in zip(leaves, gradients, strict=True)
        ]


def _joined(tensors: list[dict[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
    """Return tensors of one batch from tensors of all pieces, by the same names."""
    return {name: torch.cat([each[name] for each in tensors]) for name in tensors[0]}
