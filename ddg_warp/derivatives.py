"""The derivative table: every derivative of every term against something else that computes it.

The state is random and nothing in it is zero (see `Sample`). References are central differences, always taken in
float64, or automatic differentiation of another kernel; errors are relative to the largest reference. e are the
strains, w the rest measure and q the window of an element:

    gradient     w J^T psi' scattered to dofs = reverse mode of the energy kernel
    reverse      reverse mode of the gradient kernel, seeded with v, = differences of v . gradient in x and theta
    parameters   the same in every row of the parameter buffer, element by element
    lagged       the same in the lagged frames, the strains of the last step and 1/h
    hessian      Hessian kernel = differences of the gradient on the window
    symmetry     Hessian kernel = its transpose
    evaluate     energy and gradient of the fused kernel = sum over the terms' own kernels
    factor       F^T F + c of the chain = w J^T (d stress / dq) + max(N, 0)/|e| (I - t t^T), derivatives by differences
    definite     F^T F + c has no negative eigenvalue
    exact        F^T F + c, compression included, and the geometric stiffness = Hessian kernels of all terms
    rest         no force in the rest shape
    invariance   a rigid motion keeps the energy when the lagged data turn too, or when angles make up for the frames
    rigid        the gradient is orthogonal to translations and infinitesimal rotations
    nonzero      every dof feels a force, so that no zero passes for agreement
    downcast     energy and gradient feel a relative change of 2^-30 in every input, which no float32 can hold
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp import arrays, geometry
from ddg_warp.kernels import element
from ddg_warp.kernels.element import ChainKind
from ddg_warp.kernels.terms import REGISTRY, Term
from ddg_warp.material import Stiffness
from ddg_warp.precision import PRECISIONS
from ddg_warp.scene import Scene

TRAP = 2.0**-30


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
        flags = [wp.zeros(2, dtype=int, device=self.device) for _ in range(4)]
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
            before=[*flags[:2], clamped, flags[0], 0],
            after=flags[2:],
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
        """Central difference of function(**data) along data[name][where]."""
        ends = []
        for h in (1e-5, -1e-5):
            values = self.data[name].copy()
            values[where] += h
            ends.append(function(**{name: values}))
        return (ends[0] - ends[1]) / 2e-5

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
            if _is_vector(term):
                rows = buffer[first + 1 : first + len(term.parameter_names)].reshape(-1, 3, *self.shape)
                rows[:] = rows[:, :1]
                rows[1] = 0.0
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
        t = geometry.unit(self.edges())
        turned_u, turned_t = geometry.transport(u0, t0, t) @ turn.T, t @ turn.T
        return geometry.signed_angle(geometry.transport(u0, t0, turned_t), turned_u, turned_t)

    def rotations(self):
        """Infinitesimal rotations: velocities of dofs (n, R, dofs of a node), and of the strains of the last step."""
        dim, x, edges = self.kind.dim, self.data["x"], self.edges()
        for omega in np.eye(3) if dim == 3 else [np.array([0.0, 0.0, 1.0])]:
            spin = np.cross(omega, np.eye(3), axisb=0, axisc=0)[:dim, :dim]
            velocity = np.zeros((*self.shape, self.kind.block))
            velocity[..., :dim] = x @ spin.T
            if self.kind.twist:
                t, t0 = geometry.unit(edges), np.moveaxis(self.data["frame"][3:6], 0, -1)
                z = np.cross(t0, t) / (1.0 + np.sum(t0 * t, -1, keepdims=True))
                velocity[..., dim] = t @ omega + np.sum(z * (edges @ spin.T), -1) / np.linalg.norm(edges, axis=-1)
            last = np.zeros_like(self.data["last"])
            for rows in self._vector_strains():
                last[rows] = np.einsum("ij,jnr->inr", spin, self.data["last"][rows])
            yield velocity, last

    def _vector_strains(self) -> list[slice]:
        places = zip(self.kind.terms, self.kind.places(), strict=True)
        return [slice(row, row + 3) for term, (*_, row) in places if _is_vector(term)]

    def _kernels(self, index: int, real):
        return element.term_kernels(self.kind, index, real)

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

    def _launch(self, kernel, real, shapes, before=(), after=(), columns=(), **changed) -> list[np.ndarray]:
        out = [wp.zeros(shape, dtype=real, device=self.device) for shape in shapes]
        inputs = [*self._inputs(real, **changed), *before]
        outputs, grid = [*out, *after], (*self.shape, *columns)
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
        t = geometry.unit(sample.edges(x))
        aside = geometry.unit(np.cross(t, random.normal(size=t.shape)))
        t0 = t * np.cos(np.radians(25.0)) + aside * np.sin(np.radians(25.0))
        u0 = geometry.unit(np.cross(t0, random.normal(size=t.shape)))
        u = geometry.transport(u0, t0, t)
        ahead = sample.node(1), sample.column
        twist = geometry.signed_angle(geometry.transport(u, t, t[ahead]), u[ahead], t[ahead])
        turns = 2.0 * np.pi * random.integers(-2, 3, size=twist.shape)
        frame[:6] = np.moveaxis(np.concatenate([u0, t0], -1), -1, 0)
        frame[6] = twist + turns + 0.3 * random.normal(size=twist.shape)
    rows, last = [], []
    for term in kind.terms:
        about = 1.0 if term.measure.span == 1 else 0.0  # a stretch is 1 at rest
        for name in term.parameter_names:
            value = random.uniform(0.6, 1.4, size=(n, rods))
            rows.append(about + 0.4 * random.normal(size=(n, rods)) if name.startswith("rest") else value)
        last += [about + 0.4 * random.normal(size=(n, rods)) for _ in term.measure.strains]
    return {
        "x": x,
        "theta": random.normal(size=(n, rods)),
        "frame": frame,
        "last": np.array(last),
        "rate": random.uniform(0.6, 1.4, size=rods),
        "buffer": np.array(rows),
    }


def _is_vector(term: Term) -> bool:
    """Whether the strains are components of a vector in space, which turns with the rod."""
    return term.measure.name == "curvature_binormal"


def _rotation(dim: int, angle: float) -> np.ndarray:
    """A rotation matrix (dim, dim)."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0 if dim == 3 else np.array([0.0, 0.0, 1.0])
    spin = np.cross(axis, np.eye(3), axisb=0, axisc=0)
    return (np.eye(3) + np.sin(angle) * spin + (1.0 - np.cos(angle)) * spin @ spin)[:dim, :dim]


def chain_of(term: Term, closed: bool) -> ChainKind:
    """The chain that a rod with this term is: bending first, then stretch, both damped or neither."""
    suffix = "_damped" if term.density.lagged else ""
    bending = term.name.removesuffix(suffix)
    if term.measure.span == 1:
        bending = "planar_bend" if term.measure.dim == 2 else "rod_bend_twist"
    stretch = "planar_stretch" if term.measure.dim == 2 else "rod_stretch"
    terms = REGISTRY[bending + suffix], REGISTRY[stretch + suffix]
    return ChainKind(term.measure.dim, terms[0].measure.angles > 0, closed, terms)


def _rest_scene(term: Term, kind: ChainKind) -> Scene:
    """A rod of that kind, at rest in a random shape; straight where the measure knows no other."""
    random = np.random.default_rng(5)
    angle = np.linspace(0.0, 2.0 * np.pi, 7)[:-1, None]
    points = np.concatenate([np.cos(angle), np.sin(angle), np.sin(angle)], -1) + 0.1 * random.normal(size=(6, 3))
    if any(map(_is_vector, kind.terms)):
        points = np.cumsum(random.uniform(0.5, 1.5, size=(6, 1)), axis=0) * random.normal(size=3)
    bending = 0.7 if kind.twist else 0.9
    viscosity = 0.4 if term.density.lagged else 0.0
    section = Stiffness(EA=2.0, EI1=0.9, EI2=bending, GJ=0.8, mass_per_length=1.0, viscosity=viscosity)
    scene = Scene(dimension=kind.dim)
    scene.add_rod(points, section=section, closed=kind.closed, natural="shape", twist=kind.twist)
    return scene


@dataclass
class Case:
    """A term in a chain, at a sample state, in one precision."""

    term: Term
    kind: ChainKind
    precision: str
    device: str

    @property
    def real(self):
        """The scalar type under test."""
        return PRECISIONS[self.precision].real

    @property
    def index(self) -> int:
        """Place of the term in its chain."""
        return self.kind.terms.index(self.term)

    @cached_property
    def sample(self) -> Sample:
        """The random state."""
        return Sample(self.kind, self.device, exact_in_float32=self.real == wp.float32)

    @cached_property
    def seed(self) -> np.ndarray:
        """Weights v of the window gradient (window, n, R)."""
        return np.random.default_rng(7).normal(size=(self.kind.window, *self.sample.shape))

    @cached_property
    def gradient(self) -> np.ndarray:
        """Window gradient (window, n, R) in the precision under test."""
        return self.sample.gradient(self.index, self.real)

    @cached_property
    def reverse(self) -> dict[str, np.ndarray]:
        """Reverse mode of v . gradient."""
        return self.sample.reverse(self.index, 1, self.seed, self.real)

    @cached_property
    def gradient_derivative(self) -> np.ndarray:
        """Differences of the window gradient (window, window, n, R)."""
        return self.sample.window_derivative(lambda **data: self.sample.gradient(self.index, **data))

    def difference(self, name: str, where) -> np.ndarray:
        """Differences of v . gradient of every element (n, R) along data[name][where]."""
        return self.sample.difference(
            lambda **data: (self.seed * self.sample.gradient(self.index, **data)).sum(0), name, where
        )


def relative(value, reference) -> float:
    """Largest difference over the largest reference."""
    return float(np.abs(value - reference).max() / np.abs(reference).max())


def gradient(case: Case) -> float:
    sample = case.sample
    adjoint = sample.reverse(case.index, 0, np.ones(sample.shape), case.real)
    scattered = sample.scatter(case.gradient)
    return relative(scattered, np.concatenate([adjoint["x"], adjoint["theta"][..., None]], -1)[..., : case.kind.block])


def reverse(case: Case) -> float:
    product = np.einsum("inr,ijnr->jnr", case.seed, case.gradient_derivative)
    adjoint = np.concatenate([case.reverse["x"], case.reverse["theta"][..., None]], -1)[..., : case.kind.block]
    return relative(adjoint, case.sample.scatter(product))


def parameters(case: Case) -> float:
    first = case.kind.places()[case.index][0]
    return max(
        relative(case.reverse["buffer"][row], case.difference("buffer", (row,)))
        for row in range(first, first + len(case.term.parameter_names))
    )


def lagged(case: Case) -> float:
    errors = [0.0]
    if case.term.measure.lag_size:
        expected = np.zeros((7, *case.sample.shape))
        for c, k in np.ndindex(7, case.sample.shape[0]):
            expected[c, k] = case.difference("frame", (c, k)).sum(0)
        errors.append(relative(case.reverse["frame"], expected))
    if case.term.density.lagged:
        first = case.kind.places()[case.index][3]
        for row in range(first, first + len(case.term.measure.strains)):
            errors.append(relative(case.reverse["last"][row], case.difference("last", (row,))))
        errors.append(relative(case.reverse["rate"], case.difference("rate", ...).sum(0)))
    return max(errors)


def hessian(case: Case) -> float:
    return relative(case.sample.hessian(case.index, case.real), case.gradient_derivative)


def symmetry(case: Case) -> float:
    value = case.sample.hessian(case.index, case.real)
    return relative(value, value.swapaxes(0, 1))


def evaluate(case: Case) -> float:
    sample, terms = case.sample, range(len(case.kind.terms))
    _, force, energy, _ = sample.evaluate(case.real)
    return max(
        relative(force, sum(sample.gradient(i) for i in terms)), relative(energy, sum(sample.energy(i) for i in terms))
    )


def factor(case: Case) -> float:
    sample, kind = case.sample, case.kind
    strain_rate, stress_rate = (
        sample.window_derivative(lambda i=i, **data: sample.strains(**data)[i]) for i in range(2)
    )
    stress = sample.strains()[1]
    expected = np.zeros((kind.window, kind.window, *sample.shape))
    for term, (first, *_, row) in zip(kind.terms, kind.places(), strict=True):
        rows = slice(row, row + len(term.measure.strains))
        w = sample.data["buffer"][first]
        expected += w * np.einsum("minr,mjnr->ijnr", strain_rate[rows], stress_rate[rows])
        if term.measure.tensions:
            edge = np.moveaxis(sample.edges(), -1, 0)
            length = np.linalg.norm(edge, axis=0)
            across = np.eye(kind.dim)[..., None, None] - edge * edge[:, None] / length**2
            expected[: kind.dim, : kind.dim] += np.maximum(stress[row], 0.0) / length * across
    return relative(_gauss_newton(case), expected)


def definite(case: Case) -> float:
    values = np.linalg.eigvalsh(np.moveaxis(_gauss_newton(case), (0, 1), (-2, -1)))
    return float(max(0.0, -values.min()) / values.max())


def exact(case: Case) -> float:
    expected = sum(case.sample.hessian(i, wp.float64) for i in range(len(case.kind.terms)))
    return relative(_gauss_newton(case, exact=True), expected)


def rest(case: Case) -> float:
    model = _rest_scene(case.term, case.kind).build(device=case.device, precision=case.precision)
    group, data = model.groups[0], model.state().groups[0]
    out = arrays.allocate((group.kind.window, group.nodes, group.columns), case.real, case.device)
    still = wp.full(group.columns, 1.0, dtype=case.real, device=case.device)
    wp.launch(
        element.term_kernels(group.kind, group.kind.terms.index(case.term), case.real)[1],
        (group.elements, group.columns),
        [data.x, data.theta, data.frame, data.last, still, group.buffer, group.table, group.count],
        [out],
        device=case.device,
    )
    return float(np.abs(arrays.download(out)).max())  # moduli and lengths of the scene are of order one


def invariance(case: Case) -> float:
    sample = case.sample.isotropic()
    turn = _rotation(case.kind.dim, 0.4)
    moved = sample.turned(turn)
    before = sample.energy(case.index, case.real).sum()
    errors = [relative(sample.energy(case.index, case.real, **moved).sum(), before)]
    if case.kind.twist:
        # lagged frames stay, angles make up for what the transport turns them differently
        angles = sample.data["theta"] + sample.frame_lead(turn)
        kept = {"x": moved["x"], "theta": angles}
        errors.append(relative(sample.energy(case.index, case.real, **kept).sum(), before))
    return max(errors)


def rigid(case: Case) -> float:
    sample = case.sample.isotropic()
    force = sample.scatter(sample.gradient(case.index, case.real))
    adjoint = sample.reverse(case.index, 0, np.ones(sample.shape), case.real)
    worst = np.abs(force[..., : case.kind.dim].sum(0)).max() / np.abs(force).max()
    for velocity, last in sample.rotations():
        work = (force * velocity).sum() + (adjoint["last"] * last).sum()
        size = np.abs(force * velocity).sum() + np.abs(adjoint["last"] * last).sum()
        worst = max(worst, abs(work) / size)
    return float(worst)


def nonzero(case: Case) -> float:
    """Share of the dofs without a force."""
    size = np.abs(case.sample.scatter(case.gradient))
    used = np.arange(case.kind.block) < (case.kind.dim if not case.term.measure.angles else case.kind.block)
    felt = size[..., used] > 1e-6 * size.max()
    return float(1.0 - felt[case.sample.has_dof[..., : case.kind.block][..., used]].mean())


def downcast(case: Case) -> float:
    sample, worst = case.sample, 0.0
    for which, seed in enumerate((np.ones(sample.shape), case.seed)):
        value = (sample.energy, sample.gradient)[which]
        adjoint = sample.reverse(case.index, which, seed, case.real)
        before = value(case.index)
        for name, values in sample.data.items():
            slope = adjoint[name] * values
            for row in range(len(values)) if name in ("buffer", "last") else [...]:
                size = np.abs(slope[row]).sum()
                if size == 0.0:
                    continue  # not an input of this term
                scaled = values.copy()
                scaled[row] *= 1.0 + TRAP
                change = (seed * (value(case.index, **{name: scaled}) - before)).sum()
                worst = max(worst, abs(change - TRAP * slope[row].sum()) / (TRAP * size))
    return worst


# name -> (error, tolerance in float64, tolerance in float32 or None where that says nothing)
CHECKS = {
    "gradient": (gradient, 1e-13, 1e-5),
    "reverse": (reverse, 1e-8, 1e-5),
    "parameters": (parameters, 1e-8, 1e-5),
    "lagged": (lagged, 1e-8, 1e-5),
    "hessian": (hessian, 1e-8, 1e-5),
    "symmetry": (symmetry, 1e-12, 1e-5),
    "evaluate": (evaluate, 1e-13, 1e-5),
    "factor": (factor, 1e-8, 1e-5),
    "definite": (definite, 1e-14, 1e-6),
    "exact": (exact, 1e-14, 1e-5),
    "rest": (rest, 1e-13, 1e-5),
    "invariance": (invariance, 1e-13, 1e-5),
    "rigid": (rigid, 1e-13, 1e-5),
    "nonzero": (nonzero, 0.0, 0.0),
    "downcast": (downcast, 1e-3, None),
}


def checks_of(term: Term, closed: bool, precision: str) -> list[str]:
    """Checks that make sense: a rod that is straight at rest has no rest shape when closed."""
    straight = term.measure.name == "curvature_binormal"
    return [
        name
        for name, (_, _, single) in CHECKS.items()
        if not (name == "rest" and straight and closed) and not (precision == "float32" and single is None)
    ]


def table(term: str | None = None, precision: str = "float64", device: str = "cpu") -> list[dict]:
    """Rows of the derivative table: term, chain, check, error, tolerance, passed.

    Args:
        term: name of one term of chains or nets; all of them by default.
        precision: "float64" or "float32", that of the kernels under test.
        device: Warp device.
    """
    from ddg_warp import net_derivatives

    rows = []
    for name in [term] if term else [*REGISTRY, *net_derivatives.TERMS]:
        if name in net_derivatives.TERMS:
            case = net_derivatives.NetCase(net_derivatives.TERMS[name], precision, device)
            rows += [_row(name, "net", check, one(case), precision) for check, one in net_derivatives.CHECKS.items()]
            continue
        for closed in (False, True):
            case = Case(REGISTRY[name], chain_of(REGISTRY[name], closed), precision, device)
            for check in checks_of(case.term, closed, precision):
                rows.append(_row(name, "closed" if closed else "open", check, CHECKS[check][0](case), precision))
    return [row for row in rows if row["tolerance"] is not None]


def _row(term: str, chain: str, check: str, error: float, precision: str) -> dict:
    tolerance = CHECKS[check][1 if precision == "float64" else 2]
    passed = tolerance is not None and bool(error <= tolerance)
    return {"term": term, "chain": chain, "check": check, "error": error, "tolerance": tolerance, "passed": passed}


def _gauss_newton(case: Case, exact: bool = False) -> np.ndarray:
    """F^T F + c, or the exact matrix, on the windows (window, window, n, R), from what the evaluate kernel writes."""
    kind = case.kind
    rows, _, _, geometric = case.sample.evaluate(case.real, exact)
    edge_row, tension_row = kind.vertex_strains * kind.window, kind.factor_rows - kind.tensions
    vertex = rows[:edge_row].reshape(kind.vertex_strains, kind.window, *case.sample.shape)
    edge = rows[edge_row:tension_row].reshape(kind.edge_strains, kind.dim, *case.sample.shape)
    result = np.einsum("minr,mjnr->ijnr", vertex, vertex)
    result[: kind.dim, : kind.dim] += np.einsum("minr,mjnr->ijnr", edge, edge)
    result[: kind.dim, : kind.dim] += np.eye(kind.dim)[..., None, None] * rows[tension_row:].sum(0)
    if exact:
        i, j = np.triu_indices(kind.window)
        result[i, j] += geometric
        result[j[i != j], i[i != j]] += geometric[i != j]
    return result
