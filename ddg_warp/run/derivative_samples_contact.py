"""Collisions at a random state without zeros, with energies, forces and matrices from the contact kernels.

The kernels are the ones of steps and adjoints. Each of eight collisions is a world of its own.
"""

import numpy as np
import warp as wp

from ddg_warp.kernels.adjoint.contact import FRICTION, NUMBERS, RATE, friction_jacobian_kernel, pull_kernel
from ddg_warp.kernels.collision.contact.assembly import BODIES, PAIR_NODES, ROW, WEIGHT, factor_struct
from ddg_warp.kernels.collision.contact.closest_points import (
    distance_function,
    end_function,
    mollifier_function,
    node_function,
)
from ddg_warp.kernels.collision.contact.geometric_stiffness import KINDS, bend_function
from ddg_warp.kernels.collision.contact.pair_evaluation import (
    columns_kernel,
    evaluate_kernels,
    law_struct,
    read_functions,
)
from ddg_warp.kernels.collision.contact.potential import ENDS, rows_of
from ddg_warp.kernels.collision.friction.potential import ROWS, friction_kernel, lag_kernel, lagged_struct
from ddg_warp.kernels.collision.primitives import EDGE_POINT, EDGES, POINT_POINT, sides_struct
from ddg_warp.kernels.terms import LAWS, Potential
from ddg_warp.run.derivative_samples import Sample, random_parameters

CROSSING = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.3, -0.5, 0.3], [0.7, 0.5, 0.4]]
OBLIQUE = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.1, 0.1, 0.4], [0.9, 0.5, 0.3]]  # mollified, by `SQUARE`
ABOVE = [[0.3, 0.3, 0.4], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
APART = [[0.0, 0.0, 0.0], [0.3, 0.2, 0.4]]
OFFSET = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.4, 0.3, 0.3]]
SQUARE = 30.0  # squared rest length of both edges
INNER = 0.5, 0.0  # one node in the interior of a rod, one at an end
VELOCITY = 3.0
NUMBERED = "stiffness", "range", "thickness", "friction"  # rows of the buffer and of derivatives


class ContactSample(Sample):
    """Eight collisions with a law of the distance.

    Attributes:
        data: q (nodes, 3), first nodes of all collisions first; buffer (parameters, E).
    """

    layout, dim, COUNT, ORDERS = "pair", 3, 8, (1,)
    LEFT_OUT = frozenset({"gradient", "lagged", "rest", "rigid"})
    POSITIONS = ("q",)

    def __init__(self, potential: Potential, *arguments):
        self.shape, self.first, self.parts = (self.COUNT,), 0, [self]
        self.collision, self.law = potential.kind, potential.density
        self.nodes = potential.kind.first + potential.kind.second
        self.slots = np.arange(self.nodes * self.COUNT).reshape(-1, self.COUNT)
        self.felt = np.ones((self.slots.size, 3), bool)
        super().__init__(potential, *arguments)

    def random_state(self) -> dict[str, np.ndarray]:
        """Return random data; see the class."""
        random, kind = np.random.default_rng(11), self.collision
        base = np.array({EDGE_POINT: OFFSET, EDGES: CROSSING, POINT_POINT: APART}.get(kind, ABOVE))
        nodes = np.repeat(base[:, None], self.COUNT, 1)
        if kind == EDGES:
            nodes[:, ::2] = np.array(OBLIQUE)[:, None]
        nodes += 0.05 * random.normal(size=nodes.shape)
        return {"q": nodes.reshape(-1, 3), "buffer": random_parameters(self.term, random, self.shape)}

    def parameter_rows(self, *families: str) -> list[int]:
        """Return all rows of the buffer."""
        return list(range(len(self.data["buffer"])))

    def isotropic(self) -> "ContactSample":
        """Return the sample itself, which is isotropic."""
        return self

    def moved(self, turn: np.ndarray) -> list[dict[str, np.ndarray]]:
        """Return data after a rotation and a translation."""
        return [{**self.data, **{name: self.data[name] @ turn.T + [0.3, -0.2, 0.5] for name in self.POSITIONS}}]

    def energy(self, real=wp.float64, **changed) -> np.ndarray:
        """Return energies (E,)."""
        return self._evaluated(real, **changed)[0].numpy().astype(float)

    def gradient(self, real=wp.float64, **changed) -> np.ndarray:
        """Return derivatives by the nodes (3 nodes, E)."""
        return self._flat(self._evaluated(real, **changed)[1])

    def hessian(self, real=wp.float64) -> np.ndarray:
        """Return exact second derivatives by the nodes (3 nodes, 3 nodes, E)."""
        arguments, (*_, factor), count = self._given(real), self._evaluated(real), self.COUNT
        chosen = self._put(np.arange(count), int)
        out = wp.zeros((3 * PAIR_NODES, PAIR_NODES, count), dtype=wp.types.vector(3, real), device=self.device)
        inputs = [*arguments, factor, chosen, self._put([count], int), 3 * PAIR_NODES * count]
        kernel = columns_kernel(self.collision, self.law, real, real)
        wp.launch(kernel, 3 * PAIR_NODES * count, [inputs[0], *inputs[2:]], [out], device=self.device)
        return np.stack([self._flat(column) for column in out.numpy()[: 3 * self.nodes]], 1)

    def evaluate(self, exact: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F^T F (3 nodes, 3 nodes, E), gradients and energies; `exact` adds `geometric_stiffness`."""
        energy, gradient, factor = self._evaluated(self.real)
        matrix = self._product(factor) + (self._bent() if exact else 0.0)
        return matrix, self._flat(gradient), energy.numpy().astype(float)

    def reverse(self, order: int, seed: np.ndarray) -> dict[str, np.ndarray]:
        """Return derivatives of v . gradient, v = `seed`, by input, in reverse mode."""
        real, kernel = self.real, pull_kernel(self.collision, self.law, self.real)
        pairs, count, *law = self._given(real)
        out = self._parts(real), self._numbers(real)
        inputs = [1, pairs, count, *law[:2], self._places(), law[2], self._put(-self.scatter(seed), self._vector(real))]
        wp.launch(kernel, 1, inputs, out, device=self.device)
        return {"q": self._by_node(out[0]), "buffer": out[1].numpy().astype(float)[: len(self.data["buffer"])]}

    def resultants(self) -> float:
        """Return the largest resultant force or moment of a collision, over the largest component."""
        force, x = (values.reshape(self.nodes, -1, 3) for values in (self.scatter(self.gradient()), self.data["q"]))
        moment = np.cross(x, force)
        return max(np.abs(vectors.sum(0)).max() / np.abs(vectors).max() for vectors in (force, moment))

    def gauss_newton(self) -> np.ndarray:
        """Return the sum over distances of c psi'' times the squared derivative, by differences."""
        curvature = self._distances()[1]
        slopes = self.local_derivative(lambda **data: self._distances(**data)[0])
        return np.einsum("kp,kap,kbp->abp", curvature, slopes, slopes)

    def compared(self) -> np.ndarray:
        """Return the mask of collisions with one distance, where F^T F and `geometric_stiffness` form the exact Hessian (E,)."""
        return self._evaluated(wp.float64)[2].bend.numpy() != 0.0

    def _product(self, factor) -> np.ndarray:
        """Return F^T F of factors (3 nodes, 3 nodes, E)."""
        rows, used = factor.row.numpy().astype(float), factor.used.numpy()
        kept = (used >> np.arange(1, len(rows) + 1)[:, None]) & 1
        each = np.einsum("kp,kps,kpd->kpsd", kept, rows[..., WEIGHT : WEIGHT + PAIR_NODES], rows[..., :3])
        each = each.reshape(*kept.shape, -1)[..., : 3 * self.nodes]
        return np.einsum("kpa,kpb->abp", each, each)

    def _bent(self) -> np.ndarray:
        """Return psi' D'' of `geometric_stiffness` (3 nodes, 3 nodes, E)."""
        real, kind = self.real, KINDS.index(self.collision)
        near, bend = distance_function(self.collision, real), bend_function(real)
        (_, corners), V = read_functions(self.collision, real), self._vector(real)
        Y = wp.types.matrix((4, 3), real)

        @wp.kernel(module="unique", enable_backward=False)
        def columns(
            nodes: wp.array(dtype=wp.vec4i), scale: wp.array(dtype=real), x: wp.array(dtype=V), out: wp.array3d(dtype=V)
        ):
            p, column = wp.tid()
            points = corners(x, nodes[p])
            w, _d, _n = near(points)
            v = Y()
            v[column / 3, column % 3] = real(1.0)
            y = bend(wp.static(kind), points, w, v)
            for slot in range(4):
                out[column, slot, p] = y[slot] * scale[p]

        out = wp.zeros((3 * self.nodes, PAIR_NODES, self.COUNT), dtype=V, device=self.device)
        inputs = [self._places(), self._evaluated(real)[2].bend, self._put(self.data["q"], V)]
        wp.launch(columns, (self.COUNT, 3 * self.nodes), inputs, [out], device=self.device)
        return np.stack([self._flat(column) for column in out.numpy()], 1)

    def _distances(self, **changed) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances of the energy and c psi'' of each (rows, E), in float64."""
        kind, real = self.collision, wp.float64
        near, end, to_node, mollify = (
            distance_function(kind, real),
            *(build(real) for build in (end_function, node_function, mollifier_function)),
        )
        curvature, (parameters_of, corners), V = (
            self.law.laws(real, 1)[2],
            read_functions(kind, real),
            self._vector(real),
        )
        E, Law, Sides = wp.types.vector(1, real), law_struct(real), sides_struct(real)

        @wp.kernel(module="unique", enable_backward=False)
        def distances(
            pairs: wp.array(dtype=wp.vec2i),
            sides: Sides,
            law: Law,
            nodes: wp.array(dtype=wp.vec4i),
            x: wp.array(dtype=V),
            out: wp.array3d(dtype=real),
        ):
            i = wp.tid()
            p, threshold, inner = parameters_of(law, sides, pairs[i])
            points = corners(x, nodes[i])
            _w, d, _n = near(points)
            c = curvature(E(d), p)
            m = real(1.0)
            if wp.static(kind == EDGES):
                normal = wp.cross(points[1] - points[0], points[3] - points[2])
                m, _slope = mollify(wp.dot(normal, normal), threshold)
                for k in range(wp.static(ENDS)):
                    _we, de, _ne = end(points, k)
                    ce = curvature(E(de), p)
                    stiffness = ce[0]
                    for j in range(2):
                        node = wp.where(k < 2, 2, 0) + j
                        _wn, dn, _nn = to_node(points, k, node)
                        cn = curvature(E(dn), p)
                        stiffness -= inner[node] * cn[0]
                    out[0, k + 1, i] = de
                    out[1, k + 1, i] = real(0.5) * (real(1.0) - m) * wp.max(stiffness, real(0.0))
            out[0, 0, i] = d
            out[1, 0, i] = m * c[0]

        pairs, _count, *law, x = self._given(real, **changed)
        out = wp.zeros((2, rows_of(kind), self.COUNT), dtype=real, device=self.device)
        wp.launch(distances, self.COUNT, [pairs, *law, self._places(), x], [out], device=self.device)
        return tuple(out.numpy())

    def _evaluated(self, real, positions: str = "q", **changed) -> tuple:
        """Return energies, gradients by local node index and factors of contact at the named positions."""
        kind, factor = self.collision, self._factor(real, rows_of(self.collision))
        energy, gradient = wp.zeros(self.COUNT, dtype=real, device=self.device), self._parts(real)
        inputs = [1, *self._given(real, positions, **changed)]
        kernel = evaluate_kernels(kind, self.law, real, real, True)[2]
        wp.launch(kernel, 1, inputs, [factor, energy, gradient], device=self.device)
        return energy, gradient, factor

    def _given(self, real, positions: str = "q", **changed) -> list:
        """Return pairs, pair count, sides, law and positions as kernel inputs."""
        data, law, sides = {**self.data, **changed}, law_struct(real)(), sides_struct(real)()
        for side in (sides.first, sides.second):
            side.object = self._put([0], int)
        sides.counts, sides.first.nodes_a_world = wp.vec2i(1, 1), self.nodes
        law.group, law.rate = self._put([0], int), wp.zeros(self.COUNT, dtype=real, device=self.device)
        law.inertia, law.square = self._put([[0.0]], real), self._put([SQUARE], real)
        law.inner = self._put([INNER], wp.types.vector(2, real))
        for name, values in zip(NUMBERED, data["buffer"], strict=False):
            setattr(law, name, self._put(values.reshape(-1, 1, 1), real))
        pairs = self._put(np.repeat(np.arange(self.COUNT)[:, None], 2, 1), wp.vec2i)
        return [pairs, self._put([self.COUNT], int), sides, law, self._put(data[positions], self._vector(real))]

    def _factor(self, real, rows: int):
        """Return empty factors of all collisions."""
        factor = factor_struct(real)()
        factor.nodes, factor.used = self._places(), wp.zeros(self.COUNT, dtype=int, device=self.device)
        factor.row = wp.zeros((rows, self.COUNT), dtype=wp.types.vector(ROW, real), device=self.device)
        factor.bend = wp.zeros(self.COUNT, dtype=real, device=self.device)
        return factor

    def _places(self) -> wp.array:
        """Return the nodes of all collisions (E,), with the last node repeated."""
        return self._put(self.slots[np.minimum(np.arange(PAIR_NODES), self.nodes - 1)].T, wp.vec4i)

    def _parts(self, real) -> wp.array:
        return wp.zeros((PAIR_NODES, self.COUNT), dtype=self._vector(real), device=self.device)

    def _numbers(self, real) -> wp.array:
        return wp.zeros((NUMBERS, self.COUNT), dtype=real, device=self.device)

    def _vector(self, real):
        return wp.types.vector(3, real)

    def _put(self, values, dtype) -> wp.array:
        whole = dtype in (int, wp.vec2i, wp.vec4i)
        return wp.array(np.ascontiguousarray(values, np.int32 if whole else float), dtype=dtype, device=self.device)

    def _flat(self, parts) -> np.ndarray:
        """Return vectors by local node index (., E) as (3 nodes, E)."""
        values = parts if isinstance(parts, np.ndarray) else parts.numpy()
        return values[: self.nodes].astype(float).transpose(0, 2, 1).reshape(-1, self.COUNT)

    def _by_node(self, parts: wp.array) -> np.ndarray:
        return self.scatter(self._flat(parts))


class FrictionSample(ContactSample):
    """Friction of eight collisions, with normal forces of the barrier at lagged positions.

    Attributes:
        data: q, start and lagged: positions (nodes, 3) of the current state, of the start of the step, and of normal forces.
            rate (E,). buffer: parameters of the barrier, and the coefficient.
    """

    LEFT_OUT = frozenset({"gradient", "rest", "rigid", "symmetry", "factor", "exact"})
    POSITIONS = ("q", "start", "lagged")

    def __init__(self, potential: Potential, *arguments):
        self.friction = potential.density
        super().__init__(potential, *arguments)
        self.law = LAWS["barrier"]

    def random_state(self) -> dict[str, np.ndarray]:
        """Return random data; see the class."""
        random, data = np.random.default_rng(12), super().random_state()
        barrier = Potential("", self.collision, LAWS["barrier"], "")
        data["buffer"] = np.vstack(
            [random_parameters(barrier, random, self.shape), random.uniform(0.6, 1.4, self.shape)]
        )
        shape = data["q"].shape
        data["start"] = data["q"] - 0.3 * random.uniform(0.5, 1.0, shape) * np.sign(random.normal(size=shape))
        data["lagged"] = data["q"] + 0.05 * random.normal(size=shape)
        data["rate"] = random.uniform(0.6, 1.4, self.shape)
        return data

    def energy(self, real=wp.float64, **changed) -> np.ndarray:
        """Return energies (E,)."""
        return self._slid(real, **changed)[0].numpy().astype(float)

    def gradient(self, real=wp.float64, **changed) -> np.ndarray:
        """Return derivatives by the nodes (3 nodes, E)."""
        return self._flat(self._slid(real, **changed)[1])

    def hessian(self, real=wp.float64) -> np.ndarray:
        """Return F^T F, equal to psi'' for directions along the slips."""
        return self._product(self._slid(real)[2])

    def evaluate(self, exact: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F^T F (3 nodes, 3 nodes, E), gradients and energies."""
        energy, gradient, factor = self._slid(self.real)
        return self._product(factor), self._flat(gradient), energy.numpy().astype(float)

    def reverse(self, order: int, seed: np.ndarray) -> dict[str, np.ndarray]:
        """Return derivatives of v . gradient, v = `seed`, by input, in reverse mode."""
        real, device = self.real, self.device
        pairs, count, *law = self._given(real)
        used, vector = self._slid(real)[2].used, self._vector(real)
        lagged, start, w = (
            self._put(values, vector) for values in (self.data["lagged"], self.data["start"], -self.scatter(seed))
        )
        rate, (no_pair, no_four, no_vector, no_table) = self._put(self.data["rate"], real), self._nothing(real)
        no_radii = wp.zeros(0, dtype=wp.types.vector(BODIES, real), device=device)
        inputs = [1, pairs, count, *law[:2], self._places(), no_pair, no_pair, no_radii]
        inputs += [used, lagged, start, law[2], w, VELOCITY, rate]
        parts, numbers = [self._parts(real) for _ in range(3)], self._numbers(real)
        tables = [wp.zeros((0, 0), dtype=real, device=device) for _ in range(2)]
        kernel = friction_jacobian_kernel(self.collision, self.law, self.friction, real, False, False, False, False)
        inputs += [no_pair, no_table, no_four, no_vector]
        wp.launch(kernel, 1, inputs, [*parts, numbers, no_vector, *tables], device=device)
        slopes, numbers = (
            dict(zip(self.POSITIONS, map(self._by_node, parts), strict=True)),
            numbers.numpy().astype(float),
        )
        return {**slopes, "rate": numbers[RATE], "buffer": numbers[: FRICTION + 1]}

    def resultants(self) -> float:
        """Return the largest resultant force of a collision, over the largest component."""
        force = self.scatter(self.gradient()).reshape(self.nodes, -1, 3)
        return np.abs(force.sum(0)).max() / np.abs(force).max()

    def _slid(self, real, **changed) -> tuple:
        """Return energies, gradients by local node index and factors of friction."""
        data, device, vector = {**self.data, **changed}, self.device, self._vector(real)
        pairs, count, *law, x = self._given(real, "lagged", **changed)
        _, push, contact = self._evaluated(real, "lagged", **changed)
        factor, lagged, pair = self._factor(real, ROWS), lagged_struct(real)(), wp.types.vector(2, real)
        lagged.bound = wp.zeros(self.COUNT, dtype=real, device=device)
        lagged.weight = wp.zeros(self.COUNT, dtype=wp.types.vector(PAIR_NODES, real), device=device)
        lagged.tangent = wp.zeros((2, self.COUNT), dtype=vector, device=device)
        slip = [wp.zeros((2, self.COUNT), dtype=pair, device=device) for _ in range(2)]
        no_pair, no_four, no_vector, no_table = self._nothing(real)
        more, none = wp.zeros(self.COUNT, dtype=real, device=device), self._put([0], int)
        inputs = [1, pairs, count, *law, x, no_pair, no_table, no_four, no_pair, no_pair, none]
        inputs += [contact, push, 0, more, none]
        kernel = lag_kernel(self.collision, real, real, False, False, False, False)
        wp.launch(kernel, 1, inputs, [wp.zeros_like(pairs), factor, lagged, *slip], device=device)
        q, start, rate = (
            self._put(data[name], dtype) for name, dtype in (("q", vector), ("start", vector), ("rate", real))
        )
        energy, work, gradient = *(wp.zeros(self.COUNT, dtype=real, device=device) for _ in range(2)), self._parts(real)
        no_count = self._put([], int)
        inputs = [1, pairs, count, 1, lagged, VELOCITY, rate, no_count, no_count, 0, q, start, no_vector]
        kernel = friction_kernel(self.friction, real, real, False, False, False, False)
        wp.launch(kernel, 1, inputs, [*slip, factor, energy, work, gradient], device=device)
        return energy, gradient, factor

    def _nothing(self, real) -> tuple:
        """Return empty arrays for inputs of directed, spinning and rolling friction."""
        types = (wp.vec2i, wp.vec4i, self._vector(real))
        empty = [wp.zeros(0, dtype=dtype, device=self.device) for dtype in types]
        return *empty, wp.zeros((0, 0), dtype=self._vector(real), device=self.device)
