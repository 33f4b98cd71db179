"""Energy, gradient and exact tangent of a model on the host: for statics, stability and tests.

Element windows come from the device; B, a constant sparse matrix of 0, 1 and -1 per group, takes dofs to windows. Then
g = B^T g_window and H = B^T K_window B, for every term and every kind of chain alike.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import arrays
from ddg_warp.kernels import element


@dataclass
class _GroupTangent:
    """What one group contributes; dofs are numbered node by node, rod by rod."""

    group: object
    offset: int
    incidence: sparse.csr_matrix
    still: wp.array
    windows: wp.array
    energies: wp.array
    hessian: wp.array

    @property
    def size(self) -> int:
        return self.group.columns * self.group.nodes * self.group.kind.block


class Tangent:
    """The potential energy of a model and its derivatives at a state, loads and held dofs included.

    Attributes:
        size: number of dofs, held and padding ones included.
        free: which dofs are free (size,) bool.
        angle: which dofs are angles (size,) bool.
        mass: lumped mass and rotary inertia of every dof (size,) [kg, kg m^2].
    """

    def __init__(self, model):
        self.model = model
        real, device = model.types.real, model.wp_device
        self.groups, offset = [], 0
        for group in model.groups:
            kind = group.kind
            shape = (group.nodes, group.columns)
            part = _GroupTangent(
                group,
                offset,
                _incidence(group),
                wp.zeros(group.columns, dtype=real, device=device),
                arrays.allocate((kind.window, *shape), real, device),
                arrays.allocate(shape, real, device),
                arrays.allocate((kind.window**2, *shape), real, device),
            )
            self.groups.append(part)
            offset += part.size
        self.size = offset
        self.free = np.concatenate([_free(part.group) for part in self.groups])
        self.angle = np.concatenate([_angle(part.group) for part in self.groups])
        self.mass = np.concatenate([_mass(part.group) for part in self.groups])

    def energy(self, state) -> dict[str, float]:
        """Elastic energy of every term [J]."""
        result = {}
        for part, data in zip(self.groups, state.groups, strict=True):
            for i, term in enumerate(part.group.kind.terms):
                part.energies.zero_()
                self._launch(part, data, i, 0, part.energies)
                name = term.name.removesuffix("_damped")
                result[name] = result.get(name, 0.0) + float(arrays.download(part.energies).sum())
        return result

    def element_energies(self, state) -> np.ndarray:
        """Elastic energies of all elements [J], for differences free of cancellation."""
        result = []
        for part, data in zip(self.groups, state.groups, strict=True):
            for i in range(len(part.group.kind.terms)):
                part.energies.zero_()
                self._launch(part, data, i, 0, part.energies)
                result.append(arrays.download(part.energies).ravel())
        return np.concatenate(result)

    def gradient(self, state) -> np.ndarray:
        """Derivative of the elastic energy (size,) [N, N m]; minus the internal force."""
        result = np.zeros(self.size)
        for part, data in zip(self.groups, state.groups, strict=True):
            for i in range(len(part.group.kind.terms)):
                part.windows.zero_()
                self._launch(part, data, i, 1, part.windows)
                window = arrays.download(part.windows).astype(np.float64)
                result[part.offset : part.offset + part.size] += part.incidence.T @ window.transpose(2, 1, 0).ravel()
        return result

    def hessian(self, state) -> sparse.csc_matrix:
        """Exact second derivative of the elastic energy (size, size)."""
        blocks = []
        for part, data in zip(self.groups, state.groups, strict=True):
            part.hessian.zero_()
            for i in range(len(part.group.kind.terms)):
                self._launch(part, data, i, 2, part.hessian)
            w = part.group.kind.window
            values = arrays.download(part.hessian).astype(np.float64).transpose(2, 1, 0).reshape(-1, w, w)
            values = 0.5 * (values + values.transpose(0, 2, 1))
            elements = len(values)
            diagonal = sparse.bsr_matrix((values, np.arange(elements), np.arange(elements + 1)))
            blocks.append(part.incidence.T @ (diagonal @ part.incidence))
        return sparse.block_diag(blocks, format="csc")

    def loads(self, factor: float, q: np.ndarray) -> np.ndarray:
        """Outer forces (size,) [N, N m] on dofs q: gravity and dead loads times `factor`, timed loads at their amplitude."""
        result = []
        for part in self.groups:
            group = part.group
            kind, host = group.kind, group.host
            force = np.zeros((group.columns, group.nodes, kind.block))
            dead = host.mass[..., None] * group.gravity_host + host.load
            force[..., : kind.dim] = np.tile(dead.transpose(1, 0, 2), (group.worlds, 1, 1)) * factor
            if kind.twist:
                force[..., kind.dim] = np.tile(host.load_angle.T, (group.worlds, 1)) * factor
            x = self._blocks(part, q)
            for load, columns in self._timed(group):
                scale = load.at(factor, factor)
                np.add.at(force, (columns, load.k, slice(0, kind.dim)), scale * load.force)
                if kind.twist:
                    np.add.at(force, (columns, load.k, kind.dim), scale * load.moment)
                if load.couple.any():
                    pair, about = _couple_forces(x, load, columns, kind)
                    np.add.at(force, (columns, load.k + 1, slice(0, kind.dim)), scale * pair)
                    np.add.at(force, (columns, load.k, slice(0, kind.dim)), -scale * pair)
                    if kind.twist:
                        np.add.at(force, (columns, load.k, kind.dim), scale * about)
            result.append(force.ravel())
        return np.concatenate(result)

    def load_stiffness(self, factor: float, q: np.ndarray) -> sparse.csc_matrix | None:
        """Minus the derivative of the loads with respect to q; None where loads do not follow q."""
        rows, cols, values = [], [], []

        def put(i, j, block):
            rows.append(np.repeat(i, len(j)))
            cols.append(np.tile(j, len(i)))
            values.append(block.ravel())

        for part in self.groups:
            group, kind = part.group, part.group.kind
            x = self._blocks(part, q)
            for load, columns in self._timed(group):
                for column, k in zip(columns, load.k, strict=True) if load.couple.any() else ():
                    scale = load.at(factor, factor)
                    block, about = _couple_stiffness(np.diff(x[column, k : k + 2, : kind.dim], axis=0)[0], load.couple)
                    first = part.offset + (column * group.nodes + k) * kind.block + np.arange(kind.dim)
                    second = first + kind.block
                    for i, j, sign in (
                        (first, first, 1),
                        (second, second, 1),
                        (first, second, -1),
                        (second, first, -1),
                    ):
                        put(i, j, sign * scale * block)
                    if kind.twist:
                        put(first[:1] + kind.dim, second, scale * about)
                        put(first[:1] + kind.dim, first, -scale * about)
        if not rows:
            return None
        data = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
        return sparse.csc_matrix(data, shape=(self.size, self.size))

    def _blocks(self, part: _GroupTangent, q: np.ndarray) -> np.ndarray:
        return q[part.offset : part.offset + part.size].reshape(
            part.group.columns, part.group.nodes, part.group.kind.block
        )

    @staticmethod
    def _timed(group):
        """Timed loads with their columns in every world."""
        for load in group.host.timed_loads:
            for world in range(group.worlds):
                yield load, load.columns + world * group.rods

    def dofs(self, state) -> np.ndarray:
        """Positions and angles of a state (size,)."""
        result = []
        for part, data in zip(self.groups, state.groups, strict=True):
            kind = part.group.kind
            q = np.zeros((part.group.columns, part.group.nodes, kind.block))
            q[..., : kind.dim] = arrays.download(data.x).transpose(1, 0, 2)
            if kind.twist:
                q[..., kind.dim] = arrays.download(data.theta).T
            result.append(q.ravel())
        return np.concatenate(result)

    def retract(self, q: np.ndarray, step: np.ndarray) -> np.ndarray:
        """q moved along `step`, with edges turned instead of sheared.

        A straight step stretches an edge that it turns, to second order, and in a nearly inextensible rod that limits steps to
        small turns. Here an edge e becomes its rotation by t x de / |e|, lengthened by t . de; positions follow by summation
        from the held nodes, and what misses between two held nodes is spread evenly over the edges between them.
        """
        moved = q + step
        for part in self.groups:
            span = slice(part.offset, part.offset + part.size)
            kind, group = part.group.kind, part.group
            x, dx = (v[span].reshape(group.columns, group.nodes, kind.block)[..., : kind.dim] for v in (q, step))
            held = ~self.free[span].reshape(group.columns, group.nodes, kind.block)[..., : kind.dim]
            out = moved[span].reshape(group.columns, group.nodes, kind.block)
            for column in range(group.columns):
                n = group.host.count[column % group.rods]
                bend = _turn_excess(x[column, :n], dx[column, :n], kind.closed)
                for d in range(kind.dim):
                    anchors = np.flatnonzero(held[column, :n, d])
                    if not anchors.size:
                        anchors = np.array([0])
                    miss = np.interp(np.arange(n), anchors, bend[anchors, d])
                    out[column, :n, d] += bend[:, d] - miss
        return moved

    def assign(self, state, q: np.ndarray) -> None:
        """Put dofs (size,) into a state and carry its frames along."""
        for part, data in zip(self.groups, state.groups, strict=True):
            kind, group = part.group.kind, part.group
            values = q[part.offset : part.offset + part.size].reshape(group.columns, group.nodes, kind.block)
            arrays.assign(data.x, np.ascontiguousarray(values[..., : kind.dim].transpose(1, 0, 2)))
            if kind.twist:
                arrays.assign(data.theta, np.ascontiguousarray(values[..., kind.dim].T))
        self.model.carry_frames(state)

    def edge_length(self) -> float:
        """Mean rest length of edges [m]: what makes angles and positions comparable."""
        return float(np.mean([(p.group.host.length / np.maximum(1, p.group.host.own - 1)).mean() for p in self.groups]))

    def _launch(self, part: _GroupTangent, data, index: int, which: int, out: wp.array) -> None:
        group, real = part.group, self.model.types.real
        kernel = element.term_kernels(group.kind, index, real)[which]
        grid = (group.elements, group.columns) + ((group.kind.window,) if which == 2 else ())
        wp.launch(
            kernel,
            grid,
            [data.x, data.theta, data.frame, data.last, part.still, group.buffer, group.table, group.count],
            [out],
            device=self.model.wp_device,
        )


def _incidence(group) -> sparse.csr_matrix:
    """B of one group: (window dofs of all elements, dofs)."""
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


def _couple_forces(x: np.ndarray, load, columns: np.ndarray, kind) -> tuple[np.ndarray, np.ndarray]:
    """Of a couple M on edges e: the force M x e / |e|^2 on their second nodes, and the moment M . t about them."""
    e = x[columns, load.k + 1, : kind.dim] - x[columns, load.k, : kind.dim]
    square = np.sum(e * e, -1, keepdims=True)
    if kind.dim == 2:
        return load.couple[1] * np.stack([e[:, 1], -e[:, 0]], -1) / square, np.zeros(len(columns))
    return np.cross(load.couple, e) / square, e @ load.couple / np.sqrt(square[:, 0])


def _couple_stiffness(e: np.ndarray, couple: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Minus the derivatives of M x e / |e|^2 and of M . t with respect to e; the former is symmetric only in the plane."""
    square = e @ e
    if len(e) == 2:
        cross, about = couple[1] * np.array([[0.0, 1.0], [-1.0, 0.0]]), np.zeros(2)
    else:
        cross = np.cross(couple, np.eye(3)).T
        about = -(couple - e * (couple @ e) / square) / np.sqrt(square)
    return (2.0 * np.outer(cross @ e, e) / square - cross) / square, about


def _turn_excess(x: np.ndarray, dx: np.ndarray, closed: bool) -> np.ndarray:
    """Positions of nodes by turned edges minus those by straight steps (n, dim), zero at the first node."""
    e, de = (np.roll(v, -1, axis=0) - v if closed else np.diff(v, axis=0) for v in (x, dx))
    length = np.linalg.norm(e, axis=1, keepdims=True)
    t = e / length
    along = np.sum(t * de, axis=1, keepdims=True)
    across = de - t * along
    angle = np.linalg.norm(across, axis=1, keepdims=True) / length
    turned = (length + along) * (t * np.cos(angle) + across / length * np.sinc(angle / np.pi))
    excess = np.cumsum(turned - e - de, axis=0)
    if closed:
        n = len(x)
        excess -= excess[-1] * (np.arange(1, n + 1) / n)[:, None]
        excess = excess[:-1]
    return np.concatenate([np.zeros((1, x.shape[1])), excess])


def _per_dof(group, nodes: np.ndarray, angles: np.ndarray | None) -> np.ndarray:
    """(size,) from values of nodes and of angles (n, R), repeated for all worlds."""
    kind = group.kind
    full = np.repeat(nodes[..., None], kind.block, axis=-1)
    if kind.twist:
        full[..., kind.dim] = angles
    return np.concatenate([full] * group.worlds, axis=1).transpose(1, 0, 2).ravel()


def _free(group) -> np.ndarray:
    host, kind = group.host, group.kind
    bits = (host.fixed[..., None] >> np.arange(kind.block)) & 1
    inside = np.arange(group.nodes)[:, None] < host.count
    free = (bits == 0) & inside[..., None]
    return np.concatenate([free] * group.worlds, axis=1).transpose(1, 0, 2).ravel()


def _angle(group) -> np.ndarray:
    return _per_dof(group, np.zeros(group.host.mass.shape), np.ones(group.host.mass.shape)) > 0.0


def _mass(group) -> np.ndarray:
    return _per_dof(group, group.host.mass, group.host.rotary)
