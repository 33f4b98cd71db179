"""The derivative table of the terms of nets: shells, shells of revolution, rigid joints, glued edges, magnets.
`ddg_warp.run.derivatives` says what the checks mean.

Every element of the sample has blocks of its own, so that a change of one block is seen by one element alone:

    hessian      B^T H B with H the local Hessian and B from blocks to local dofs = differences of the gradient
    factor       F^T F + C = w (de/dq)^T (ds/dq) + the positive part of the geometric stiffness, derivatives by differences
    exact        of measures with second derivatives: F^T F + C + these = the Hessian
    invariance   a rotation of blocks, frames and prescribed normals keeps the energy; of shells of revolution, a shift along the axis
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp.compile.precision import PRECISIONS
from ddg_warp.geometry.polyline import signed_angle, transport, unit
from ddg_warp.kernels.densities.dipole import dipole_dipole
from ddg_warp.kernels.islands import Islands
from ddg_warp.kernels.net import elements as net_elements
from ddg_warp.kernels.terms import AXISYMMETRIC, GLUE, JOINTS, MAGNETS, SHELLS, Term
from ddg_warp.run.derivatives import raised
from ddg_warp.run.samples import rotation

ELEMENTS = 8
TRAP = 2.0**-30
INPUTS = ("q", "frame", "lag", "last", "rate", "buffer")
TERMS = {**SHELLS, **AXISYMMETRIC, **JOINTS, GLUE.name: GLUE, **MAGNETS}
KINDS = np.array([[0, 1, 2], [1, 2, 3], [2, 3, 0], [3, 0, 1], [1, 1, 1], [0, 1, 1], [1, 3, 1], [1, 2, 0]])  # of edges


class NetSample:
    """Elements of one term at a random state: every edge of a triangle of every kind, frames that are old, parameters of their own.

    Attributes:
        data: inputs of the kernels by name: q (N, 3), frame, lag, last, rate, buffer (rows, E), constants (d, E).
        slots: blocks of each element (slots, E).
    """

    def __init__(self, term: Term, device: str, exact_in_float32: bool, data: dict | None = None):
        self.term, self.measure, self.device = term, term.measure, device
        self.exact_in_float32 = exact_in_float32
        count = self.measure.slots * ELEMENTS
        self.slots = np.arange(count).reshape(-1, ELEMENTS)  # nodes of all elements first, then angles, then spins
        self.angle_start = self.measure.nodes * ELEMENTS
        self.data = data or _random_state(self)
        if exact_in_float32:
            self.data = {name: values.astype(np.float32).astype(float) for name, values in self.data.items()}

    def energy(self, real=wp.float64, **changed) -> np.ndarray:
        """Energies (E,)."""
        return self._launch(0, real, [(ELEMENTS,)], **changed)[0]

    def gradient(self, real=wp.float64, **changed) -> np.ndarray:
        """Derivatives by the blocks of an element (slots, E, 3)."""
        return self._launch(1, real, [(self.measure.slots, ELEMENTS)], vectors=True, **changed)[0]

    def hessian(self, real) -> np.ndarray:
        """Hessians in the blocks of an element (3 slots, 3 slots, E)."""
        size = self.measure.size
        none = wp.zeros((len(self.measure.strains), ELEMENTS), dtype=real, device=self.device)
        local = self._launch(2, real, [(ELEMENTS, size, size)], extra=(none,), columns=(size,))[0]
        return np.einsum("ia,eij,jb->abe", self.incidence, local, self.incidence)

    def strains(self, **changed) -> tuple[np.ndarray, np.ndarray]:
        """Strains and stresses (n, E)."""
        shapes = [(len(self.measure.strains), ELEMENTS)] * 2
        return tuple(self._launch(3, wp.float64, shapes, extra=(1,), **changed))

    def evaluate(self, real, exact: bool = False) -> tuple[np.ndarray, ...]:
        """Factor (n, 3 slots, E), geometric stiffness (tensions, E), second derivatives (packed, E), gradient (slots, E, 3) and
        energy (E,) of the fused kernel; `exact` asks for the third, with compression in the second.
        """
        n, slots = len(self.measure.strains), self.measure.slots
        vector = wp.types.vector(3, real)

        def zeros(*shape, dtype=real):
            return wp.zeros(shape, dtype=dtype, device=self.device)

        out = [
            zeros(n * slots, ELEMENTS, dtype=vector),
            zeros(max(1, self.measure.tensions), ELEMENTS),
            zeros(max(1, self.measure.packed), ELEMENTS),
            zeros(slots, ELEMENTS, dtype=vector),
            zeros(2, ELEMENTS),
            zeros(ELEMENTS),
        ]
        search = Islands(1, real, self.device)
        search.clamped.fill_(0 if exact else 1)
        kernel = net_elements.evaluate_kernel(self.term, real, real, 0 if exact else None)
        wp.launch(kernel, ELEMENTS, [self._elements(real), *search.arrays], out, device=self.device)
        factor, tension, second, gradient, energy = (array.numpy().astype(float) for array in out[:5])
        rows = factor.reshape(n, slots, ELEMENTS, 3).transpose(0, 1, 3, 2).reshape(n, 3 * slots, ELEMENTS)
        return rows, tension[: self.measure.tensions], second, gradient, energy[1]

    def reverse(self, which: int, seed: np.ndarray, real) -> dict[str, np.ndarray]:
        """Reverse mode of the energy (which = 0) or gradient (1) kernel, by input."""
        given = self._elements(real)
        dtype = wp.types.vector(3, real) if which else real
        seeds = wp.array(np.ascontiguousarray(seed), dtype=dtype, device=self.device)
        wp.launch(
            net_elements.term_kernels(self.term, real, reverse=True)[which],
            ELEMENTS,
            [given],
            [wp.zeros_like(seeds, requires_grad=True)],
            adjoint=True,
            adj_inputs=[net_elements.elements_type(real)()],
            adj_outputs=[seeds],
            device=self.device,
        )
        values = {name: getattr(given, name).grad.numpy().astype(float) for name in INPUTS}
        return {name: v.reshape(self.data[name].shape) for name, v in values.items()}

    def difference(self, function, name: str, where) -> np.ndarray:
        """Central difference of fourth order of function(**data) along data[name][where]."""
        h, ends = 2e-4, []
        for steps in (1, -1, 2, -2):
            values = self.data[name].copy()
            values[where] += steps * h
            ends.append(function(**{name: values}))
        return (8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12.0 * h)

    def block_derivative(self, function) -> np.ndarray:
        """Derivative of what function(**data) gives per element (m, E), by its blocks (m, 3 slots, E)."""
        columns = [self.difference(function, "q", (row, d)) for row in self.slots for d in range(3)]
        return np.stack(columns, axis=1)

    @cached_property
    def incidence(self) -> np.ndarray:
        """Matrix from the blocks of an element to its local dofs (size, 3 slots)."""
        measure = self.measure
        matrix = np.zeros((measure.size, 3 * measure.slots))
        for i, (a, b) in enumerate(measure.edges):
            for d in range(3):
                matrix[3 * i + d, [3 * a + d, 3 * b + d]] = -1.0, 1.0
        first = 3 * len(measure.edges)
        for i in range(measure.angles):
            matrix[first + i, 3 * (measure.nodes + i)] = 1.0
        for i in range(3 * measure.spins):
            matrix[first + measure.angles + i, 3 * (measure.nodes + measure.angles) + i] = 1.0
        for i in range(3 * measure.points):
            matrix[first + measure.angles + 3 * measure.spins + i, i] = 1.0
        return matrix

    @property
    def revolved(self) -> bool:
        """Whether the element is of a meridian, whose place across the axis is a strain."""
        return self.measure.name.startswith("axisymmetric")

    def felt(self) -> np.ndarray:
        """Which dofs the energy depends on (slots, E, 3)."""
        measure = self.measure
        used = np.ones((measure.slots, ELEMENTS, 3), bool)
        used[measure.nodes : measure.nodes + measure.angles, :, 1:] = False
        if self.revolved:
            used[..., 1] = False  # y of a meridian
        if measure.name.startswith("midedge"):
            kinds = self.data["constants"][:3]
            used[3:6] = (kinds == 1)[..., None]  # a corner behind an edge is read if it is a neighbour's
            if measure.angles:
                used[6:9, :, 0] = kinds <= 1
        if measure.name == "rod_surface_angle":
            share, sign = self.data["constants"]
            used[3], used[5, :, 0] = (share > 0.0)[:, None], sign != 0.0
        return used

    def turned(self, turn: np.ndarray) -> dict[str, np.ndarray]:
        """All inputs after a rotation, or of a meridian after a shift along the axis."""
        measure, data = self.measure, {name: values.copy() for name, values in self.data.items()}
        if self.revolved:
            data["q"][:, 1:] += 0.4
            return data
        vectors = [slice(0, self.angle_start)]
        if measure.spins:
            vectors.append(slice(self.angle_start + measure.angles * ELEMENTS, None))
        for where in vectors:
            data["q"][where] = self.data["q"][where] @ turn.T
        rows = {"frame": (0, 3) if measure.frames else (), "lag": (0, 3) if measure.spins else ()}
        rows["constants"] = {"edge_tilt": (1,)}.get(
            measure.name, (3, 6, 9) if measure.name.startswith("midedge") else ()
        )
        rows["last"] = (0,) if measure.name == "isometric_bending" and self.term.density.lagged else ()
        if measure.field:
            first = measure.data_size - measure.field
            rows["constants"] = (first,)
            gradient = data["constants"][first + 3 :].reshape(3, 3, -1)
            data["constants"][first + 3 :] = np.einsum("ia,abe,jb->ije", turn, gradient, turn).reshape(9, -1)
        for name, starts in rows.items():
            for at in starts:
                data[name][at : at + 3] = turn @ data[name][at : at + 3]
        return data

    def isotropic(self) -> "NetSample":
        """This sample, with equal stiffness and no rest strain where strains are components of a vector in space."""
        if self.measure.name != "isometric_bending":
            return self
        buffer = self.data["buffer"].copy()
        for row, parameter in enumerate(self.term.parameters):
            if parameter.family == "rest":
                buffer[row] = 0.0
            elif parameter.number:
                buffer[row] = buffer[self.term.parameter_names.index(f"{parameter.family}_1")]
        return NetSample(self.term, self.device, self.exact_in_float32, {**self.data, "buffer": buffer})

    def _elements(self, real, **changed):
        """What kernels read; see `kernels.net.elements.elements_type`."""
        data, given = {**self.data, **changed}, net_elements.elements_type(real)()

        def put(values, dtype):
            return wp.array(
                np.ascontiguousarray(values), dtype=dtype, device=self.device, requires_grad=dtype is not int
            )

        for name in INPUTS:
            values = data[name].ravel() if name == "buffer" else data[name]
            setattr(given, name, put(values, wp.types.vector(3, real) if name == "q" else real))
        given.table = put(np.array([(row * ELEMENTS, 1, 0) for row in range(len(data["buffer"]))], np.int32), int)
        given.slots, given.data = put(self.slots.astype(np.int32), int), put(data["constants"], real)
        given.blocks, given.angle_start, given.elements = self.slots.size, self.angle_start, ELEMENTS
        return given

    def _launch(self, which: int, real, shapes, vectors=False, columns=(), extra=(), **changed) -> list[np.ndarray]:
        dtype = wp.types.vector(3, real) if vectors else real
        out = [wp.zeros(shape, dtype=dtype, device=self.device) for shape in shapes]
        kernel = net_elements.term_kernels(self.term, real, reverse=True)[which]
        wp.launch(kernel, (ELEMENTS, *columns), [self._elements(real, **changed), *extra], out, device=self.device)
        return [array.numpy().astype(float) for array in out]


def _random_state(sample: NetSample) -> dict[str, np.ndarray]:
    """See `NetSample`."""
    random, measure = np.random.default_rng(11), sample.measure
    corners = np.array(
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.4, 0.9, 0.0], [1.3, 1.1, 0.3], [-0.7, 0.6, 0.3], [0.5, -0.8, 0.3]]
    )
    if measure.name in ("hinge_angle", "isometric_bending", "rod_surface_angle"):
        corners = corners[[0, 1, 2, 5]]
    if sample.revolved:
        corners = np.array([[2.0, 0.1, 0.5], [3.0, 0.4, -0.2], [3.8, 0.6, 0.7]])
    q = 0.4 * random.normal(size=(sample.slots.size, 3))
    place = np.repeat(corners[: measure.nodes], ELEMENTS, axis=0)
    q[: sample.angle_start] = place + 0.05 * random.normal(size=place.shape)
    q[sample.angle_start : sample.angle_start + measure.angles * ELEMENTS, 1:] = 0.0
    data = {"q": q, "frame": np.zeros((6, 1)), "lag": np.zeros((1, 1)), "last": np.zeros((1, 1))}
    data["rate"] = random.uniform(0.6, 1.4, size=1)
    normals = unit(np.array([0.2, -0.1, 1.0]) + 0.2 * random.normal(size=(3, ELEMENTS, 3)))
    constants = random.uniform(0.5, 1.5, size=(max(1, measure.data_size), ELEMENTS))
    if measure.name.startswith("midedge"):
        # the plane of a symmetry contains the normal, more or less; a clamp prescribes it
        normals = np.where((KINDS.T == 3)[..., None], unit(normals[..., [2, 0, 1]]), normals)
        constants[:12] = np.concatenate([KINDS.T, normals.transpose(0, 2, 1).reshape(9, ELEMENTS)])
        constants[12:] = np.sign(random.normal(size=constants[12:].shape))
    if measure.name == "axisymmetric_rim":
        angle = random.uniform(0.0, 0.3, ELEMENTS)
        constants[[0, 2]] = np.cos(angle), np.sin(angle)
    if measure.name == "edge_tilt":
        constants[0] = np.where(np.arange(ELEMENTS) % 2, 3, 2)
        constants[1:] = np.where(constants[0] == 3, normals[0][:, [2, 0, 1]].T, normals[0].T)
    if measure.name == "rod_surface_angle":
        constants[:] = random.uniform(0.2, 0.8, ELEMENTS), np.arange(ELEMENTS) % 3 - 1.0
        constants[0, ELEMENTS // 2] = 0.0  # one triangle
        x = q[sample.slots[:4]]
        e, sides = x[1] - x[0], x[2:] - x[0]
        t0 = unit(unit(e) + 0.3 * random.normal(size=e.shape))
        u0 = unit(np.cross(t0, random.normal(size=e.shape)))
        u = np.broadcast_to(transport(u0, t0, unit(e)), sides.shape)
        data["frame"] = np.concatenate([u0, t0], axis=1).T
        turns = 2.0 * np.pi * random.integers(-2, 3, size=(2, ELEMENTS))
        data["lag"] = signed_angle(u, sides, unit(e)) + turns + 0.3 * random.normal(size=turns.shape)
    if sample.term.name in MAGNETS:
        constants[:] = random.normal(size=constants.shape)
        frames = []
        for a, b in measure.edges[: measure.frames]:  # some 20 degrees away
            t = unit(unit(q[sample.slots[b]] - q[sample.slots[a]]) + 0.3 * random.normal(size=(ELEMENTS, 3)))
            frames.append(np.concatenate([unit(np.cross(t, random.normal(size=t.shape))).T, t.T]))
        data["frame"] = np.concatenate(frames, axis=1) if frames else data["frame"]
    if measure.spins:
        constants[0] = np.where(np.arange(ELEMENTS) % 2, 1.0, -1.0)
        tangent = unit(q[sample.slots[1]] - q[sample.slots[0]])
        frames = []
        for sign in (
            constants[0][:, None],
            1.0,
        ):  # of the edge, as its rod runs, and of the ghost; some 20 degrees away
            t = unit(sign * (tangent + 0.3 * random.normal(size=tangent.shape)))
            frames.append(np.concatenate([unit(np.cross(t, random.normal(size=t.shape))).T, t.T]))
        data["frame"] = frames[0]
        data["lag"] = np.concatenate([frames[1], 6.0 * random.normal(size=(1, ELEMENTS))])
    data["constants"] = constants
    rows = {name: random.uniform(0.6, 1.4, size=ELEMENTS) for name in sample.term.parameter_names}
    for name in sample.term.rest:
        rows[name] = 0.4 * random.normal(size=ELEMENTS)
    for name, low, high in (("poisson", 0.1, 0.4), ("metric_12", 0.1, 0.3)):
        if name in rows:
            rows[name] = random.uniform(low, high, size=ELEMENTS)
    data["buffer"] = np.array(list(rows.values()))
    if sample.term.density.lagged:
        data["last"] = 0.4 * random.normal(size=(len(measure.strains), ELEMENTS))
    return data


@dataclass
class NetCase:
    """A term at its sample state, in one precision."""

    term: Term
    precision: str
    device: str

    @property
    def real(self):
        """The scalar type under test."""
        return PRECISIONS[self.precision].real

    @cached_property
    def sample(self) -> NetSample:
        """The random state."""
        return NetSample(self.term, self.device, exact_in_float32=self.real == wp.float32)

    @cached_property
    def seed(self) -> np.ndarray:
        """Weights v of the gradient (slots, E, 3)."""
        return np.random.default_rng(7).normal(size=(*self.sample.slots.shape, 3))

    @cached_property
    def reverse(self) -> dict[str, np.ndarray]:
        """Reverse mode of v . gradient."""
        return self.sample.reverse(1, self.seed, self.real)

    def difference(self, name: str, where) -> np.ndarray:
        """Differences of v . gradient of every element (E,) along data[name][where]."""
        return self.sample.difference(
            lambda **data: (self.seed * self.sample.gradient(**data)).sum((0, 2)), name, where
        )

    @cached_property
    def gradient_derivative(self) -> np.ndarray:
        """Differences of the gradient (3 slots, 3 slots, E)."""
        return self.sample.block_derivative(lambda **data: _flat(self.sample.gradient(**data)))


def gradient(case: NetCase) -> float:
    sample = case.sample
    adjoint = sample.reverse(0, np.ones(ELEMENTS), case.real)["q"]
    return _relative(sample.gradient(case.real), adjoint[sample.slots])


def reverse(case: NetCase) -> float:
    product = np.einsum("ae,abe->be", _flat(case.seed), case.gradient_derivative)
    return _relative(_flat(case.reverse["q"][case.sample.slots]), product)


def parameters(case: NetCase) -> float:
    rows = range(len(case.term.parameter_names))
    return max(_relative(case.reverse["buffer"][row], case.difference("buffer", (row,))) for row in rows)


def lagged(case: NetCase) -> float:
    measure = case.term.measure
    names = ["frame"] * (measure.frames > 0) + ["lag"] * measure.spins  # of glue those only say which turn it is
    names += ["last"] if case.term.density.lagged else []
    errors = []
    for name in names:
        rows, columns = case.sample.data[name].shape
        for first in range(0, columns, ELEMENTS):  # one frame of every element
            there = slice(first, first + ELEMENTS)
            expected = [case.difference(name, (row, there)) for row in range(rows)]
            errors.append(_relative(case.reverse[name][:, there], np.array(expected)))
    if case.term.density.lagged:
        errors.append(_relative(case.reverse["rate"], case.difference("rate", ...).sum()))
    return max(errors, default=0.0)


def hessian(case: NetCase) -> float:
    return _relative(case.sample.hessian(case.real), case.gradient_derivative)


def symmetry(case: NetCase) -> float:
    value = case.sample.hessian(case.real)
    return _relative(value, value.swapaxes(0, 1))


def evaluate(case: NetCase) -> float:
    *_, force, energy = case.sample.evaluate(case.real)
    return max(_relative(force, case.sample.gradient()), _relative(energy, case.sample.energy()))


def factor(case: NetCase) -> float:
    sample, measure = case.sample, case.term.measure
    strain_rate, stress_rate = (
        sample.block_derivative(lambda i=i, **data: sample.strains(**data)[i]) for i in range(2)
    )
    w, (strain, stress) = sample.data["buffer"][0], sample.strains()
    if measure.field:  # of a direction n in a field -s what is positive of the curvature along the sphere, -n . s
        aligned = np.maximum(0.0, -(strain[:3] * stress[:3]).sum(0)) * (np.arange(6) < 3)[:, None]
        stress_rate = aligned[:, None] * strain_rate
    if case.term.density is dipole_dipole:
        stress_rate = raised(strain_rate, stress_rate)
    expected = w * np.einsum("mae,mbe->abe", strain_rate, stress_rate)
    if measure.tensions == 1:
        expected += _on_edges(sample, (w * np.maximum(stress[0], 0.0))[:, None, None])
    if measure.tensions == 3:
        blocks = w * np.array([[stress[0], 0.5 * stress[1]], [0.5 * stress[1], stress[2]]])
        values, vectors = np.linalg.eigh(blocks.transpose(2, 0, 1))
        blocks = np.einsum("eik,ek,ejk->eij", vectors, np.maximum(values, 0.0), vectors)
        expected += _on_edges(sample, blocks)
    return _relative(_newton(case), expected)


def definite(case: NetCase) -> float:
    values = np.linalg.eigvalsh(np.moveaxis(_newton(case), -1, 0))
    return float(max(0.0, -values.min()) / values.max())


def exact(case: NetCase) -> float:
    return _relative(_newton(case, True), case.sample.hessian(wp.float64)) if case.term.measure.packed else 0.0


def rest(case: NetCase) -> float:
    sample = case.sample
    if not case.term.rest:
        return 0.0  # a dipole has no rest shape
    strain = sample.strains()[0]
    buffer = sample.data["buffer"].copy()
    buffer[[case.term.parameter_names.index(name) for name in case.term.rest]] = strain
    last = strain if case.term.density.lagged else sample.data["last"]
    size = np.abs(sample.gradient()).max()
    return float(np.abs(sample.gradient(case.real, buffer=buffer, last=last)).max() / size)


def invariance(case: NetCase) -> float:
    sample = case.sample.isotropic()
    return _relative(sample.energy(case.real, **sample.turned(rotation(3, 0.4))), sample.energy(case.real))


def nonzero(case: NetCase) -> float:
    """Share of the dofs without a force."""
    size = np.abs(case.sample.gradient(case.real))
    return float(1.0 - (size > 1e-6 * size.max())[case.sample.felt()].mean())


def downcast(case: NetCase) -> float:
    sample, worst = case.sample, 0.0
    for which, seed in enumerate((np.ones(ELEMENTS), case.seed)):
        value = (sample.energy, sample.gradient)[which]
        adjoint = sample.reverse(which, seed, case.real)
        before = value()
        for name in INPUTS:
            slope = adjoint[name] * sample.data[name]
            for row in range(len(slope)) if name in ("buffer", "last") else [...]:
                size = np.abs(slope[row]).sum()
                if size == 0.0:
                    continue  # not an input of this term
                scaled = sample.data[name].copy()
                scaled[row] *= 1.0 + TRAP
                change = (seed * (value(**{name: scaled}) - before)).sum()
                worst = max(worst, abs(change - TRAP * slope[row].sum()) / (TRAP * size))
    return worst


CHECKS = {
    check.__name__: check
    for check in (
        gradient,
        reverse,
        parameters,
        lagged,
        hessian,
        symmetry,
        evaluate,
        factor,
        definite,
        exact,
        rest,
        invariance,
        nonzero,
        downcast,
    )
}
"""Name -> error; tolerances are those of `ddg_warp.run.derivatives.CHECKS`."""


def _flat(values: np.ndarray) -> np.ndarray:
    """(slots, E, 3) as (3 slots, E)."""
    return values.transpose(0, 2, 1).reshape(-1, values.shape[1])


def _newton(case: NetCase, exact: bool = False) -> np.ndarray:
    """F^T F + C, or the exact matrix (3 slots, 3 slots, E), of what the evaluate kernel writes."""
    rows, tension, second, *_ = case.sample.evaluate(case.real, exact)
    result = np.einsum("mae,mbe->abe", rows, rows)
    if len(tension) == 1:
        result += _on_edges(case.sample, tension[0][:, None, None])
    if len(tension) == 3:
        blocks = np.array([[tension[0], tension[1]], [tension[1], tension[2]]]).transpose(2, 0, 1)
        result += _on_edges(case.sample, blocks)
    if exact:
        size = case.term.measure.size
        i, j = np.triu_indices(size)
        local = np.zeros((ELEMENTS, size, size))
        local[:, i, j] = local[:, j, i] = second.T
        incidence = case.sample.incidence
        result += np.einsum("ia,eij,jb->abe", incidence, local, incidence)
    return result


def _on_edges(sample: NetSample, blocks: np.ndarray) -> np.ndarray:
    """Geometric stiffness (E, n, n) between the first n edge vectors, in the blocks of an element."""
    incidence = sample.incidence[: 3 * blocks.shape[1]]
    return np.einsum("ia,eij,jb->abe", incidence, np.kron(blocks, np.eye(3)), incidence)


def _relative(value, reference) -> float:
    """Largest difference over the largest reference."""
    return float(np.abs(value - reference).max() / np.abs(reference).max())
