"""Two rods at a random state without zeros, with results of the kernels of rod groups; for the derivative table."""

import numpy as np
import warp as wp

from ddg_warp.geometry import polyline
from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.elements.rod_layout import RodKind, rod_elements_type, rod_storage
from ddg_warp.kernels.measures import lagged_frames
from ddg_warp.kernels.terms import REGISTRY, Term
from ddg_warp.run.derivative_samples import Sample, random_parameters, random_strains


def rods_of(term: Term, closed: bool) -> RodKind:
    """Return the kind of rod with a term: bending first, then stretch, both damped or neither."""
    names = ("planar_bend", "planar_stretch") if term.measure.dim == 2 else ("rod_bend_twist", "rod_stretch")
    bending, stretch = (REGISTRY[name].damped(term.density.lagged) for name in names)
    terms = (term, stretch) if term.measure.span == 2 else (bending, term)
    return RodKind(term.measure.dim, terms[0].measure.angles > 0, closed, terms)


class RodSample(Sample):
    """A term of two rods with 6 and 5 nodes, bent, stretched and twisted, with parameters by element.

    Lagged frames differ from the tangents by 25 degrees; the reference twist is up to several revolutions.

    Attributes:
        data: q (n, R, 4), positions of dim reals, angles last; frame (7, n, R), last (strains, n, R), rate (R,), and buffer as
            (rows, n, R).
        count: number of nodes of the rods (R,).
    """

    shape, LEFT_OUT = (6, 2), frozenset({"energy", "resultant"})
    INPUTS = ("x", "theta", "frame", "last", "rate", "buffer")

    def __init__(self, term: Term, kind: RodKind, *arguments):
        self.layout, self.count = "closed" if kind.closed else "open", np.array([6, 5])
        self.index, self.grid, self.column = (
            kind.terms.index(term),
            self.shape,
            np.broadcast_to(np.arange(2), self.shape),
        )
        self.first, *_, row = kind.places()[self.index]
        self.rows, self.vectors = slice(row, row + len(term.measure.strains)), [np.s_[..., : kind.dim]]
        super().__init__(term, kind, *arguments)

    @property
    def parts(self) -> list["RodSample"]:
        """Samples of both terms of the rods."""
        return [RodSample(term, self.kind, self.precision, self.device, self.data) for term in self.kind.terms]

    def random_state(self) -> dict[str, np.ndarray]:
        """Return random data; see the class."""
        random, kind, shape = np.random.default_rng(3), self.kind, self.shape
        q = random.normal(size=(*shape, 4))
        if kind.closed:
            angle = 2.0 * np.pi * np.arange(shape[0])[:, None] / self.count
            circle = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], -1)
            q[..., : kind.dim] = (circle + 0.15 * random.normal(size=circle.shape))[..., : kind.dim]
        else:
            steps = np.eye(kind.dim)[0] + 0.35 * random.normal(size=(*shape, kind.dim))
            q[..., : kind.dim] = np.cumsum(steps, axis=0)
        frame = np.zeros((7, *shape))
        if kind.twist:
            t = polyline.unit(self.edges(q))
            frame[:6] = lagged_frames(random, t)
            u = polyline.transport(*np.moveaxis(frame[:6].reshape(2, 3, *shape), 1, -1), t)
            following = self.node(1), self.column
            twist = polyline.signed_angle(polyline.transport(u, t, t[following]), u[following], t[following])
            frame[6] = twist + 2.0 * np.pi * random.integers(-2, 3, size=shape) + 0.3 * random.normal(size=shape)
        return {
            "q": q,
            "frame": frame,
            "last": np.concatenate([random_strains(t, random, (len(t.measure.strains), *shape)) for t in kind.terms]),
            "rate": random.uniform(0.6, 1.4, size=2),
            "buffer": np.concatenate([random_parameters(term, random, shape) for term in kind.terms]),
        }

    def straight(self) -> dict[str, np.ndarray]:
        """Return dofs and frames of straight, untwisted rods with the rest lengths of the term's elements."""
        q, frame = np.zeros((*self.shape, 4)), np.zeros((7, *self.shape))
        along = polyline.unit(np.array([2.0, -1.0, 0.5])[: self.kind.dim])
        q[1:, :, : self.kind.dim] = np.cumsum(self.data["buffer"][self.first, :-1], axis=0)[..., None] * along
        if self.kind.twist:
            frame[:6] = lagged_frames(np.random.default_rng(5), along)[:, None, None]
        return {"q": q, "frame": frame}

    def node(self, shift: int) -> np.ndarray:
        """Return node k + shift of every element (n, R), at most the last node of an open rod."""
        k = np.arange(self.shape[0])[:, None] + shift
        return k % self.count if self.kind.closed else np.minimum(k, self.count - 1)

    def exists(self, edge: int) -> np.ndarray:
        """Return the mask of elements k with an edge k + edge (n, R)."""
        k = np.arange(self.shape[0])[:, None]
        return np.where(self.kind.closed, k < self.count, k + edge + 1 < self.count)

    def edges(self, q: np.ndarray | None = None) -> np.ndarray:
        """Return edge k of every element (n, R, dim); a unit vector if absent."""
        x = (self.data["q"] if q is None else q)[..., : self.kind.dim]
        edge = x[self.node(1), self.column] - x[self.node(0), self.column]
        return np.where(self.exists(0)[..., None], edge, np.eye(self.kind.dim)[0])

    @property
    def felt(self) -> np.ndarray:
        """Mask of the dofs in the energy (n, R, 4)."""
        mask = np.zeros((*self.shape, 4), bool)
        mask[..., : self.kind.dim] = (np.arange(self.shape[0])[:, None] < self.count)[..., None]
        mask[..., 3] |= self.exists(0) & (self.measure.angles > 0)
        return mask

    def evaluate(self, exact: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F^T F + c or the `exact` matrix (window, window, n, R), gradient and energies of the fused kernel, by local dofs."""
        kind, shape, real = self.kind, self.shape, self.real
        dim, window = kind.dim, kind.window
        sizes = ((kind.factor_rows,), (kind.geometric_rows,), (window,), (2,), ())
        out = [wp.zeros((*size, *shape), dtype=real, device=self.device) for size in sizes]
        kernel = element_path.evaluate_kernel(rod_storage(kind, real), real, real, exact)
        islands, results = Islands(2, real, self.device), element_path.results_type(real, real)()
        islands.drop_compression.fill_(0 if exact else 1)
        rows = [array.reshape((*array.shape[:-2], -1)) for array in out]
        results.factor, results.second, results.gradient, results.energy, results.stiffness = rows
        results.tension = results.factor
        inputs = [self.inputs(real), *islands.arrays, 0]
        wp.launch(kernel, shape, inputs, [results], device=self.device)
        rows, geometric, force, energy = (array.numpy().astype(float) for array in out[:4])
        edge_row, tension_row = kind.vertex_strains * window, kind.factor_rows - kind.tensions
        vertex = rows[:edge_row].reshape(kind.vertex_strains, window, *shape)
        edge = rows[edge_row:tension_row].reshape(kind.edge_strains, dim, *shape)
        matrix = np.einsum("minr,mjnr->ijnr", vertex, vertex)
        matrix[:dim, :dim] += np.einsum("minr,mjnr->ijnr", edge, edge)
        matrix[:dim, :dim] += np.eye(dim)[..., None, None] * rows[tension_row:].sum(0)
        if exact:
            i, j = np.triu_indices(window)
            matrix[i, j] += geometric
            matrix[j[i != j], i[i != j]] += geometric[i != j]
        return matrix, force, energy[1]

    def scatter(self, local: np.ndarray) -> np.ndarray:
        """Return derivatives by local dofs (window, n, R) by all dofs (n, R, 4)."""
        kind, out = self.kind, np.zeros((*self.shape, 4))
        for edge in range(kind.span):
            force = np.moveaxis(local[edge * kind.dim : (edge + 1) * kind.dim], 0, -1)
            np.add.at(out[..., : kind.dim], (self.node(edge), self.column), -force)
            np.add.at(out[..., : kind.dim], (self.node(edge + 1), self.column), force)
            if kind.twist:
                np.add.at(out[..., 3], (self.node(edge), self.column), local[kind.dim * kind.span + edge])
        return out

    def local_derivative(self, function) -> np.ndarray:
        """Differentiate function(**data) of elements (m, n, R) by the local dofs (m, window, n, R).

        In element k, node k affects only edge k, and node k + 2 only edge k + 1.
        """
        kind, out = self.kind, None
        for j in range(self.shape[0]):
            for c in [*range(kind.dim), *[3] * kind.twist]:
                change = self.difference(function, "q", (j, slice(None), c))
                out = np.zeros((len(change), kind.window, *self.shape)) if out is None else out
                for edge in range(kind.span):
                    entry = c + edge * kind.dim if c < kind.dim else kind.dim * kind.span + edge
                    node = self.node(2 * edge if c < kind.dim else edge)
                    sign = 1.0 if c == 3 or edge == 1 else -1.0
                    k, r = np.nonzero((node == j) & self.exists(edge))
                    out[:, entry, k, r] = sign * change[:, k, r]
        return out

    def moved(self, turn: np.ndarray) -> list[dict[str, np.ndarray]]:
        """Return data with equal energy: all rotated, and rotated with unchanged frames and compensating angles."""
        turned = self.turned(turn)
        if not self.kind.twist:
            return [turned]
        u0, t0 = (np.moveaxis(self.data["frame"][start : start + 3], 0, -1) for start in (0, 3))
        t = polyline.unit(self.edges())
        turned_u, turned_t = polyline.transport(u0, t0, t) @ turn.T, t @ turn.T
        q = turned["q"].copy()
        q[..., 3] += polyline.signed_angle(polyline.transport(u0, t0, turned_t), turned_u, turned_t)
        return [turned, {**turned, "q": q, "frame": self.data["frame"]}]

    def rotations(self):
        """Yield infinitesimal rotations: velocities of dofs (n, R, 4) and of the strains of the last step."""
        dim, x, edges = self.kind.dim, self.data["q"][..., : self.kind.dim], self.edges()
        for omega in np.eye(3) if dim == 3 else [np.array([0.0, 0.0, 1.0])]:
            spin = np.cross(omega, np.eye(3), axisb=0, axisc=0)[:dim, :dim]
            velocity = np.zeros((*self.shape, 4))
            velocity[..., :dim] = x @ spin.T
            if self.kind.twist:
                t, t0 = polyline.unit(edges), np.moveaxis(self.data["frame"][3:6], 0, -1)
                z = np.cross(t0, t) / (1.0 + np.sum(t0 * t, -1, keepdims=True))
                velocity[..., 3] = t @ omega + np.sum(z * (edges @ spin.T), -1) / np.linalg.norm(edges, axis=-1)
            last = np.zeros_like(self.data["last"])
            if self.measure.vector:
                last[self.rows] = np.einsum("ij,jnr->inr", spin, self.data["last"][self.rows])
            yield velocity, last

    def storage(self, real):
        """Return the element storage of the rods."""
        return rod_storage(self.kind, real)

    def of_local(self, values: np.ndarray, kernel_index: int) -> np.ndarray:
        """Return derivatives by the window as (window, ..., n, R)."""
        return values.reshape(*values.shape[:-1], *self.shape)

    def as_written(self, seed: np.ndarray, kernel_index: int) -> np.ndarray:
        """Return weights of energies or gradients in the layout of the kernels' outputs."""
        return seed.reshape(*seed.shape[:-2], -1)

    def by_data(self, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return derivatives by kernel inputs as derivatives by `data`."""
        q = np.zeros((*self.shape, 4))
        q[..., : self.kind.dim], q[..., 3] = values["x"], values["theta"]
        return {"q": q} | {name: values[name].reshape(array.shape) for name, array in self.data.items() if name != "q"}

    def inputs(self, real, **changed):
        """Return the struct of kernel inputs; see `kernels.elements.rod_layout.rod_elements_type`."""
        data, dim = {**self.data, **changed}, self.kind.dim
        q = data["q"]
        last = data["last"].reshape(len(data["last"]), -1)
        values = [q[..., :dim], q[..., 3], data["frame"], last, data["rate"], data["buffer"].ravel()]
        types = [wp.types.vector(dim, real), *[real] * 5]
        out = [
            wp.array(np.ascontiguousarray(v), dtype=t, device=self.device, requires_grad=True)
            for v, t in zip(values, types, strict=True)
        ]
        n, rods = self.shape
        table = np.array([(row * n * rods, rods, 1) for row in range(len(data["buffer"]))], np.int32)
        out += [wp.array(v, dtype=int, device=self.device) for v in (table, self.count.astype(np.int32))]
        struct = rod_elements_type(dim, real)()
        for name, values in zip((*self.INPUTS, "table", "count"), out, strict=True):
            setattr(struct, name, values)
        return struct
