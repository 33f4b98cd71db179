"""Energy and tangent of rod groups on the host.

Element windows come from the device; B, a constant sparse matrix of 0, 1 and -1 per group, takes dofs to windows. Then, for every
term and every kind of rod,

    g = B^T g_window,    H = B^T K_window B.
"""

from functools import cached_property

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import device_arrays
from ddg_warp.compile.residual_tolerance import support_forces
from ddg_warp.geometry.edge_rotation import turned
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.rod_layout import rod_storage
from ddg_warp.model.parameters import ParameterTable
from ddg_warp.solve.equilibrium.rigid_modes import Body
from ddg_warp.solve.equilibrium.tangent_part import TangentBlock
from ddg_warp.solve.forces.prescribed_motion import Motion


class RodTangent(TangentBlock):
    """Tangent block of one rod group; dofs are numbered node by node, rod by rod. See `Tangent` for the methods."""

    def __init__(self, model, group, offset: int):
        kind = group.kind
        super().__init__(model, group, offset, group.columns * group.nodes * kind.block)
        self.group, self.block = group, kind.block
        self.body_count = self.islands = group.columns
        self.rate = group.still  # inverse time of strain-rate damping: zero at rest
        self.free = _free(group)
        self.angle = np.tile(np.arange(kind.block) >= kind.dim, group.columns * group.nodes)

    @cached_property
    def incidence(self) -> sparse.csr_matrix:
        """Matrix from dofs to windows of elements."""
        return _incidence(self.group)

    @cached_property
    def _windows(self) -> wp.array:
        return self._allocate(self.group.kind.window)

    @cached_property
    def _energies(self) -> wp.array:
        return self._allocate()

    @cached_property
    def _hessian(self) -> wp.array:
        return self._allocate(self.group.kind.window**2)

    def _allocate(self, *rows: int) -> wp.array:
        shape = (*rows, self.group.nodes, self.group.columns)
        return device_arrays.allocate(shape, self.model.types.real, self.model.wp_device)

    def accelerations(self, gravity: np.ndarray) -> np.ndarray:
        return np.append(gravity[list(self.host.axes)], 0.0)[None, : self.group.kind.block]

    def data(self, state):
        """Return the group's state."""
        return state.groups[self.model.groups.index(self.group)]

    def energies(self, state):
        """Yield (term's name, energies of its elements (worlds, elements))."""
        for i, term in enumerate(self.group.kind.terms):
            self._energies.zero_()
            self._launch(state, i, 0, self._energies)
            values = device_arrays.download(self._energies).astype(np.float64)
            yield term.name, values.T.reshape(self.group.worlds, -1)

    def gradient(self, state) -> np.ndarray:
        result = np.zeros(self.size)
        for i in range(len(self.group.kind.terms)):
            self._windows.zero_()
            self._launch(state, i, 1, self._windows)
            window = device_arrays.download(self._windows).astype(np.float64)
            result += self.incidence.T @ window.transpose(2, 1, 0).ravel()
        return result

    def hessian(self, state) -> sparse.csc_matrix:
        self._hessian.zero_()
        for i in range(len(self.group.kind.terms)):
            self._launch(state, i, 2, self._hessian)
        w = self.group.kind.window
        values = device_arrays.download(self._hessian).astype(np.float64).transpose(2, 1, 0).reshape(-1, w, w)
        values = 0.5 * (values + values.transpose(0, 2, 1))
        elements = len(values)
        diagonal = sparse.bsr_matrix((values, np.arange(elements), np.arange(elements + 1)))
        return self.incidence.T @ (diagonal @ self.incidence)

    def unit_forces(self, state, strains: np.ndarray) -> sparse.csr_matrix:
        """Return the derivatives of the strains by the dofs, times the measures: forces of unit stresses (size, columns n strains).

        Args:
            strains: of all terms at this state, with quadratic laws (strains, n, columns).
        """
        group, values = self.group, self.group.parameters.values
        blocks = np.zeros((group.columns, group.nodes, group.kind.window, len(strains)))
        for index, (term, place) in enumerate(zip(group.kind.terms, group.kind.places(), strict=True)):
            names = [[f"{term.name}.{name}" for name in family] for family in (term.stiffness, term.rest)]
            first = place[3]
            for unit in range(len(term.rest)):
                unit_values = {name: np.full((1, 1), float(m == unit)) for m, name in enumerate(names[0])}
                unit_values |= {name: strains[first + m] - 1.0 for m, name in enumerate(names[1])}
                table = ParameterTable(values | unit_values, 0, self.model.types.real, self.model.wp_device)
                self._windows.zero_()
                self._launch(state, index, 1, self._windows, table)
                blocks[..., first + unit] = device_arrays.download(self._windows).transpose(2, 1, 0)
        blocks = blocks.reshape(-1, *blocks.shape[2:])
        elements = np.arange(len(blocks) + 1)
        return sparse.csr_matrix(self.incidence.T @ sparse.bsr_matrix((blocks, elements[:-1], elements)))

    def blocks(self, q: np.ndarray) -> np.ndarray:
        """Return dofs (size,) as (column, node, dofs of a node)."""
        return q.reshape(self.group.columns, self.group.nodes, self.group.kind.block)

    def dofs(self, state) -> np.ndarray:
        return self._flat(self.data(state).x, self.data(state).theta)

    def rates(self, state) -> np.ndarray:
        return self._flat(self.data(state).v, self.data(state).omega)

    def _flat(self, nodes: wp.array, angles: wp.array) -> np.ndarray:
        kind = self.group.kind
        q = np.zeros((self.group.columns, self.group.nodes, kind.block))
        q[..., : kind.dim] = device_arrays.download(nodes).transpose(1, 0, 2)
        if kind.twist:
            q[..., kind.dim] = device_arrays.download(angles).T
        return q.ravel()

    def assign(self, state, q: np.ndarray) -> None:
        kind, data = self.group.kind, self.data(state)
        values = self.blocks(q)
        device_arrays.assign(data.x, np.ascontiguousarray(values[..., : kind.dim].transpose(1, 0, 2)))
        if kind.twist:
            device_arrays.assign(data.theta, np.ascontiguousarray(values[..., kind.dim].T))

    @cached_property
    def _motion(self) -> Motion:
        return Motion(self.model, self.group)

    def move_supports(self, state, before: float, load_factor: float) -> None:
        """Move supports of a state at load parameter `before` to load parameter `load_factor`."""
        if self.host.moves:
            data = self.data(state)
            self._motion.put(state, before, load_factor, data.x, data.frame, data.theta)

    def edges(self, q: np.ndarray) -> np.ndarray:
        """Return the edge vectors of the windows (E, dim), zero for missing edges."""
        return (self.incidence @ q).reshape(-1, self.group.kind.window)[:, : self.group.kind.dim]

    def edge_dofs(self) -> np.ndarray:
        """Return the position dofs of both ends of all edges (2, E, dim)."""
        group, kind, ends = self.group, self.group.kind, []
        for column in range(group.columns):
            n = group.host.count[column % group.rods]
            first = np.arange(n if kind.closed else n - 1)
            ends.append(column * group.nodes + np.stack([first, (first + 1) % n]))
        return kind.block * np.concatenate(ends, axis=1)[..., None] + np.arange(kind.dim)

    def body_loads(self, outer: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Return the sum of the outer forces on every rod, or its largest support force if larger (columns,) [N]."""
        columns, nodes, force = self.group.columns, self.group.nodes, ~self.angle
        total = np.where(self.free & force, np.abs(outer), 0.0).reshape(columns, -1).sum(1)
        support = np.where(~self.free & force, gradient, 0.0).reshape(columns * nodes, -1)
        return np.maximum(total, support_forces(support, np.repeat(np.arange(columns), nodes), columns))

    def allowed(self, loads: np.ndarray) -> np.ndarray:
        """Return the residual tolerance at rtol = 1 (size,) [N, N m] from rod loads; see `ddg_warp.compile.residual_tolerance`."""
        lengths = np.where(self.angle, np.repeat(np.tile(self.group.host.length, self.group.worlds), self._dofs), 1.0)
        return np.repeat(loads, self._dofs) * lengths

    def sums(self, loads: np.ndarray, rtol: float, residual: np.ndarray, rounding_floor: np.ndarray):
        """Return the test of residual sums along each rod from the first node, and the largest excess over rounding (islands,)."""
        dim = self.group.kind.dim
        sums = np.abs(np.cumsum(self.blocks(residual)[..., :dim], axis=1))
        limit = (rtol * loads)[:, None, None]
        rounding_error = np.sqrt(np.cumsum(self.blocks(rounding_floor)[..., :dim] ** 2, axis=1))
        return (sums <= limit).all((1, 2)), (sums - np.maximum(limit, rounding_error)).max((1, 2))

    @property
    def _dofs(self) -> int:
        return self.size // self.group.columns

    def edge_length(self) -> float:
        """Return the mean rest length of edges [m]."""
        return float((self.group.host.length / np.maximum(1, self.group.host.own - 1)).mean())

    def point_dofs(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of `State.points`, and the dofs (rows, 3) of the first world, -1 for none."""
        k, column, rows = self.model.order.places(self.group)
        return rows, self.host.dofs(k * self.group.rods + column)

    def bodies(self) -> list[Body]:
        """Return every rod of every world."""
        group, kind, result = self.group, self.group.kind, []
        axes = [0, 2] if kind.dim == 2 else [0, 1, 2]
        for column in range(group.columns):
            n = group.host.count[column % group.rods]
            first = self.offset + (column * group.nodes + np.arange(n)) * kind.block
            nodes = np.full((n, 3), -1)
            nodes[:, axes] = first[:, None] + np.arange(kind.dim)
            edges = np.arange((n if kind.closed else n - 1) if kind.twist else 0)
            ends = np.stack([edges, (edges + 1) % n], axis=1)
            result.append(Body(nodes, first[edges] + kind.dim, ends, np.zeros((0, 3), int)))
        return result

    def where(self, dof: int) -> str:
        """Return the label of the node or edge of a dof."""
        column, k = divmod(dof // self.group.kind.block, self.group.nodes)
        return self.host.name(k * self.group.rods + column % self.group.rods)

    def retract(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return q moved along `step` by rotating edges; see `ddg_warp.geometry.edge_rotation`."""
        moved = q + step
        kind, group = self.group.kind, self.group
        x, dx = (self.blocks(v)[..., : kind.dim] for v in (q, step))
        fixed = ~self.blocks(self.free)[..., : kind.dim]
        out = self.blocks(moved)
        for column in range(group.columns):
            n = group.host.count[column % group.rods]
            still = np.zeros((n, kind.dim))
            out[column, :n, : kind.dim] += turned(x[column, :n], dx[column, :n], fixed[column, :n], still, kind.closed)
        return moved

    def _launch(
        self, state, index: int, kernel_index: int, out: wp.array, parameters: ParameterTable | None = None
    ) -> None:
        group, data, real = self.group, self.data(state), self.model.types.real
        window, device = group.kind.window, self.model.wp_device
        kernel = element_path.term_kernels(rod_storage(group.kind, real), index, real)[kernel_index]
        inputs, grid = [group.element_inputs(data, data.last, self.rate, parameters)], (group.elements, group.columns)
        rows = ()
        if kernel_index == 2:  # stresses of the law only
            inputs, grid, rows = (
                [*inputs, wp.zeros((0, 0), dtype=real, device=device)],
                (*grid, window),
                (window, window),
            )
        wp.launch(kernel, grid, inputs, [device_arrays.columns(out, *rows)], device=device)


def _incidence(group) -> sparse.csr_matrix:
    """Return B of one group: (window dofs of all elements, dofs)."""
    kind, n = group.kind, group.nodes
    count = np.tile(group.host.count, group.worlds)
    column, k = (a.ravel() for a in np.meshgrid(np.arange(group.columns), np.arange(n), indexing="ij"))
    size = count[column]
    rows, cols, values = [], [], []

    def put(mask, window_dof, node, component, sign):
        element_index = (column * n + k)[mask]
        rows.append(element_index * kind.window + window_dof)
        cols.append((column[mask] * n + node[mask]) * kind.block + component)
        values.append(np.full(len(element_index), sign))

    def at(shift):
        return (k + shift) % size if kind.closed else np.minimum(k + shift, n - 1)

    for edge in range(kind.span):
        exists = k < size if kind.closed else k + edge + 1 < size
        for d in range(kind.dim):
            put(exists, edge * kind.dim + d, at(edge + 1), d, 1.0)
            put(exists, edge * kind.dim + d, at(edge), d, -1.0)
        if kind.twist:
            put(exists, kind.dim * kind.span + edge, at(edge), kind.dim, 1.0)
    shape = (group.columns * n * kind.window, group.columns * n * kind.block)
    return sparse.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))), shape=shape)


def _free(group) -> np.ndarray:
    host = group.host
    bits = (host.fixed[..., None] >> np.arange(group.kind.block)) & 1
    inside = np.arange(group.nodes)[:, None] < host.count
    return _every_world(group, (bits == 0) & inside[..., None])


def _every_world(group, values: np.ndarray) -> np.ndarray:
    """Return values of dofs (n, R, block) in the numbering of all worlds (size,)."""
    return np.concatenate([values] * group.worlds, axis=1).transpose(1, 0, 2).ravel()
