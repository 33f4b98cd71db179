"""Coupled system on a device: constant arrays, states, and launches on them."""

from dataclasses import dataclass, field

import numpy as np
import warp as wp

from ddg_warp import device_arrays as arrays
from ddg_warp.compile.coupled.system import CoupledSystem, inert_mass
from ddg_warp.compile.precision import float32_error, stiffnesses
from ddg_warp.kernels.core.nodes import NodeStorage, state_type
from ddg_warp.kernels.elements import coupled_element as elements
from ddg_warp.kernels.elements import coupled_frames as frames
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.newton.rod_iterate import UPDATE_FRAMES
from ddg_warp.model.parameters import ParameterTable
from ddg_warp.model.rigid_bodies import RigidBodyTables
from ddg_warp.model.rod_elements import RodElements
from ddg_warp.model.user_forces import UserForceArrays


@dataclass
class CoupledState:
    """Device arrays of the coupled system with N dof blocks and W worlds.

    Attributes:
        q, v: blocks (W N,) of positions [m], twist angles and rotation vectors since the last step [rad], and their rates.
        a: accelerations of blocks (W N,) for the warm start; see `RodGroupState` and `kernels.stepping.warm_start`.
        frame: director and tangent of rod edges (6, W edges).
        lag: time-lagged rows of each element set (rows, W E).
        last: strains of each damped set at this state.
        data: data (rows, W E), by index, of sets in the magnetic field or with normals that supports rotate.
        rotation: orientations of rigid bodies (W B,), columns are principal axes; empty without bodies.
        momentum: angular momenta of rigid bodies in space (W B,) [kg m^2/s]; empty without bodies.
        rate: 1/h of the last step (W,) [1/s] if inertia entered its contact stiffness, else 0. Empty without such contact.
    """

    q: wp.array
    v: wp.array
    a: wp.array
    frame: wp.array
    lag: list[wp.array] = field(default_factory=list)
    last: list[wp.array] = field(default_factory=list)
    data: dict[int, wp.array] = field(default_factory=dict)
    rate: wp.array | None = None
    rotation: wp.array | None = None
    momentum: wp.array | None = None

    def arrays(self) -> dict[str, wp.array]:
        """Return all arrays by name."""
        named = {"q": self.q, "v": self.v, "a": self.a, "frame": self.frame}
        for i, (lag, last) in enumerate(zip(self.lag, self.last, strict=True)):
            named |= {f"lag_{i}": lag, f"last_{i}": last}
        if self.rate is not None and len(self.rate):
            named["rate"] = self.rate
        if self.rotation is not None and len(self.rotation):
            named |= {"rotation": self.rotation, "momentum": self.momentum}
        return named | {f"data_{i}": data for i, data in self.data.items()}


class ElementSetArrays:
    """Element set on the device, with its parameters as in `RodGroup`.

    Attributes:
        turning: element, first row of the data and motion (n, 3) of the normals that supports rotate.
        turning_rest: these normals at rest (n, 3).
    """

    def __init__(self, host, worlds: int, device, real, motions: np.ndarray):
        self.host, self.term, self.worlds, self.device = host, host.term, worlds, device
        self.elements = len(host)
        self.slots = arrays.upload(host.slots.astype(np.int32), int, device)
        data = host.data if host.data.size else np.zeros((1, 1))
        self.data = wp.array(np.ascontiguousarray(data), dtype=real, device=device)
        short = {name: _short(np.asarray(p, float))[None] for name, p in host.parameters.items()}
        self.parameters, self._real = ParameterTable(short, 1, real, device), real
        self.turning = np.array([*host.normals[:2], motions[host.normals[2]]]).T
        self.turning = self.turning[self.turning[:, 2] >= 0]
        element, row, _ = self.turning.T
        self.turning_rest = host.data[row[:, None] + np.arange(3), element[:, None]]

    def own_data(self) -> wp.array:
        """Return the data of every world (rows, W E) at rest."""
        return wp.array(np.tile(self.host.data, (1, self.worlds)), dtype=self._real, device=self.device)

    def set_parameter(self, name: str, values: np.ndarray) -> bool:
        """Replace a parameter; return True if its memory was reallocated.

        Args:
            values: of shape (), (worlds,), (elements,) or (worlds, elements).
        """
        if values.ndim == 0:
            new = values.reshape(1, 1)
        elif values.shape == (self.worlds,):
            new = values[:, None]
        elif values.shape in ((self.elements,), (self.worlds, self.elements)):
            new = np.atleast_2d(values)
        else:
            raise ValueError(
                f"{self.term.name}.{name} has shape {values.shape}; give one number, ({self.worlds},), ({self.elements},) or "
                f"({self.worlds}, {self.elements})"
            )
        return self.parameters.set(**{name: new})

    def set_rest(self, first: int, parameters: dict[str, np.ndarray]) -> bool:
        """Replace rest-shape parameters of a run of elements in all worlds; return True if memory was reallocated.

        Stiffness parameters stay.

        Args:
            first: first element of the run.
            parameters: all parameters of the term by name, each one number or one an element.
        """
        count, changed = max(np.size(values) for values in parameters.values()), {}
        for name in self._rest_names:
            current = self.parameters[name]
            full = np.repeat(current, self.elements // current.shape[1], axis=1)
            full[:, first : first + count] = parameters[name]
            changed[name] = full if len(full) > 1 else _short(full[0])[None]
        return self.parameters.set(**changed)

    def write_rest(self, first: int, parameters: dict[str, np.ndarray]) -> None:
        """Write rest-shape parameters as `set_rest` does, but to memory of one number per element and world that stays."""
        count = max(np.size(values) for values in parameters.values())
        indices = first + np.arange(count) + self.elements * np.arange(self.worlds)[:, None]
        for name in self._rest_names:
            if name not in self.parameters.prescribed:
                self.parameters.prescribe(name, (self.worlds, self.elements))
            self.parameters.write(name, [(indices, parameters[name])])

    @property
    def _rest_names(self) -> list[str]:
        return [parameter.name for parameter in self.term.parameters if parameter.rest]


class CoupledModel:
    """Coupled system: a `CoupledSystem` with all worlds on a device.

    Args:
        motions: index of the motion that rotates each support of shells and rings, -1 for none.
        user_forces: `UserForce` of the scene.

    Attributes:
        mass: of dof blocks (worlds, N) [kg, kg m^2].
        has_custom_mass: True if `mass` may differ from `host`.
        moves: masses of dof blocks (N,), positive where inertia or a quadratic potential determine a rate.
        coefficients: coefficients of forces on edges by name, world by world (rows, W E); see `CoupledSystem.forced_edges`.
        shell_coefficients: coefficients of drag of triangles, world by world (2, W T); see `CoupledSystem.drag_triangles`.
        user_forces: `UserForceArrays` of the user-defined forces.
        contact_parameters: contact parameters by name: "stiffness", "range" and "friction" (worlds, groups, groups), "radius"
            (worlds, bodies).
    """

    def __init__(self, host: CoupledSystem, worlds: int, device, real, motions: np.ndarray, user_forces: list):
        self.host, self.worlds, self.device, self.real = host, worlds, device, real
        self.user_forces = [UserForceArrays(force, host, worlds, device, real) for force in user_forces]
        self.vector = wp.types.vector(3, real)
        self.blocks, self.angle_start = host.blocks, host.nodes
        self.dim, self.world_columns, self.columns = 3, 1, worlds
        self.edges = host.rod_edges
        self.sets = [ElementSetArrays(s, worlds, device, real, motions) for s in host.sets]
        self.mass = wp.array(np.tile(host.mass, (worlds, 1, 1)), dtype=self.vector, device=device)
        self._stiffnesses = None, None  # key and values
        self._along = {}  # elements of pieces of rods
        self.has_custom_mass = False
        self.coefficients = {
            name: wp.array(np.tile(values, (1, worlds)), dtype=real, device=device)
            for name, values in host.coefficients.items()
        }
        self.shell_coefficients = wp.array(np.tile(host.shell_coefficients, (1, worlds)), dtype=real, device=device)
        held, (ends, angles) = np.zeros((host.blocks, 3)), host.forced_edges
        held[ends] = 1.0
        held[angles[angles >= 0], 0] = 1.0
        self.contact_parameters = {}
        if host.contact_parameters:
            for name, values in host.contact_parameters.numbers.items():
                tiled = np.tile(values, (worlds, *[1] * values.ndim))
                self.contact_parameters[name] = wp.array(tiled, dtype=real, device=device)
        self.moves = wp.array(host.mass + held, dtype=self.vector, device=device)
        self.ends = wp.array(np.ascontiguousarray(host.ends, np.int32).reshape(-1, 2), dtype=int, device=device)
        serial = arrays.serial(device)
        self.nodes, self.node_threads = (
            NodeStorage(3, False, serial, True),
            (worlds, arrays.takers(host.blocks, device)),
        )
        self.count = wp.full(worlds, host.blocks, dtype=int, device=device)
        self.world = wp.array(np.arange(worlds), dtype=int, device=device)
        self.still = wp.zeros(worlds, dtype=real, device=device)
        self.every = wp.full(worlds, 1, dtype=int, device=device)
        self.bodies = RigidBodyTables(host.rigid_bodies, self) if host.rigid_bodies else None

    def has_quadratic_matrix(self, quadratic: bool) -> bool:
        """Return True if matrices take blocks with a stiffness: `quadratic` potentials or user-defined forces."""
        return quadratic or bool(self.user_forces)

    def _zeros(self, rows: int, columns: int) -> wp.array:
        return wp.zeros((max(1, rows), max(1, columns)), dtype=self.real, device=self.device)

    def lagged(self) -> tuple[wp.array, list[wp.array]]:
        """Allocate frames, and the time-lagged rows of every element set."""
        counts = [(len(part.host.lag), part.elements) for part in self.sets]
        rows_of_sets = [self._zeros(rows, self.worlds * elements if rows else 1) for rows, elements in counts]
        return self._zeros(6, self.worlds * self.edges), rows_of_sets

    def empty(self) -> CoupledState:
        """Allocate a state."""
        blocks = self.worlds * self.blocks
        q, v, a = (wp.zeros(blocks, dtype=self.vector, device=self.device) for _ in range(3))
        state = CoupledState(q, v, a, *self.lagged())
        for part in self.sets:
            count = self.worlds * part.elements
            strains = len(part.term.measure.strains) if part.term.density.lagged else 0
            state.last.append(self._zeros(strains, count if strains else 1))
        state.data = self.turning_data() | self.field_data()
        heavy = self.host.contact_parameters and self.host.contact_parameters.inertia.any()
        state.rate = wp.zeros(self.worlds if heavy else 0, dtype=self.real, device=self.device)
        count = self.worlds * (len(self.bodies) if self.bodies else 0)
        state.rotation = wp.zeros(count, dtype=wp.types.matrix((3, 3), self.real), device=self.device)
        state.momentum = wp.zeros(count, dtype=self.vector, device=self.device)
        return state

    @property
    def node_mass(self) -> wp.array:
        """Masses of nodes as [block][world]."""
        return self.angles(self.mass.flatten())

    def dof_masses(self) -> np.ndarray:
        """Return masses of all dofs, world by world (W N 3,)."""
        if self.has_custom_mass:
            return self.mass.numpy().astype(float).ravel()
        return np.tile(self.host.mass.ravel(), self.worlds)

    def points(self, blocks: wp.array) -> wp.array:
        """View values of dof blocks (W N,) as [block][world]."""
        size = wp.types.type_size_in_bytes(blocks.dtype)
        return _view(blocks, blocks.dtype, (self.blocks, self.worlds), (size, size * self.blocks))

    @property
    def node_shape(self) -> tuple[int, int]:
        """Number of dof blocks and of columns."""
        return self.blocks, self.columns

    @property
    def node_count(self) -> wp.array:
        """Number of nodes of every column."""
        return wp.full(self.columns, self.host.nodes, dtype=int, device=self.device)

    def node_state(self, state: CoupledState):
        """Return dof blocks of a state, and their rates, for kernels over nodes."""
        result = state_type(self.nodes, self.real)()
        result.x, result.v = self.points(state.q), self.points(state.v)
        return result

    def common(self, values: wp.array) -> wp.array:
        """View values of dof blocks (N,), the same in all worlds, as [block][world]."""
        return _view(values, values.dtype, (self.blocks, self.worlds), (*values.strides, 0))

    def angles(self, blocks: wp.array) -> wp.array:
        """View the first components (twist angles) of dof blocks (W N,) as [block][world]."""
        size = wp.types.type_size_in_bytes(self.real)
        return _view(blocks, self.real, (self.blocks, self.worlds), (3 * size, 3 * size * self.blocks))

    def components(self, blocks: wp.array) -> wp.array:
        """View dof blocks (W N,) as [component][block][world]."""
        scalar = blocks.dtype._wp_scalar_type_
        size = wp.types.type_size_in_bytes(scalar)
        return _view(blocks, scalar, (3, self.blocks, self.worlds), (size, 3 * size, 3 * size * self.blocks))

    def frames(self, frame: wp.array) -> wp.array:
        """View frames (6, W edges) as [component][edge][world]."""
        return frame.reshape((6, -1, max(1, self.edges))).transpose((0, 2, 1))

    def turning_data(self) -> dict[int, wp.array]:
        """Return rest data of element sets with normals that supports rotate, by index."""
        return {i: part.own_data() for i, part in enumerate(self.sets) if len(part.turning)}

    def field_data(self) -> dict[int, wp.array]:
        """Return rest data of element sets in the magnetic field, by index."""
        return {i: part.own_data() for i, part in enumerate(self.sets) if part.term.measure.field}

    def rest(self) -> CoupledState:
        """Return the rest state."""
        state = self.empty()
        state.q.assign(np.tile(self.host.rest, (self.worlds, 1)))
        if self.edges:
            state.frame.assign(np.tile(self.host.frame, (1, self.worlds)))
        for part, lag in zip(self.sets, state.lag, strict=True):
            if len(part.host.lag):
                lag.assign(np.tile(part.host.lag, (1, self.worlds)))
        if self.bodies:
            self.bodies.start(state)
        return state

    @property
    def version(self) -> int:
        """Counter of parameter changes in all element sets."""
        return sum(part.parameters.version for part in self.sets)

    def rod_stiffnesses(self, s: float) -> np.ndarray:
        """Return stiffnesses of every rod in every world (3, W rods) over a step of s [s]; see `precision.stiffnesses`.

        As long as no parameter has changed, one world stands for all (3, rods). The last result is cached.
        """
        key = s, self.version
        if self._stiffnesses[0] != key:
            self._stiffnesses = key, self._find_stiffnesses(s) if self.version else self.host.rod_stiffnesses(s)
        return self._stiffnesses[1]

    def _find_stiffnesses(self, s: float) -> np.ndarray:
        result = np.empty((3, self.worlds, len(self.host.rods)))
        for piece, rods, rows in self.host.pieces:
            if id(piece) not in self._along:
                indices = np.array([self.host.rods[rod].rod for rod in rods])
                self._along[id(piece)] = RodElements(self, piece.kind, indices, piece.mass.shape[1])
            mass, length = (np.tile(values[rows], self.worlds) for values in (inert_mass(piece, s), piece.length))
            of_piece = stiffnesses(piece.kind, mass, length, self._along[id(piece)].parameters(), s)
            result[:, :, rods] = np.reshape(of_piece, (3, self.worlds, -1))
        return result.reshape(3, -1)

    def rod_errors(self, s: float) -> np.ndarray:
        """Return the float32 error of every rod over a step of s [s]; see `precision.float32_error`."""
        stretching, _, softest = self.rod_stiffnesses(s)
        return float32_error(stretching, softest)

    def split_errors(self, s: float) -> np.ndarray:
        """Return float32 errors of the mixed axial-force formulation for the rods of every world."""
        return self.host.split_errors(self.rod_stiffnesses(s))

    def elements(self, state: CoupledState, index: int, q=None, rate=None, parameters=None):
        """Return the kernel struct of element set `index` at a state, optionally with other dofs `q`, rate and parameters."""
        part, inputs = self.sets[index], elements.elements_type(self.real)()
        inputs.q, inputs.frame = state.q if q is None else q, state.frame
        inputs.lag, inputs.last, inputs.rate = state.lag[index], state.last[index], self.still if rate is None else rate
        (inputs.buffer, inputs.table), inputs.slots = (parameters or part.parameters).arrays, part.slots
        inputs.data = state.data.get(index, part.data)
        inputs.blocks, inputs.angle_start, inputs.edges = self.blocks, self.angle_start, self.edges
        inputs.elements = part.elements
        return inputs

    def strains(self, state: CoupledState, index: int, strain: wp.array, stress: wp.array | None = None) -> None:
        """Compute strains of an element set (strains, W E), and stresses if `stress` is given."""
        part = self.sets[index]
        wp.launch(
            element_path.strain_kernel(elements.coupled_storage(part.term, self.real), self.real),
            (self.worlds, part.elements),
            [self.elements(state, index), int(stress is not None)],
            [strain, strain if stress is None else stress],
            device=self.device,
        )

    def update_strains(self, state: CoupledState) -> None:
        """Store the strains of a state for strain-rate damping."""
        for index, part in enumerate(self.sets):
            if part.term.density.lagged:
                self.strains(state, index, state.last[index])

    def carry(
        self, before: CoupledState, after: CoupledState, kept: CoupledState | None = None, moved: wp.array | None = None
    ) -> None:
        """Update time-lagged data of `after` from `before` at the positions of `after`, and zero joint rotations.

        Worlds that have not `moved` copy the data of `kept` instead. The states may be the same. Only launches: can be captured.
        """
        if self.edges or self.bodies:
            self._carry(before, after, after.q, kept or before, moved or self.every, 1, 0)
            self.reset_spins(after.q)

    def renew(self, state: CoupledState, q: wp.array, todo: wp.array) -> None:
        """Update frames and time-lagged data of `state` to iterate q in worlds that `todo` marks; strains stay."""
        self._carry(state, state, q, state, todo, UPDATE_FRAMES, 1)

    def sweep(self, kernel, inputs: list, outputs: list, count: int | None = None) -> None:
        """Launch a kernel over `count` items of every world, by default its dof blocks; see `device_arrays.sweep`."""
        count = self.blocks if count is None else count
        arrays.sweep(kernel, count, inputs, outputs, self.device, worlds=self.worlds)

    def _carry(self, before, after, q: wp.array, kept, moved: wp.array, wanted: int, within: int) -> None:
        """Launch the frame and lag kernels of `kernels.elements.coupled_frames`."""
        real, serial = self.real, arrays.serial(self.device)
        inputs = [q, self.ends, self.blocks, moved, wanted, kept.frame, before.frame]
        if self.edges:
            self.sweep(frames.edge_kernel(real, serial), inputs, [after.frame], self.edges)
        for index, (part, same, old, new) in enumerate(zip(self.sets, kept.lag, before.lag, after.lag, strict=True)):
            if part.term.measure.advance:
                self._update_lag(index, after, q, [moved, wanted, within, same], old, new)

    def _update_lag(self, index: int, state, q: wp.array, inputs: list, old: wp.array, new: wp.array) -> None:
        """Write the lagged rows of an element set from the `old` rows, the frames of a state and dofs q."""
        part, element_inputs = self.sets[index], self.elements(state, index, q)
        element_inputs.lag = old
        kernel = frames.lag_kernel(part.term.measure, self.real, arrays.serial(self.device))
        self.sweep(kernel, [element_inputs, *inputs], [new], part.elements)

    def turn_ghosts(self, before: CoupledState, start: CoupledState, q: wp.array, moved: wp.array) -> None:
        """Rotate ghosts of joints and bodies from `before` to `start` by the rotation vectors in q, then zero these vectors."""
        for index, part in enumerate(self.sets):
            if part.term.measure.spins:
                self._update_lag(index, start, q, [moved, 1, 0, before.lag[index]], before.lag[index], start.lag[index])
        self.reset_spins(q)

    @property
    def carries(self) -> list:
        """Kernels of `carry`, to load before a capture."""
        if not (self.edges or self.bodies):
            return []
        real, serial = self.real, arrays.serial(self.device)
        kernels = [frames.lag_kernel(s.term.measure, real, serial) for s in self.sets if s.term.measure.advance]
        edges = [frames.edge_kernel(real, serial)] if self.edges else []
        return [*kernels, *edges, *([frames.reset_kernel(real)] if self.host.spins else [])]

    def reset_spins(self, blocks: wp.array) -> None:
        """Zero the rotations of joints, or their rates."""
        spins = self.host.spins
        if spins:
            inputs = [self.blocks - spins, spins, self.blocks]
            wp.launch(frames.reset_kernel(self.real), self.worlds * spins, inputs, [blocks], device=self.device)


def _short(values: np.ndarray) -> np.ndarray:
    """Return one value if all are equal, else the values."""
    return values[:1] if values.size and np.all(values == values.flat[0]) else values


def _view(array: wp.array, dtype, shape: tuple[int, ...], strides: tuple[int, ...]) -> wp.array:
    """View the memory of an array with another type, shape and strides [bytes]."""
    view = wp.array(ptr=array.ptr, dtype=dtype, shape=shape, strides=strides, device=array.device)
    view._ref = array  # keeps the memory alive
    return view
