"""User-defined forces in Newton's method on the coupled system; see `kernels.forces.user_force`.

The force acts at every iterate, with its stiffness in the matrix. Blocks of nodal forces are added to the inertia of nodes. Pair
forces act matrix-free, in the products of conjugate gradients: preconditioners do without, since their diagonal blocks alone may be
indefinite. The line search takes the mean work of the forces along a step, which is exact for linear forces and needs no potential.
Where the matrix is indefinite, it takes the positive semidefinite projection of nodal blocks, and no pair forces.
"""

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp.errors import SceneError
from ddg_warp.kernels.core.inertia import block_inertia
from ddg_warp.kernels.forces import user_force
from ddg_warp.solve.forces.force import Force
from ddg_warp.solve.linear.solver_selection import MOST_PAIRED
from ddg_warp.timers import timer

UNSYMMETRIC = 2.0**20  # unit roundoffs by which a symmetric stiffness may be unsymmetric


class UserForces(Force):
    """User-defined forces of a `CoupledNewton`.

    Args:
        linear: scalar type of the linear algebra.
        quadratic: True if blocks have a quadratic potential; see `kernels.core.inertia`.
        contact: `ContactPotential` whose forces are added to, or None.

    Attributes:
        total, bound: forces on dof blocks (W N,) that elements, loads and inertia do not include, and bounds of their stiffness.
        inertia: inertia of blocks (worlds, N) with the stiffness of the forces.
        pairs: True if there are forces between pairs of nodes.
        start, time: positions at the start of the solve (W N,), and time at its end (worlds,).
    """

    name = "user"

    def __init__(self, model, linear, quadratic: bool, contact=None):
        self.coupled = coupled = model.coupled
        real, worlds, device = coupled.real, coupled.worlds, coupled.device
        count, matrix = worlds * coupled.blocks, wp.types.matrix((3, 3), real)
        self.parts, self.pairs = coupled.user_forces, any(part.force.pairs for part in coupled.user_forces)

        def make(shape, dtype=real):
            return wp.zeros(shape, dtype=dtype, device=device)

        self._force, self.total, self.start = (make(shape, coupled.vector) for shape in ((2, count), count, count))
        self._contact = [contact.forces, contact.blocks.stiffness] if contact else [make(0, coupled.vector), make(0)]
        self.bound, self.stiffness = make(count), make(count, matrix)
        self.inertia = make((worlds, coupled.blocks), block_inertia(real))
        self.time, self._times = make(worlds), make((2, worlds))
        self._clock, self._begin, self._clear, self._unsymmetric = user_force.start_kernels(real)
        self.tolerance = UNSYMMETRIC * model.types.eps
        self._work, self._inertia = user_force.finish_kernels(real, quadratic)
        self._kernels = [
            user_force.pair_kernels(part.force.function, part.layout, real, linear)
            if part.force.pairs
            else user_force.nodal_kernels(part.force.function, part.layout, real)
            for part in self.parts
        ]
        self._q = self._flags = None

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        common = [self._clock, self._begin, self._clear, self._unsymmetric, self._work, self._inertia]
        return [*common, *(kernel for kernels in self._kernels for kernel in kernels[:-1])]

    def upload(self, t0: float, t1: float) -> None:
        """Upload the times of a step."""
        self._times.assign(np.repeat([[t0], [t1]], self.coupled.worlds, axis=1))

    def freeze(self, before, newton) -> None:
        """Take the start of a solve, and the time at its end."""
        wp.copy(self.start, before.q)
        wp.launch(
            self._clock,
            self.coupled.worlds,
            [newton.islands.arrays[1], self._times],
            [self.time],
            device=self.coupled.device,
        )

    @property
    def pulls(self) -> list:
        """Kernels of the reverse of each force."""
        return [kernels[-1] for kernels in self._kernels]

    def start_at(self, q: wp.array) -> None:
        """Take positions q at the start of a solve, which ends at the end of the uploaded times."""
        wp.copy(self.start, q)
        wp.copy(self.time, self._times[1])

    @timer("user forces")
    def evaluate(self, q: wp.array, islands) -> None:
        """Evaluate the forces at positions q; `total` includes contact forces."""
        read = [*self._contact, self.stiffness, islands.arrays[0], self.coupled.blocks]
        self._launch(self._begin, len(q), read, [self._force, self.total, self.bound])
        for part, kernels in zip(self.parts, self._kernels, strict=True):
            read = [part.nodes, part.parameters, q, self.start, self.time, *islands.arrays, self.coupled.blocks]
            self._launch(kernels[0], part.parameters.shape, read, [self._force, self.total, self.bound])

    def account(self, iterates, norms, islands) -> None:
        """Add the mean work of the forces along the step to the change of the energy."""
        read = [iterates.proposed, iterates.base, self._force, islands.arrays[0], self.coupled.blocks]
        self._launch(self._work, len(self.total), read, [norms.change, norms.rounding_error])

    @timer("user forces")
    def assemble(self, q: wp.array, mass: wp.array, islands) -> None:
        """Write `inertia` at positions q in worlds that need a direction."""
        self.linearise(q, islands)
        read = [mass, self.stiffness, islands.arrays[0], self.coupled.blocks]
        self._launch(self._inertia, len(q), read, [self.inertia])

    def linearise(self, q: wp.array, islands) -> None:
        """Write `stiffness` of forces on nodes at positions q, where `multiply` acts from now on."""
        self._q, self._flags = q, islands.arrays[0]
        self._launch(self._clear, len(q), [self._flags, self.coupled.blocks], [self.stiffness])
        for part, kernels in zip(self.parts, self._kernels, strict=True):
            if not part.force.pairs:
                read = [part.nodes, part.parameters, q, self.start, self.time, *islands.arrays, self.coupled.blocks]
                self._launch(kernels[1], part.parameters.shape, read, [self.stiffness])

    @timer("user forces")
    def multiply(self, p: wp.array, product: wp.array, system) -> None:
        """Add the products of pair forces to `product`, and write p . H p of their nodes."""
        for part, kernels in zip(self.parts, self._kernels, strict=True):
            if part.force.pairs:
                read = [part.nodes, part.parameters, self._q, self._flags, system.masks.inactive, system.wanted]
                read += [p, self.coupled.blocks]
                self._launch(kernels[1], part.parameters.shape, read, [product, system.dots])

    def refuse_unsymmetric(self, failed: wp.array) -> None:
        """Mark worlds with an unsymmetric stiffness, which conjugate gradients do not solve (worlds,)."""
        inputs = [self.stiffness, self.tolerance, self.coupled.blocks]
        self._launch(self._unsymmetric, len(self.stiffness), inputs, [failed])

    def matrix(self) -> sparse.csc_matrix:
        """Return the stiffness at the positions of `linearise`, in dof blocks of space components.

        Raises:
            SceneError: pairs of too many nodes.
        """
        coupled, size = self.coupled, 3 * len(self.stiffness)
        result = sparse.block_diag(self.stiffness.numpy().astype(float), format="csc")
        for part, kernels in zip(self.parts, self._kernels, strict=True):
            count = len(part.blocks)
            if part.force.pairs and count > MOST_PAIRED:
                raise SceneError(
                    f"{part.name}: a matrix of pairs of {count} nodes is too large, {MOST_PAIRED} at most; take solver='pcg' for "
                    "equilibria, and fewer nodes for their stability and gradients"
                )
            if part.force.pairs:
                blocks = wp.zeros((coupled.worlds, count, count), dtype=self.stiffness.dtype, device=coupled.device)
                read = [part.nodes, part.parameters, self._q, coupled.blocks]
                self._launch(kernels[2], blocks.shape, read, [blocks])
                places = 3 * (coupled.blocks * np.arange(coupled.worlds)[:, None] + part.blocks)
                dofs = places[..., None] + np.arange(3)
                rows, columns = np.broadcast_arrays(dofs[:, :, None, :, None], dofs[:, None, :, None, :])
                values, each = blocks.numpy().astype(float), np.arange(count)
                values[:, each, each] = -values.sum(2)
                entries = values.ravel(), (rows.ravel(), columns.ravel())
                result = result + sparse.csc_matrix(entries, shape=(size, size))
        return result

    def _launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.coupled.device)
