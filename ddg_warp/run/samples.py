"""What the checks of `ddg_warp.run.derivatives` read: a term at a random state where nothing is zero, and what its kernels make of it.

`chain_samples` gathers along rods, `element_samples` by index, which serves all other measures, one's own among them. An element's
*local dofs* are what its kernels write derivatives by: the window of a chain, or three reals a slot.
"""

from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp.compile.precision import PRECISIONS
from ddg_warp.kernels import element_path
from ddg_warp.kernels.terms import Term


class Sample:
    """A term at its random state. Kernels run in float64, that of references, unless they are given another type.

    Attributes:
        chain: "open", "closed", or "net" for indexed elements.
        real: the type under test.
        shape: of all that has one value an element: (E,), in chains (n, R).
        data: inputs of the kernels by name, all of order one: q, the dofs, and the lagged data, parameters and constants.
        first: row of the term's first parameter in the buffer.
        rows: of its strains among those of the last step.
        parts: samples of all the terms that the fused kernel sums up, this one among them.
        grid: of a launch over the elements. index: of the term among those of its storage.
    """

    chain = "net"
    STEP = 1e-4  # of differences

    def __init__(self, term: Term, kind, precision: str, device: str, data: dict | None = None):
        self.term, self.measure, self.kind, self.precision, self.device = term, term.measure, kind, precision, device
        self.real = PRECISIONS[precision].real
        self.data = data or self.random_state()
        if self.real == wp.float32:
            self.data = {name: values.astype(np.float32).astype(float) for name, values in self.data.items()}

    def like(self, data: dict) -> "Sample":
        """This sample with other data."""
        return type(self)(self.term, self.kind, self.precision, self.device, data)

    def energy(self, real=wp.float64, **changed) -> np.ndarray:
        """Energies of the elements."""
        return self._launch(0, real, **changed)

    def gradient(self, real=wp.float64, **changed) -> np.ndarray:
        """Derivatives by the local dofs (local, *shape)."""
        return self._launch(1, real, **changed)

    def hessian(self, real=wp.float64) -> np.ndarray:
        """Second derivatives by the local dofs (local, local, *shape)."""
        return self._launch(2, real)

    def strains(self, **changed) -> tuple[np.ndarray, np.ndarray]:
        """Strains and stresses (strains, *shape)."""
        return self._launch(3, wp.float64, **changed)

    def _launch(self, which: int, real, **changed):
        """Return what the energy (0), gradient (1), Hessian (2) or strain (3) kernel writes, by local dofs."""
        storage, device = self.storage(real), self.device
        size, strains = storage.Window._length_, sum(len(own.term.measure.strains) for own in storage.terms)
        rows, dtype = [(), (storage.num_slots or size,), (size, size), (strains,)][which], real
        if which == 1 and storage.slots:
            dtype = wp.types.vector(3, real)
        count = int(np.prod(self.grid))
        out = [wp.zeros((*rows, count), dtype=dtype, device=device) for _ in range(2 if which == 3 else 1)]
        kernels = element_path.term_kernels(storage, self.index, real, reverse=True)
        kernel = element_path.strain_kernel(storage, real) if which == 3 else kernels[which]
        more = [[], [], [wp.zeros((0, 0), dtype=real, device=device)], [1]][which]
        grid = (*self.grid, size) if which == 2 else self.grid
        wp.launch(kernel, grid, [self.inputs(real, **changed), *more], out, device=device)
        found = [array.numpy().astype(float) for array in out]
        if which == 3:
            return tuple(values.reshape(-1, *self.shape)[self.rows] for values in found)
        return self.of_local(found[0], which)

    def reverse(self, which: int, seed: np.ndarray) -> dict[str, np.ndarray]:
        """Reverse mode of the energy (which = 0) or gradient (1) kernel of the term, by input."""
        storage, inputs = self.storage(self.real), self.inputs(self.real)
        dtype = wp.types.vector(3, self.real) if which and storage.slots else self.real
        seeds = wp.array(np.ascontiguousarray(self.as_written(seed, which)), dtype=dtype, device=self.device)
        wp.launch(
            element_path.term_kernels(storage, self.index, self.real, reverse=True)[which],
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
        """v . gradient of every element."""
        return (self.seed * self.gradient(**changed)).sum(0)

    def difference(self, function, name: str, where, direction=1.0) -> np.ndarray:
        """Central difference of fourth order of function(**data) along data[name][where]."""
        h, ends = self.STEP, []
        for step in (h, -h, 2.0 * h, -2.0 * h):
            values = self.data[name].copy()
            values[where] += step * direction
            ends.append(function(**{name: values}))
        return (8.0 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12.0 * h)

    def parameter_rows(self, *families: str) -> list[int]:
        """Rows of the buffer with the parameters of some families, or of all."""
        known = enumerate(self.term.parameters, self.first)
        return [row for row, parameter in known if not families or parameter.family in families]

    def at_rest(self) -> dict[str, np.ndarray]:
        """Data with which no element feels a force: rest strains, and those of the last step, are the strains."""
        data = {} if self.term.rest else self.straight()
        strain = self.strains(**data)[0]
        buffer, last = self.data["buffer"].copy(), self.data["last"].copy()
        if self.term.rest:
            buffer[self.parameter_rows("rest")] = strain
        if self.term.density.lagged:
            last[self.rows] = strain
        return {**data, "buffer": buffer, "last": last}

    def isotropic(self) -> "Sample":
        """This sample; with equal stiffness and no rest strain where strains are components of a vector in space."""
        if not self.measure.vector:
            return self
        buffer = self.data["buffer"].copy()
        buffer[self.parameter_rows("rest")] = 0.0
        for family in {parameter.family for parameter in self.term.parameters if parameter.number}:
            rows = self.parameter_rows(family)
            buffer[rows] = buffer[rows[0]]
        return self.like({**self.data, "buffer": buffer})

    def turned(self, turn: np.ndarray) -> dict[str, np.ndarray]:
        """All data after a rotation; of a shell of revolution, which cannot turn, after a shift along its axis."""
        measure, data = self.measure, {name: values.copy() for name, values in self.data.items()}
        if measure.revolved:
            data["q"][:, 1:] += 0.4
            return data
        for where in self.vectors:
            data["q"][where] = data["q"][where] @ turn.T
        own = measure.lag_size - 6 * measure.frames
        starts = [("frame", 0), ("frame", 3)] if measure.frames else []
        starts += [("lag", row) if row < own else ("constants", row - own) for row in measure.vectors]
        starts += [("last", self.rows.start)] if measure.vector and self.term.density.lagged else []
        if measure.field:
            first = measure.data_size - measure.field
            starts.append(("constants", first))
            slope = data["constants"][first + 3 :].reshape(3, 3, -1)
            data["constants"][first + 3 :] = np.einsum("ia,abe,jb->ije", turn, slope, turn).reshape(9, -1)
        for name, at in starts:
            data[name][at : at + 3] = np.einsum("ij,j...->i...", turn, data[name][at : at + 3])
        return data

    def moved(self, turn: np.ndarray) -> list[dict[str, np.ndarray]]:
        """Data at which the energy is what it was, by a rotation."""
        return [self.turned(turn)]


def random_parameters(term: Term, random: np.random.Generator, shape: tuple) -> np.ndarray:
    """Values (parameters, *shape) that have a meaning to the law, all of order one."""
    rows = []
    for parameter in term.parameters:
        value = random.uniform(0.6, 1.4, size=shape)
        if not parameter.valid[1](value).all():
            value = 0.5 * value  # a Poisson's ratio
        if len(set(parameter.number)) > 1:
            value = 0.2 * value  # beside the diagonal of a positive definite tensor
        if parameter.unit == "1/m":
            value = 8.0 * value  # strains that mean something to a law are as large as those of the sample
        if parameter.family == "thickness":
            value = 0.1 * value  # points do not lie inside of what they touch,
        if parameter.family in ("range", "velocity"):
            value = 3.0 * value  # nor beyond its reach, nor do they slide so fast that friction is constant
        rows.append(random_strains(term, random, shape) if parameter.family == "rest" else value)
    return np.array(rows)


def random_strains(term: Term, random: np.random.Generator, shape: tuple) -> np.ndarray:
    """Strains about those without deformation, one a row of `shape`."""
    return float(term.measure.strains[0].startswith("stretch")) + 0.4 * random.normal(size=shape)


def rotation(dim: int, angle: float) -> np.ndarray:
    """A rotation matrix (dim, dim)."""
    axis = np.array([2.0, -1.0, 2.0]) / 3.0 if dim == 3 else np.array([0.0, 0.0, 1.0])
    spin = np.cross(axis, np.eye(3), axisb=0, axisc=0)
    return (np.eye(3) + np.sin(angle) * spin + (1.0 - np.cos(angle)) * spin @ spin)[:dim, :dim]
