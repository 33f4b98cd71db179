"""A chain in a state where nothing is zero, and what the kernels of a term make of it; for the derivative table."""

import numpy as np
import warp as wp

from ddg_warp.geometry import polyline
from ddg_warp.kernels import element
from ddg_warp.kernels.element import ChainKind
from ddg_warp.kernels.islands import Islands
from ddg_warp.kernels.terms import Term


class Sample:
    """A chain of two rods, of 6 and 5 nodes, at a random state where nothing is zero: bent, stretched and twisted, with
    frames 25 degrees old, reference twist up to several turns, and parameters of each element.

    Attributes:
        data: inputs of the kernels: x (n, R, dim), theta (n, R), frame (7, n, R), last (strains, n, R), rate (R,), and
            buffer as (rows, n, R); all of order one.
        count: nodes of the rods (R,).
        has_dof: dofs that exist (n, R, dofs of a node).
    """

    def __init__(self, kind: ChainKind, device: str, exact_in_float32: bool, data: dict | None = None):
        self.kind, self.device, self.exact_in_float32 = kind, device, exact_in_float32
        self.count = np.array([6, 5])
        self.shape = (6, 2)
        self.column = np.broadcast_to(np.arange(2), self.shape)
        self.has_dof = np.repeat(self.exists(0)[..., None], kind.block, -1)
        self.has_dof[..., : kind.dim] = (np.arange(6)[:, None] < self.count)[..., None]
        self.data = data or _random_state(self)
        if exact_in_float32:
            self.data = {name: values.astype(np.float32).astype(float) for name, values in self.data.items()}

    def node(self, shift: int) -> np.ndarray:
        """Node k + shift of every element (n, R); the last one where there is none."""
        k = np.arange(self.shape[0])[:, None] + shift
        return k % self.count if self.kind.closed else np.minimum(k, self.count - 1)

    def exists(self, edge: int) -> np.ndarray:
        """Whether edge k + edge of every element exists (n, R)."""
        k = np.arange(self.shape[0])[:, None]
        return np.where(self.kind.closed, k < self.count, k + edge + 1 < self.count)

    def edges(self, x: np.ndarray | None = None) -> np.ndarray:
        """Edge k of every element (n, R, dim); a unit vector where there is none."""
        x = self.data["x"] if x is None else x
        edge = x[self.node(1), self.column] - x[self.node(0), self.column]
        return np.where(self.exists(0)[..., None], edge, np.eye(self.kind.dim)[0])

    def energy(self, index: int, real=wp.float64, **changed) -> np.ndarray:
        """Energy of the elements of a term (n, R)."""
        return self._launch(self._kernels(index, real)[0], real, [self.shape], **changed)[0]

    def gradient(self, index: int, real=wp.float64, **changed) -> np.ndarray:
        """Window gradient of a term (window, n, R)."""
        return self._launch(self._kernels(index, real)[1], real, [(self.kind.window, *self.shape)], **changed)[0]

    def hessian(self, index: int, real) -> np.ndarray:
        """Window Hessian of a term (window, window, n, R)."""
        w = self.kind.window
        out = self._launch(self._kernels(index, real)[2], real, [(w * w, *self.shape)], columns=(w,))[0]
        return out.reshape(w, w, *self.shape)

    def strains(self, real=wp.float64, **changed) -> list[np.ndarray]:
        """Strains and stresses of all terms (strains, n, R) each."""
        return self._launch(
            element.strain_kernel(self.kind, real), real, [(self.kind.strain_rows, *self.shape)] * 2, [1], **changed
        )

    def evaluate(self, real, curved: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Factor rows, window gradient, energy and packed geometric stiffness of the fused kernel.

        `curved` asks for the latter, with compression in the factor.
        """
        kind = self.kind
        clamped = wp.full(2, 0 if curved else 1, dtype=int, device=self.device)
        out = self._launch(
            element.evaluate_kernel(kind, real, real, 0 if curved else None),
            real,
            [
                (kind.factor_rows, *self.shape),
                (kind.geometric_rows, *self.shape),
                (kind.window, *self.shape),
                (2, *self.shape),
                self.shape,
            ],
            before=[clamped, 0],
            searching=True,
        )
        return out[0], out[2], out[3][1], out[1]

    def reverse(self, index: int, which: int, seed: np.ndarray, real) -> dict[str, np.ndarray]:
        """Reverse mode of the energy (which = 0) or gradient (1) kernel of a term, by input."""
        inputs = self._inputs(real)
        adjoints = [wp.zeros_like(array) for array in inputs[:6]]
        seeds = wp.array(seed, dtype=real, device=self.device)
        wp.launch(
            self._kernels(index, real)[which],
            self.shape,
            inputs,
            [wp.zeros_like(seeds, requires_grad=True)],
            adjoint=True,
            adj_inputs=[*adjoints, None, None],
            adj_outputs=[seeds],
            device=self.device,
        )
        values = (array.numpy().astype(float) for array in adjoints)
        return {n: v.reshape(self.data[n].shape) for n, v in zip(self.data, values, strict=True)}

    def scatter(self, window: np.ndarray) -> np.ndarray:
        """From derivatives on windows (window, n, R) to dofs (n, R, dofs of a node)."""
        kind = self.kind
        out = np.zeros((*self.shape, kind.block))
        for edge in range(kind.span):
            force = np.moveaxis(window[edge * kind.dim : (edge + 1) * kind.dim], 0, -1)
            np.add.at(out[..., : kind.dim], (self.node(edge), self.column), -force)
            np.add.at(out[..., : kind.dim], (self.node(edge + 1), self.column), force)
            if kind.twist:
                np.add.at(out[..., kind.dim], (self.node(edge), self.column), window[kind.dim * kind.span + edge])
        return out

    def difference(self, function, name: str, where) -> np.ndarray:
        """Central difference of fourth order of function(**data) along data[name][where]."""
        h, ends = 1e-4, []
        for step in (h, -h, 2.0 * h, -2.0 * h):
            values = self.data[name].copy()
            values[where] += step
            ends.append(function(**{name: values}))
        return (8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12.0 * h)

    def window_derivative(self, function) -> np.ndarray:
        """Derivative of what function(**data) gives per element (m, n, R), on its window (m, window, n, R).

        Moving node k changes edge k alone in element k, and moving node k + 2 edge k + 1 alone.
        """
        kind, (n, _) = self.kind, self.shape
        out = None
        for j in range(n):
            for c in range(kind.block):
                name, where = ("x", (j, slice(None), c)) if c < kind.dim else ("theta", (j,))
                change = self.difference(function, name, where)
                out = np.zeros((len(change), kind.window, *self.shape)) if out is None else out
                for edge in range(kind.span):
                    at = c + edge * kind.dim if c < kind.dim else kind.dim * kind.span + edge
                    node = self.node(2 * edge if c < kind.dim else edge)
                    sign = 1.0 if c == kind.dim or edge == 1 else -1.0
                    k, r = np.nonzero((node == j) & self.exists(edge))
                    out[:, at, k, r] = sign * change[:, k, r]
        return out

    def isotropic(self) -> "Sample":
        """This sample, with equal stiffness and no rest strain where strains are components of a vector in space."""
        buffer = self.data["buffer"].copy()
        for term, (first, *_) in zip(self.kind.terms, self.kind.places(), strict=True):
            if is_vector(term):
                stiffness, rest = (
                    [first + term.parameter_names.index(name) for name in names]
                    for names in (term.stiffness, term.rest)
                )
                buffer[stiffness], buffer[rest] = buffer[stiffness[0]], 0.0
        data = {**self.data, "buffer": buffer}
        return Sample(self.kind, self.device, self.exact_in_float32, data)

    def turned(self, turn: np.ndarray) -> dict[str, np.ndarray]:
        """x, frame and last after a rotation."""
        frame, last = self.data["frame"].copy(), self.data["last"].copy()
        if self.kind.twist:
            for at in (0, 3):
                frame[at : at + 3] = np.einsum("ij,jnr->inr", turn, frame[at : at + 3])
        for rows in self._vector_strains():
            last[rows] = np.einsum("ij,jnr->inr", turn, last[rows])
        return {"x": self.data["x"] @ turn.T + 0.3, "frame": frame, "last": last}

    def frame_lead(self, turn: np.ndarray) -> np.ndarray:
        """Angle (n, R) by which the reference frame, turned, leads the one transported to the turned tangent."""
        u0, t0 = (np.moveaxis(self.data["frame"][at : at + 3], 0, -1) for at in (0, 3))
        t = polyline.unit(self.edges())
        turned_u, turned_t = polyline.transport(u0, t0, t) @ turn.T, t @ turn.T
        return polyline.signed_angle(polyline.transport(u0, t0, turned_t), turned_u, turned_t)

    def rotations(self):
        """Infinitesimal rotations: velocities of dofs (n, R, dofs of a node), and of the strains of the last step."""
        dim, x, edges = self.kind.dim, self.data["x"], self.edges()
        for omega in np.eye(3) if dim == 3 else [np.array([0.0, 0.0, 1.0])]:
            spin = np.cross(omega, np.eye(3), axisb=0, axisc=0)[:dim, :dim]
            velocity = np.zeros((*self.shape, self.kind.block))
            velocity[..., :dim] = x @ spin.T
            if self.kind.twist:
                t, t0 = polyline.unit(edges), np.moveaxis(self.data["frame"][3:6], 0, -1)
                z = np.cross(t0, t) / (1.0 + np.sum(t0 * t, -1, keepdims=True))
                velocity[..., dim] = t @ omega + np.sum(z * (edges @ spin.T), -1) / np.linalg.norm(edges, axis=-1)
            last = np.zeros_like(self.data["last"])
            for rows in self._vector_strains():
                last[rows] = np.einsum("ij,jnr->inr", spin, self.data["last"][rows])
            yield velocity, last

    def _vector_strains(self) -> list[slice]:
        places = zip(self.kind.terms, self.kind.places(), strict=True)
        return [slice(row, row + 3) for term, (*_, row) in places if is_vector(term)]

    def _kernels(self, index: int, real):
        return element.term_kernels(self.kind, index, real, reverse=True)

    def _inputs(self, real, **changed) -> list[wp.array]:
        data = {**self.data, **changed}
        types = {"x": wp.types.vector(self.kind.dim, real)}
        out = [
            wp.array(
                v.ravel() if n == "buffer" else v, dtype=types.get(n, real), device=self.device, requires_grad=True
            )
            for n, v in data.items()
        ]
        n, rods = self.shape
        table = np.array([(row * n * rods, rods, 1) for row in range(len(data["buffer"]))], np.int32)
        return [*out, *(wp.array(v, dtype=int, device=self.device) for v in (table, self.count.astype(np.int32)))]

    def _launch(self, kernel, real, shapes, before=(), columns=(), searching=False, **changed) -> list[np.ndarray]:
        """Arrays that a kernel writes; `searching` ones take the rates with all else of their islands."""
        out = [wp.zeros(shape, dtype=real, device=self.device) for shape in shapes]
        inputs = [*self._inputs(real, **changed), *before]
        if searching:
            islands = Islands(2, real, self.device)
            wp.copy(islands.rate, inputs[4])
            inputs[4:5] = islands.arrays
        outputs, grid = out, (*self.shape, *columns)
        wp.launch(kernel, grid, inputs, outputs, device=self.device, block_dim=128)  # `evaluate` is bound to that
        return [array.numpy().astype(float) for array in out]


def _random_state(sample: Sample) -> dict[str, np.ndarray]:
    """See `Sample`."""
    random, kind, (n, rods) = np.random.default_rng(3), sample.kind, sample.shape
    if kind.closed:
        angle = 2.0 * np.pi * np.arange(n)[:, None] / sample.count
        x = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle][: kind.dim], -1)
        x = x + 0.15 * random.normal(size=x.shape)
    else:
        steps = np.eye(kind.dim)[0] + 0.35 * random.normal(size=(n, rods, kind.dim))
        x = np.cumsum(steps, axis=0)
    frame = np.zeros((7, n, rods))
    if kind.twist:
        t = polyline.unit(sample.edges(x))
        aside = polyline.unit(np.cross(t, random.normal(size=t.shape)))
        t0 = t * np.cos(np.radians(25.0)) + aside * np.sin(np.radians(25.0))
        u0 = polyline.unit(np.cross(t0, random.normal(size=t.shape)))
        u = polyline.transport(u0, t0, t)
        ahead = sample.node(1), sample.column
        twist = polyline.signed_angle(polyline.transport(u, t, t[ahead]), u[ahead], t[ahead])
        turns = 2.0 * np.pi * random.integers(-2, 3, size=twist.shape)
        frame[:6] = np.moveaxis(np.concatenate([u0, t0], -1), -1, 0)
        frame[6] = twist + turns + 0.3 * random.normal(size=twist.shape)
    rows, last = [], []
    for term in kind.terms:
        about = 1.0 if term.measure.span == 1 else 0.0  # a stretch is 1 at rest
        for parameter in term.parameters:
            value = random.uniform(0.6, 1.4, size=(n, rods))
            if not parameter.valid[1](value).all():
                value = 0.5 * value  # a Poisson's ratio
            if parameter.unit == "1/m":
                value = 8.0 * value  # strains that mean something to a law are as large as those of the sample
            rows.append(about + 0.4 * random.normal(size=(n, rods)) if parameter.family == "rest" else value)
        last += [about + 0.4 * random.normal(size=(n, rods)) for _ in term.measure.strains]
    return {
        "x": x,
        "theta": random.normal(size=(n, rods)),
        "frame": frame,
        "last": np.array(last),
        "rate": random.uniform(0.6, 1.4, size=rods),
        "buffer": np.array(rows),
    }


def is_vector(term: Term) -> bool:
    """Whether the strains are components of a vector in space, which turns with the rod."""
    return term.measure.name.startswith("curvature_binormal")


def rotation(dim: int, angle: float) -> np.ndarray:
    """A rotation matrix (dim, dim)."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0 if dim == 3 else np.array([0.0, 0.0, 1.0])
    spin = np.cross(axis, np.eye(3), axisb=0, axisc=0)
    return (np.eye(3) + np.sin(angle) * spin + (1.0 - np.cos(angle)) * spin @ spin)[:dim, :dim]
