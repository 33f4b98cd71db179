"""Indexed elements at a random state without zeros, with results of their kernels; for the derivative table."""

from functools import cached_property

import numpy as np
import warp as wp

from ddg_warp.kernels.core.islands import Islands
from ddg_warp.kernels.elements import coupled_element, element_path
from ddg_warp.kernels.measures import lagged_frames
from ddg_warp.kernels.terms import Term
from ddg_warp.run.derivative_samples import Sample, random_parameters, random_strains


class Elements(Sample):
    """Eight indexed elements without common dof blocks, so that a dof affects one element only.

    Attributes:
        data: q (blocks, 3), frame, lag, last, rate, buffer (rows, E), constants (data, E); see `Measure.sample`.
        slots: dof blocks of each element's local nodes (local, E): nodes of all elements first, then angles, then rotation vectors.
        felt: mask of the dofs in the energy, shaped as q.
    """

    COUNT, LEFT_OUT = 8, frozenset({"energy", "rigid", "resultant"})
    INPUTS = ("q", "frame", "lag", "last", "rate", "buffer")

    def __init__(self, term: Term, *arguments):
        measure = term.measure
        self.shape, self.first, self.rows, self.parts = (self.COUNT,), 0, slice(0, len(measure.strains)), [self]
        self.grid, self.index = (1, self.COUNT), 0
        self.slots = np.arange(measure.slots * self.COUNT).reshape(-1, self.COUNT)
        self.angle_start = measure.nodes * self.COUNT
        self.angle_end = self.angle_start + measure.angles * self.COUNT
        self.vectors = [slice(0, self.angle_start), slice(self.angle_end, None)]
        self.given = measure.sample(np.random.default_rng(13), self.COUNT) if measure.sample else {}
        super().__init__(term, *arguments)

    def random_state(self) -> dict[str, np.ndarray]:
        """Return random data; see the class."""
        random, measure, count, provided = np.random.default_rng(11), self.measure, self.COUNT, self.given
        steps = np.eye(3)[2 * (np.arange(measure.nodes) - 1) % 3]  # the first to a positive radius
        nodes = provided.get("nodes", [2.0, 0.0, 0.0] + np.cumsum(steps, axis=0))
        x = np.array(nodes)[:, None] + 0.1 * random.normal(size=(measure.nodes, count, 3))
        q = 0.4 * random.normal(size=(self.slots.size, 3))
        q[: self.angle_start] = x.reshape(-1, 3)
        q[self.angle_start : self.angle_end, 1:] = 0.0
        edges = [x[b] - x[a] for a, b in measure.edges[: measure.frames]]
        frame = [lagged_frames(random, edge) for edge in edges] or [np.zeros((6, 1))]
        lag_rows = max(1, measure.lag_size - 6 * measure.frames)
        return {
            "q": q,
            "frame": provided.get("frame", np.concatenate(frame, axis=1)),
            "lag": provided.get("lag", 6.0 * random.normal(size=(lag_rows, count))),
            "last": random_strains(self.term, random, (len(measure.strains), count)),
            "rate": random.uniform(0.6, 1.4, size=1),
            "buffer": random_parameters(self.term, random, (count,)),
            "constants": provided.get("data", random.uniform(0.5, 1.5, size=(max(1, measure.data_size), count))),
        }

    @property
    def felt(self) -> np.ndarray:
        """Mask of the dofs in the energy."""
        mask = np.repeat(self.given.get("felt", np.ones_like(self.slots)).reshape(-1, 1) > 0, 3, axis=1)
        mask[self.angle_start : self.angle_end, 1:] = False
        mask[:, 1] &= not self.measure.revolved  # y of a meridian
        return mask

    def evaluate(self, exact: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return F^T F + C (local, local, E), gradient and energies of the fused kernel.

        `exact` adds compression and second derivatives.
        """
        n, slots, count, real = len(self.measure.strains), self.measure.slots, self.COUNT, self.real
        vector, tensions, packed = wp.types.vector(3, real), self.measure.tensions, self.measure.packed
        shapes = [
            (n * slots, count),
            (max(1, tensions), count),
            (max(1, packed), count),
            (slots, count),
            (2, count),
            count,
        ]
        types = [vector, real, real, vector, real, real]
        out = [wp.zeros(s, dtype=t, device=self.device) for s, t in zip(shapes, types, strict=True)]
        islands = Islands(1, real, self.device)
        islands.drop_compression.fill_(0 if exact else 1)
        kernel = element_path.evaluate_kernel(self.storage(real), real, real, exact and packed > 0)
        results = element_path.results_type(real, real, True)()
        results.factor, results.tension, results.second, results.gradient, results.energy, results.stiffness = out
        wp.launch(kernel, (1, count), [self.inputs(real), *islands.arrays, 0], [results], device=self.device)
        factor, tension, second, gradient, energy = (array.numpy().astype(float) for array in out[:5])
        rows = factor.reshape(n, slots, count, 3).transpose(0, 1, 3, 2).reshape(n, 3 * slots, count)
        matrix = np.einsum("mae,mbe->abe", rows, rows)
        if tensions:
            entries = [[0]] if tensions == 1 else [[0, 1], [1, 2]]
            matrix += self.on_edges(np.moveaxis(tension[entries], -1, 0))
        if exact and packed:
            i, j = np.triu_indices(self.measure.size)
            local = np.zeros((count, self.measure.size, self.measure.size))
            local[:, i, j] = local[:, j, i] = second.T
            matrix += np.einsum("ia,eij,jb->abe", self.incidence, local, self.incidence)
        return matrix, _flat(gradient), energy[1]

    def on_edges(self, blocks: np.ndarray) -> np.ndarray:
        """Return blocks (E, n, n) times I between the first n edge vectors, in local dofs (local, local, E)."""
        incidence = self.incidence[: 3 * blocks.shape[1]]
        return np.einsum("ia,eij,jb->abe", incidence, np.kron(blocks, np.eye(3)), incidence)

    @cached_property
    def incidence(self) -> np.ndarray:
        """Matrix from local dof blocks of an element to the dofs of the measure (size, 3 blocks)."""
        measure = self.measure
        axes, slot = np.eye(3), np.eye(measure.slots)
        edges = [np.kron(slot[b] - slot[a], axes) for a, b in measure.edges]
        angles, spins = np.split(slot[measure.nodes :], [measure.angles])
        return np.concatenate(
            [*edges, np.kron(angles, axes[:1]), np.kron(spins, axes), np.kron(slot[: measure.points], axes)]
        )

    def storage(self, real):
        """Return the element storage of the term."""
        return coupled_element.coupled_storage(self.term, real)

    def of_local(self, values: np.ndarray, kernel_index: int) -> np.ndarray:
        """Return gradients (local nodes, E, 3) and Hessians by the dofs of the measure as derivatives by three reals a local node."""
        if kernel_index == 2:
            return np.einsum("ia,ije,jb->abe", self.incidence, values, self.incidence)
        return _flat(values) if kernel_index == 1 else values

    def as_written(self, seed: np.ndarray, kernel_index: int) -> np.ndarray:
        """Return weights of energies or gradients in the layout of the kernels' outputs."""
        return seed.reshape(-1, 3, self.COUNT).transpose(0, 2, 1) if kernel_index else seed

    def by_data(self, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return derivatives by kernel inputs as derivatives by `data`."""
        return {name: derivative.reshape(self.data[name].shape) for name, derivative in values.items()}

    def inputs(self, real, **changed):
        """Return the struct of kernel inputs; see `kernels.elements.coupled_element.elements_type`."""
        data, elements = {**self.data, **changed}, coupled_element.elements_type(real)()

        def put(values, dtype):
            return wp.array(
                np.ascontiguousarray(values), dtype=dtype, device=self.device, requires_grad=dtype is not int
            )

        for name in self.INPUTS:
            values = data[name].ravel() if name == "buffer" else data[name]
            setattr(elements, name, put(values, wp.types.vector(3, real) if name == "q" else real))
        table = [(row * self.COUNT, 1, 0) for row in range(len(data["buffer"]))]
        elements.table, elements.slots = put(np.array(table, np.int32), int), put(self.slots.astype(np.int32), int)
        elements.data, elements.blocks = put(data["constants"], real), self.slots.size
        elements.angle_start, elements.edges = self.angle_start, self.angle_end - self.angle_start
        elements.elements = self.COUNT
        return elements


def _flat(values: np.ndarray) -> np.ndarray:
    """Return vectors (local, E, 3) as (3 local, E)."""
    return values.transpose(0, 2, 1).reshape(-1, values.shape[1])
