"""A net on a device: constant arrays, its states, and what can be launched on them."""

from dataclasses import dataclass, field

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.compile.net.net import Net, inert_mass
from ddg_warp.compile.precision import float32_error, stiffnesses
from ddg_warp.kernels import element_path
from ddg_warp.kernels.net import elements, frames
from ddg_warp.kernels.search import RELAG
from ddg_warp.model.parameters import ParameterTable
from ddg_warp.model.rod_elements import RodElements


@dataclass
class NetState:
    """Device arrays of a net with N blocks, W worlds.

    Attributes:
        q, v: blocks (W N,) of positions [m], angles and rotation vectors since the last step [rad], and their rates.
        a: accelerations of blocks (W N,), as of `GroupState`, as far as they are trusted; see `kernels.net.foresight`.
        frame: director and tangent of rod edges (6, W edges).
        lag: own lagged rows of each element set (rows, W E); last: strains of each damped set at this state.
        data: data (rows, W E) of those sets, by index, that have normals among them that supports turn, or the magnetic field.
        rate: 1/h of the step that has led there (W,) [1/s], where that had inertia in the stiffness of contact, else zero; empty in
            scenes whose contact never has.
    """

    q: wp.array
    v: wp.array
    a: wp.array
    frame: wp.array
    lag: list[wp.array] = field(default_factory=list)
    last: list[wp.array] = field(default_factory=list)
    data: dict[int, wp.array] = field(default_factory=dict)
    rate: wp.array | None = None

    def arrays(self) -> dict[str, wp.array]:
        """All arrays by name."""
        named = {"q": self.q, "v": self.v, "a": self.a, "frame": self.frame}
        for i, (lag, last) in enumerate(zip(self.lag, self.last, strict=True)):
            named |= {f"lag_{i}": lag, f"last_{i}": last}
        if self.rate is not None and len(self.rate):
            named["rate"] = self.rate
        return named | {f"data_{i}": data for i, data in self.data.items()}


class DeviceSet:
    """Elements of one term on the device; parameters as in `Group`: one buffer, and rows (offset, along, across worlds).

    `turning` (n, 3) are element, first row of the data and motion of the normals that supports turn, `turning_rest` (n, 3) these
    normals at rest.
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
        """Data of every world (rows, W E) at rest."""
        return wp.array(np.tile(self.host.data, (1, self.worlds)), dtype=self._real, device=self.device)

    def set_parameter(self, name: str, values: np.ndarray) -> bool:
        """Replace a parameter by values of shape (), (worlds,), (elements,) or (worlds, elements); return as of
        `ParameterTable.set`."""
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
        """Replace what of the elements from `first` on belongs to their rest shape, in every world; stiffness stays.

        Returns as of `ParameterTable.set`.

        Args:
            first: element.
            parameters: all parameters of the term by name, each one number or one an element.
        """
        count, changed = max(np.size(values) for values in parameters.values()), {}
        for name in (parameter.name for parameter in self.term.parameters if parameter.rest):
            now = self.parameters[name]
            full = np.repeat(now, self.elements // now.shape[1], axis=1)
            full[:, first : first + count] = parameters[name]
            changed[name] = full if len(full) > 1 else _short(full[0])[None]
        return self.parameters.set(**changed)


class DeviceNet:
    """A `Net` with all its worlds on a device; `motions` are those that turn the supports of shells and rings, -1 where none does.

    Attributes:
        mass: of the dofs of blocks (worlds, N) [kg, kg m^2]; weighed: whether it may be another one than that of `host`.
        moves: what inertia or drag give a rate, as masses of the dofs of blocks (N,) that are positive there.
        drag: coefficients of the edges that feel some, world by world (rows, W E), as of `kernels.drag`; None without.
        touching: numbers of contact by name: "stiffness", "range" and "friction" (worlds, groups, groups), "radius" (worlds, bodies).
    """

    def __init__(self, host: Net, worlds: int, device, real, motions: np.ndarray):
        self.host, self.worlds, self.device, self.real = host, worlds, device, real
        self.vector = wp.types.vector(3, real)
        self.blocks, self.angle_start = host.blocks, host.nodes
        self.dim, self.world_columns, self.columns = 3, 1, worlds
        self.edges = host.rod_edges
        self.sets = [DeviceSet(s, worlds, device, real, motions) for s in host.sets]
        self.mass = wp.array(np.tile(host.mass, (worlds, 1, 1)), dtype=self.vector, device=device)
        self._stiffnesses = None, None  # the last ones and what they are of
        self._along = {}  # elements of pieces of rods
        self.weighed, self.drag, felt = False, None, np.zeros((host.blocks, 3))
        if host.drag:
            ends, angles, coefficients = host.drag
            self.drag = wp.array(np.tile(coefficients, (1, worlds)), dtype=real, device=device)
            felt[ends] = 1.0
            felt[angles[angles >= 0], 0] = 1.0
        self.touching = {}
        if host.touching:
            for name, values in host.touching.numbers.items():
                tiled = np.tile(values, (worlds, *[1] * values.ndim))
                self.touching[name] = wp.array(tiled, dtype=real, device=device)
        self.moves = wp.array(host.mass + felt, dtype=self.vector, device=device)
        self.ends = wp.array(np.ascontiguousarray(host.ends, np.int32).reshape(-1, 2), dtype=int, device=device)
        self.still = wp.zeros(worlds, dtype=real, device=device)
        self.every = wp.full(worlds, 1, dtype=int, device=device)

    def _zeros(self, rows: int, columns: int) -> wp.array:
        return wp.zeros((max(1, rows), max(1, columns)), dtype=self.real, device=self.device)

    def lagged(self) -> tuple[wp.array, list[wp.array]]:
        """Arrays of frames, and of the own lagged rows of every set, not yet filled."""
        counts = [(len(part.host.lag), part.elements) for part in self.sets]
        own = [self._zeros(rows, self.worlds * elements if rows else 1) for rows, elements in counts]
        return self._zeros(6, self.worlds * self.edges), own

    def empty(self) -> NetState:
        """Arrays of a state, not yet filled."""
        blocks = self.worlds * self.blocks
        q, v, a = (wp.zeros(blocks, dtype=self.vector, device=self.device) for _ in range(3))
        state = NetState(q, v, a, *self.lagged())
        for part in self.sets:
            count = self.worlds * part.elements
            strains = len(part.term.measure.strains) if part.term.density.lagged else 0
            state.last.append(self._zeros(strains, count if strains else 1))
        state.data = self.turning_data() | self.field_data()
        heavy = self.host.touching and self.host.touching.inertia.any()
        state.rate = wp.zeros(self.worlds if heavy else 0, dtype=self.real, device=self.device)
        return state

    @property
    def node_mass(self) -> wp.array:
        """Masses of nodes as [block][world]."""
        return self.angles(self.mass.flatten())

    def dof_masses(self) -> np.ndarray:
        """Masses of all dofs, world by world (W N 3,)."""
        if self.weighed:
            return self.mass.numpy().astype(float).ravel()
        return np.tile(self.host.mass.ravel(), self.worlds)

    def points(self, blocks: wp.array) -> wp.array:
        """Blocks (W N,) as the points of a storage, [block][world]."""
        return blocks.reshape((self.worlds, self.blocks)).transpose((1, 0))

    def angles(self, blocks: wp.array) -> wp.array:
        """Blocks (W N,) as the angles of a storage, [block][world]: their first components."""
        size = wp.types.type_size_in_bytes(self.real)
        shape, strides = (self.blocks, self.worlds), (3 * size, 3 * size * self.blocks)
        view = wp.array(ptr=blocks.ptr, dtype=self.real, shape=shape, strides=strides, device=self.device)
        view._ref = blocks  # what it looks at lives as long
        return view

    def components(self, blocks: wp.array) -> wp.array:
        """Blocks (W N,) as [component][block][world]."""
        size = wp.types.type_size_in_bytes(self.real)
        shape, strides = (3, self.blocks, self.worlds), (size, 3 * size, 3 * size * self.blocks)
        view = wp.array(ptr=blocks.ptr, dtype=self.real, shape=shape, strides=strides, device=self.device)
        view._ref = blocks
        return view

    def frames(self, frame: wp.array) -> wp.array:
        """Frames (6, W edges) as those of a storage, [component][edge][world]."""
        return frame.reshape((6, -1, max(1, self.edges))).transpose((0, 2, 1))

    def turning_data(self) -> dict[int, wp.array]:
        """Data of the sets with normals that supports turn, as at rest."""
        return {i: part.own_data() for i, part in enumerate(self.sets) if len(part.turning)}

    def field_data(self) -> dict[int, wp.array]:
        """Data of the sets that are in a magnetic field, in that of the rest state."""
        return {i: part.own_data() for i, part in enumerate(self.sets) if part.term.measure.field}

    def rest(self) -> NetState:
        """The rest state."""
        state = self.empty()
        state.q.assign(np.tile(self.host.rest, (self.worlds, 1)))
        if self.edges:
            state.frame.assign(np.tile(self.host.frame, (1, self.worlds)))
        for part, lag in zip(self.sets, state.lag, strict=True):
            if len(part.host.lag):
                lag.assign(np.tile(part.host.lag, (1, self.worlds)))
        return state

    @property
    def version(self) -> int:
        """Rises with every change of a parameter of its sets."""
        return sum(part.parameters.version for part in self.sets)

    def rod_stiffnesses(self, s: float) -> np.ndarray:
        """Stiffnesses of every rod over a step of s [s], by the parameters that it has in every world (3, W rods); one world stands for
        all where parameters are those of the scene. See `precision.stiffnesses`.

        The last ones are remembered, as of a `Group`.
        """
        key = s, self.version
        if self._stiffnesses[0] != key:
            self._stiffnesses = key, self._find_stiffnesses(s) if self.version else self.host.rod_stiffnesses(s)
        return self._stiffnesses[1]

    def _find_stiffnesses(self, s: float) -> np.ndarray:
        found = np.empty((3, self.worlds, len(self.host.rods)))
        for piece, rods, rows in self.host.pieces:
            if id(piece) not in self._along:
                indices = np.array([self.host.rods[rod].rod for rod in rods])
                self._along[id(piece)] = RodElements(self, piece.kind, indices, piece.mass.shape[1])
            mass, length = (np.tile(values[rows], self.worlds) for values in (inert_mass(piece, s), piece.length))
            own = stiffnesses(piece.kind, mass, length, self._along[id(piece)].parameters(), s)
            found[:, :, rods] = np.reshape(own, (3, self.worlds, -1))
        return found.reshape(3, -1)

    def rod_errors(self, s: float) -> np.ndarray:
        """What float32 makes of these rods over a step of s [s]; see `precision.float32_error`."""
        stretching, _, softest = self.rod_stiffnesses(s)
        return float32_error(stretching, softest)

    def split_errors(self, s: float) -> np.ndarray:
        """As of `Net`, of rods of every world."""
        return self.host.split_errors(self.rod_stiffnesses(s))

    def elements(self, state: NetState, index: int, q=None, rate=None):
        """What every kernel of a term reads of set `index` at a state, or at other dofs `q`, at rest or at a rate."""
        part, given = self.sets[index], elements.elements_type(self.real)()
        given.q, given.frame = state.q if q is None else q, state.frame
        given.lag, given.last, given.rate = state.lag[index], state.last[index], self.still if rate is None else rate
        (given.buffer, given.table), given.slots = part.parameters.arrays, part.slots
        given.data = state.data.get(index, part.data)
        given.blocks, given.angle_start, given.edges = self.blocks, self.angle_start, self.edges
        given.elements = part.elements
        return given

    def strains(self, state: NetState, index: int, strain: wp.array, stress: wp.array | None = None) -> None:
        """Strains of a set (strains, W E), and stresses if asked for."""
        part = self.sets[index]
        wp.launch(
            element_path.strain_kernel(elements.coupled_storage(part.term, self.real), self.real),
            (self.worlds, part.elements),
            [self.elements(state, index), int(stress is not None)],
            [strain, strain if stress is None else stress],
            device=self.device,
        )

    def update_strains(self, state: NetState) -> None:
        """Store the strains of a state where strain-rate damping looks for them."""
        for index, part in enumerate(self.sets):
            if part.term.density.lagged:
                self.strains(state, index, state.last[index])

    def carry(
        self, before: NetState, after: NetState, kept: NetState | None = None, moved: wp.array | None = None
    ) -> None:
        """Lagged data of `after` from those of `before` and the positions of `after`, whose joints then start from zero.

        Worlds that have not `moved` take over those of `kept` instead. The states may be the same. Launches alone, so that it
        can be captured.
        """
        if self.edges:
            self._carry(before, after, after.q, kept or before, moved or self.every, 1, 0)
            self.reset_spins(after.q)

    def renew(self, state: NetState, q: wp.array, todo: wp.array) -> None:
        """Lagged data of `state` as of dofs q of a solve, in worlds whose `todo` asks for it; strains stay what they are."""
        self._carry(state, state, q, state, todo, RELAG, 1)

    def _carry(self, before, after, q: wp.array, kept, moved: wp.array, wanted: int, within: int) -> None:
        """See `kernels.net.frames`."""
        real, serial = self.real, arrays.serial(self.device)

        def launch(kernel, count, inputs, outputs):
            arrays.sweep(kernel, count, inputs, outputs, self.device, worlds=self.worlds)

        launch(
            frames.edge_kernel(real, serial),
            self.edges,
            [q, self.ends, self.blocks, moved, wanted, kept.frame, before.frame],
            [after.frame],
        )
        for index, (part, same, old, new) in enumerate(zip(self.sets, kept.lag, before.lag, after.lag, strict=True)):
            if part.term.measure.advance:
                given = self.elements(after, index, q)
                given.lag = old
                kernel = frames.lag_kernel(part.term.measure, real, serial)
                launch(kernel, part.elements, [given, moved, wanted, within, same], [new])

    @property
    def carries(self) -> list:
        """Kernels of `carry`, to load before a capture."""
        if not self.edges:
            return []
        real, serial = self.real, arrays.serial(self.device)
        kernels = [frames.lag_kernel(s.term.measure, real, serial) for s in self.sets if s.term.measure.advance]
        return [*kernels, frames.edge_kernel(real, serial), *([frames.reset_kernel(real)] if self.host.spins else [])]

    def reset_spins(self, blocks: wp.array) -> None:
        """Zero the rotations of joints, or their rates."""
        spins = self.host.spins
        if spins:
            inputs = [self.blocks - spins, spins, self.blocks]
            wp.launch(frames.reset_kernel(self.real), self.worlds * spins, inputs, [blocks], device=self.device)


def _short(values: np.ndarray) -> np.ndarray:
    """One value where all are alike."""
    return values[:1] if values.size and np.all(values == values.flat[0]) else values
