"""Samples for the checks of `ddg_warp.run.derivative_checks`: a term at a random state without zeros, with results of its kernels.

`derivative_samples_rod` covers rods, `derivative_samples_coupled` indexed elements of all other measures, user-defined ones included,
and `derivative_samples_contact` collisions. The *local dofs* of an element are the dofs by which kernels write derivatives: the window
of a rod, or three reals for each local dof block.
"""

from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp.compile.precision import PRECISIONS
from ddg_warp.kernels.elements import element_path
from ddg_warp.kernels.terms import Term


class Sample:
    """A term at a random state. Kernels run in float64, the precision of references, unless given another type.

    Attributes:
        layout: label "open" or "closed" of rods, "coupled" of indexed elements, or "pair" of collisions.
        real: type under test.
        shape: shape of arrays with one value for each element: (E,), for rods (n, R).
        data: inputs of the kernels by name, all of order one: dofs q, lagged data, parameters and constants.
        first: row of the first parameter of the term in the buffer.
        rows: rows of the term's strains among the strains of the last step.
        parts: samples of all terms in the fused kernel, including the present one.
        grid: dimensions of a launch over the elements; index: index of the term in its storage.
    """

    layout = "coupled"
    ORDERS = (0, 1)  # orders of derivatives with a reverse mode: energy, gradient
    LEFT_OUT = frozenset()  # checks that do not apply
    STEP = 1e-4  # step of differences

    def __init__(self, term: Term, kind, precision: str, device: str, data: dict | None = None):
        self.term, self.kind, self.precision, self.device = term, kind, precision, device
        self.real = PRECISIONS[precision].real
        self.data = data or self.random_state()
        if self.real == wp.float32:
            self.data = {name: values.astype(np.float32).astype(float) for name, values in self.data.items()}

    @property
    def measure(self):
        """Measure of the term."""
        return self.term.measure

    @property
    def dim(self) -> int:
        """Dimension of space."""
        return self.measure.dim

    def like(self, data: dict) -> "Sample":
        """Return the sample with other data."""
        return type(self)(self.term, self.kind, self.precision, self.device, data)

    def energy(self, real=wp.float64, **changed) -> np.ndarray:
        """Return energies of the elements."""
        return self._launch(0, real, **changed)

    def gradient(self, real=wp.float64, **changed) -> np.ndarray:
        """Return derivatives by the local dofs (local, *shape)."""
        return self._launch(1, real, **changed)

    def hessian(self, real=wp.float64) -> np.ndarray:
        """Return second derivatives by the local dofs (local, local, *shape)."""
        return self._launch(2, real)

    def strains(self, **changed) -> tuple[np.ndarray, np.ndarray]:
        """Return strains and stresses (strains, *shape)."""
        return self._launch(3, wp.float64, **changed)

    def _launch(self, kernel_index: int, real, **changed):
        """Return the output of the energy (0), gradient (1), Hessian (2) or strain (3) kernel, by local dofs."""
        storage, device = self.storage(real), self.device
        size, strains = storage.Window._length_, sum(len(access.term.measure.strains) for access in storage.terms)
        rows, dtype = [(), (storage.num_slots or size,), (size, size), (strains,)][kernel_index], real
        if kernel_index == 1 and storage.slots:
            dtype = wp.types.vector(3, real)
        count = int(np.prod(self.grid))
        out = [wp.zeros((*rows, count), dtype=dtype, device=device) for _ in range(2 if kernel_index == 3 else 1)]
        kernels = element_path.term_kernels(storage, self.index, real, reverse=True)
        kernel = element_path.strain_kernel(storage, real) if kernel_index == 3 else kernels[kernel_index]
        more = [[], [], [wp.zeros((0, 0), dtype=real, device=device)], [1]][kernel_index]
        grid = (*self.grid, size) if kernel_index == 2 else self.grid
        wp.launch(kernel, grid, [self.inputs(real, **changed), *more], out, device=device)
        outputs = [array.numpy().astype(float) for array in out]
        if kernel_index == 3:
            return tuple(values.reshape(-1, *self.shape)[self.rows] for values in outputs)
        return self.of_local(outputs[0], kernel_index)

    def reverse(self, kernel_index: int, seed: np.ndarray) -> dict[str, np.ndarray]:
        """Return the reverse mode of the energy (0) or gradient (1) kernel of the term, by input."""
        storage, inputs = self.storage(self.real), self.inputs(self.real)
        dtype = wp.types.vector(3, self.real) if kernel_index and storage.slots else self.real
        seeds = wp.array(np.ascontiguousarray(self.as_written(seed, kernel_index)), dtype=dtype, device=self.device)
        wp.launch(
            element_path.term_kernels(storage, self.index, self.real, reverse=True)[kernel_index],
            self.grid,
            [inputs],
            [wp.zeros_like(seeds, requires_grad=True)],
            adjoint=True,
            adj_inputs=[storage.Inputs()],
            adj_outputs=[seeds],
            device=self.device,
        )
        return self.by_data({name: getattr(inputs, name).grad.numpy().astype(float) for name in self.INPUTS})

    @cached_property
    def seed(self) -> np.ndarray:
        """Weights v of the gradient."""
        return np.random.default_rng(7).normal(size=self.gradient().shape)

    @cached_property
    def adjoint(self) -> dict[str, np.ndarray]:
        """Reverse mode of v . gradient, by input."""
        return self.reverse(1, self.seed)

    @cached_property
    def gradient_derivative(self) -> np.ndarray:
        """Differences of the gradient (local, local, *shape)."""
        return self.local_derivative(self.gradient)

    def seeded(self, **changed) -> np.ndarray:
        """Return v . gradient of every element."""
        return (self.seed * self.gradient(**changed)).sum(0)

    def difference(self, function, name: str, where, direction=1.0) -> np.ndarray:
        """Return the central difference of fourth order of function(**data) along data[name][where]."""
        h, ends = self.STEP, []
        for step in (h, -h, 2.0 * h, -2.0 * h):
            values = self.data[name].copy()
            values[where] += step * direction
            ends.append(function(**{name: values}))
        return (8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12.0 * h)

    def scatter(self, local: np.ndarray) -> np.ndarray:
        """Return values at local dofs of indexed elements (local, E) by dof blocks (blocks, 3)."""
        return local.reshape(-1, 3, self.shape[0]).transpose(0, 2, 1).reshape(-1, 3)

    def local_derivative(self, function) -> np.ndarray:
        """Differentiate function(**data) of indexed elements (m, E) by the local dofs (m, local, E)."""
        columns = [self.difference(function, "q", (row, d)) for row in self.slots for d in range(3)]
        return np.stack(columns, axis=1)

    def parameter_rows(self, *families: str) -> list[int]:
        """Return the buffer rows of the parameters of some families, or of all."""
        numbered = enumerate(self.term.parameters, self.first)
        return [row for row, parameter in numbered if not families or parameter.family in families]

    def gauss_newton(self) -> np.ndarray:
        """Return w J^T psi'' J with the positive part of psi'', and the stiffness of tension (local, local, *shape)."""
        measure, w = self.measure, self.data["buffer"][self.first]
        J, S = (
            np.moveaxis(self.local_derivative(lambda i=i, **data: self.strains(**data)[i]), (0, 1), (-2, -1))
            for i in range(2)
        )
        strain, stress = self.strains()
        inverse = np.linalg.pinv(J, 1e-9)
        curvature = J @ inverse @ S @ inverse  # in the range of J
        if measure.field:  # for a direction n in a field -s: curvature along the sphere, -n . s
            curvature = -(strain[:3] * stress[:3]).sum(0)[:, None, None] * np.diag(np.arange(6) < 3)
        matrix = w * np.moveaxis(J.swapaxes(-2, -1) @ positive(curvature) @ J, (-2, -1), (0, 1))
        if measure.tensions == 3:
            blocks = w * np.array([[stress[0], 0.5 * stress[1]], [0.5 * stress[1], stress[2]]])
        elif measure.tensions and measure.revolved:  # the root of the law omits the hoop stress
            blocks = w * stress[None, :1]
        elif measure.tensions:
            return np.where(stress[0] > 0.0, self.gradient_derivative, matrix)
        else:
            return matrix
        return matrix + self.on_edges(positive(np.moveaxis(blocks, -1, 0)))

    def compared(self):
        """Return the index of elements with exact second derivatives: all."""
        return slice(None)

    def at_rest(self) -> dict[str, np.ndarray]:
        """Return data without forces: rest strains and strains of the last step equal the strains, and no torque or stop acts."""
        data = {} if self.term.rest else self.straight()
        strain = self.strains(**data)[0]
        buffer, last = self.data["buffer"].copy(), self.data["last"].copy()
        if self.term.rest:
            buffer[self.parameter_rows("rest")] = strain
        if self.term.density.lagged:
            last[self.rows] = strain
        buffer[self.parameter_rows("torque", "stop")] = 0.0
        return {**data, "buffer": buffer, "last": last}

    def isotropic(self) -> "Sample":
        """Return an isotropic sample: for strains that form a vector, equal stiffness and no rest strain."""
        names = [name.split()[0] for name in self.measure.strains]
        space = [k for k, name in enumerate(names) if name.endswith(("_x", "_y", "_z"))]
        if not space:
            return self
        buffer = self.data["buffer"].copy()
        for family in {parameter.family for parameter in self.term.parameters if parameter.number}:
            rows = self.parameter_rows(family)
            rows = rows if self.measure.vector else [rows[k] for k in space]
            buffer[rows] = 0.0 if family == "rest" else buffer[rows[0]]
        return self.like({**self.data, "buffer": buffer})

    def turned(self, turn: np.ndarray) -> dict[str, np.ndarray]:
        """Return all data after a rotation, or for a shell of revolution after a shift along the axis."""
        measure, data = self.measure, {name: values.copy() for name, values in self.data.items()}
        if measure.revolved:
            data["q"][:, 1:] += 0.4
            return data
        for where in self.vectors:
            data["q"][where] = data["q"][where] @ turn.T
        lag_rows = measure.lag_size - 6 * measure.frames
        starts = [("frame", 0), ("frame", 3)] if measure.frames else []
        starts += [("lag", row) if row < lag_rows else ("constants", row - lag_rows) for row in measure.vectors]
        starts += [("last", self.rows.start)] if measure.vector and self.term.density.lagged else []
        if measure.field:
            first = measure.data_size - measure.field
            starts.append(("constants", first))
            slope = data["constants"][first + 3 :].reshape(3, 3, -1)
            data["constants"][first + 3 :] = np.einsum("ia,abe,jb->ije", turn, slope, turn).reshape(9, -1)
        for name, start in starts:
            data[name][start : start + 3] = np.einsum("ij,j...->i...", turn, data[name][start : start + 3])
        return data

    def moved(self, turn: np.ndarray) -> list[dict[str, np.ndarray]]:
        """Return rotated data, with equal energy."""
        return [self.turned(turn)]


def positive(matrix: np.ndarray) -> np.ndarray:
    """Return symmetric matrices (..., n, n) without their negative part."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, 0.0)[..., None, :]) @ vectors.swapaxes(-2, -1)


def random_parameters(term: Term, random: np.random.Generator, shape: tuple) -> np.ndarray:
    """Return valid values of parameters (parameters, *shape), of order one."""
    rows = []
    for parameter in term.parameters:
        value = random.uniform(0.6, 1.4, size=shape)
        if not parameter.valid[1](value).all():
            value = 0.5 * value  # a Poisson's ratio
        if len(set(parameter.number)) > 1:
            value = 0.2 * value  # off the diagonal of a positive definite tensor
        if parameter.unit == "1/m":
            value = 8.0 * value  # curvatures of the size of the sample's
        if parameter.family == "thickness":
            value = 0.1 * value  # closest points lie outside
        if parameter.family == "range":
            value = 3.0 * value  # and within the range
        rows.append(random_strains(term, random, shape) if parameter.family == "rest" else value)
    return np.array(rows)


def random_strains(term: Term, random: np.random.Generator, shape: tuple) -> np.ndarray:
    """Return random strains of `shape` near zero deformation."""
    return float(term.measure.strains[0].startswith("stretch")) + 0.4 * random.normal(size=shape)


def rotation(dim: int, angle: float) -> np.ndarray:
    """Return a rotation matrix (dim, dim)."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0 if dim == 3 else np.array([0.0, 0.0, 1.0])
    spin = np.cross(axis, np.eye(3), axisb=0, axisc=0)
    return (np.eye(3) + np.sin(angle) * spin + (1.0 - np.cos(angle)) * spin @ spin)[:dim, :dim]
