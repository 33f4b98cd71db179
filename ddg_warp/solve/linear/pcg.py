"""Preconditioned conjugate gradients on all worlds of the coupled system, on a device; see `kernels.linear.coupled_pcg`."""

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import coupled_pcg
from ddg_warp.kernels.newton.relaxed_convergence import FARTHEST
from ddg_warp.solve.linear.multilevel import Multilevel
from ddg_warp.solve.linear.sparse_system import Sums
from ddg_warp.timers import timer

SPARE = 0.5  # safety factor of the last linear solve of a step: of the tolerance, and of the bodies that may exceed it


def natural_scale(coupled) -> float:
    """Return the power of two that scales products of forces and displacements to the order of one.

    Stretching an element of the coupled system by its length takes w k, measure times stiffness [J]. At lengths of 1e-9 m that is
    1e-25 J, and products of residuals and directions at a tolerance of 1e-8 lie beyond float32.
    """
    energies = [
        float(np.median(part.parameters["measure"])) * float(np.median(part.parameters["stiffness"]))
        for part in coupled.sets
        if part.term.name.endswith("_stretch") and {"measure", "stiffness"} <= set(part.parameters.values)
    ]
    largest = max(energies, default=1.0)
    return 2.0 ** round(-0.5 * math.log2(largest)) if largest > 0.0 else 1.0


class PCG:
    """Preconditioned conjugate gradients for `LinearSystem`s, to the forcing term in the preconditioner norm.

    Args:
        `sparsity`: `SparseSystem` of H; `substructuring`: `RodSubstructuring` of the preconditioner or None, with blocks of H in bands.
        contact: `ContactHessian` to add to H, or None.
        linear: scalar type of the systems.
        multilevel: True to add BPX multilevel corrections, or to use these alone; see `kernels.linear.multilevel`.
        scale: power of two by which residuals and directions are scaled, against underflow and overflow of products; see
            `natural_scale`.
        indefinite: True if H may be indefinite.
        user_forces: `UserForces` to add to H, or None.
        rigid_bodies: `RigidBodies`, whose carried nodes contact moves, or None.

    Attributes:
        `rest`, `z`: scaled residual, preconditioned residual.
        `p`, `product`: search direction, H p.
        `inverse`: inverse diagonal blocks.
        `rho_first`, `total`: squared norms of the first and the last residual.
        `sum`: sums of block values over each world.
    """

    def __init__(
        self,
        coupled,
        sparsity,
        substructuring,
        contact,
        linear,
        multilevel: bool,
        indefinite: bool = False,
        scale: float = 1.0,
        user_forces=None,
        rigid_bodies=None,
    ):
        self._rigid_bodies = rigid_bodies
        self._scale, self._unit = linear(scale), linear(1.0 / scale)
        self.coupled, self.sparsity, self.substructuring, self.contact = coupled, sparsity, substructuring, contact
        self._pair_forces = user_forces if user_forces and user_forces.pairs else None
        worlds, count, device = coupled.worlds, coupled.worlds * coupled.blocks, coupled.device
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
        self.rest, self.z, self.p, self.product = (wp.zeros(count, dtype=H, device=device) for _ in range(4))
        self.inverse = wp.zeros(count, dtype=M, device=device)
        self.rho, self.rho_first, self.total, self.curvature, self.beta = (
            wp.zeros(worlds, dtype=linear, device=device) for _ in range(5)
        )
        self.busy = wp.zeros(1, dtype=int, device=device)
        self._unread = [wp.zeros(worlds, dtype=int, device=device) for _ in range(2)]
        self.sum = Sums(worlds, coupled.blocks, linear, device)
        self._invert, self._start, self._begin, *self._cycle = coupled_pcg.solver_kernels(
            linear, indefinite, sparsity.has_angles, not self.sum.device.is_cuda
        )
        self._more = contact.diagonal if contact else wp.zeros(0, dtype=M, device=device)
        self.levels = Multilevel(coupled, sparsity, linear) if multilevel else None
        self._limit = max(200, 100 * math.isqrt(coupled.blocks))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        levels = self.levels.kernels if self.levels else []
        return [self._invert, self._start, self._begin, *self._cycle, *self.sum.kernels, *levels]

    @timer("pcg")
    def solve(self, system) -> None:
        """Compute directions. Worlds with an indefinite H or preconditioner are marked and keep the present approximation."""
        self.begin(system)
        self.iterate(system)

    def begin(self, system, iteration: wp.array | None = None) -> None:
        """Prepare the preconditioner, and start from zero directions.

        Args:
            iteration: (W,) iterations of Newton's method, if the levels of its first matrix serve the others, too.
        """
        table, masks, blocks = self.sparsity, system.masks, self.coupled.blocks
        self._launch(
            self._invert,
            [system.matrix, table.diagonal, masks.inactive, system.outdated, blocks, table.positions, self._more],
            [self.inverse],
        )
        self._launch(
            self._start,
            [system.rhs, self.inverse, table.diagonal, masks.inactive, system.wanted, blocks, self._scale],
            [self.rest, system.direction, self.p, system.dots],
        )
        if self.substructuring:
            self.substructuring.prepare(system, self._unread[0])
        elif self._rigid_bodies:
            self._rigid_bodies.factorise(system, self._more)
        if self.levels:
            self.levels.prepare(system, self._more, iteration)
        self.precondition(system, self.p)
        self.sum(system.dots, self.total)
        self.busy.zero_()
        outputs = [system.wanted, self.rho, self.rho_first, system.iterations, system.indefinite, self.busy]
        wp.launch(self._begin, self.coupled.worlds, [self.total], outputs, device=self.coupled.device)

    def iterate(self, system, after_cycle: Callable[[], None] | None = None) -> None:
        """Iterate until the residual is small in the norm of the preconditioner; `after_cycle` may end a solve earlier."""

        def cycle() -> None:
            self.cycle(system)
            if after_cycle:
                after_cycle()

        wp.capture_while(self.busy, cycle)

    @timer("preconditioner")
    def precondition(self, system, z: wp.array) -> None:
        """Apply substructuring and multilevel to z, on entry the residual times inverse diagonal blocks; write r . z."""
        if self.substructuring:
            self.substructuring.apply(system, self.rest, z, self._unread[0])
        elif self._rigid_bodies:
            self._rigid_bodies.precondition(system, self.rest, z)
        if self.levels:
            self.levels.apply(self.rest, system.masks.inactive, system.wanted, z, system.dots)

    def cycle(self, system) -> None:
        """Run one iteration."""
        blocks, inactive, wanted, dots = self.coupled.blocks, system.masks.inactive, system.wanted, system.dots
        _, advance, test, turn = self._cycle
        self.multiply(system, self.p)
        self.sum(dots, self.curvature)
        self._launch(
            advance,
            [self.p, self.product, self.inverse, self.sparsity.diagonal, inactive, self.rho, self.curvature]
            + [system.iterations, wanted, blocks, self._unit],
            [system.direction, self.rest, self.z, dots, self.beta, self.busy],
        )
        self.precondition(system, self.z)
        self.sum.launch(
            test,
            dots,
            [self.curvature, self.rho_first, system.forcing, self._limit],
            [self.total, self.rho, self.beta, system.iterations, system.indefinite, wanted, self.busy],
        )
        self._launch(turn, [self.z, self.beta, inactive, blocks], [self.p])

    @timer("product")
    def multiply(self, system, p: wp.array) -> None:
        """Write H p on active dofs, and p . H p block by block; no matrix has contact and pair forces."""
        if self.substructuring and self.substructuring.banded:  # elements along rods are stored in bands
            elements = partial(self.substructuring.bands.product, system, p, self.product)
        else:
            elements = partial(self.multiply_matrix, system, p)
        if self.contact:
            if self._rigid_bodies:
                self._rigid_bodies.spread(p)
            device_arrays.side_by_side([elements, partial(self.contact.spread, p)], self.coupled.device)
            self.contact.settle(p, self.product, system)
            if self._rigid_bodies:
                self._rigid_bodies.gather(self.contact.products, p, self.product, system)
        else:
            elements()
        if self._pair_forces:
            self._pair_forces.multiply(p, self.product, system)

    def multiply_matrix(self, system, p: wp.array) -> None:
        """Write the product without contact, with all of H in the sparse matrix."""
        table = self.sparsity
        inputs = [system.matrix, table.columns, table.slices, system.masks.inactive, p, system.wanted]
        inputs += [self.coupled.blocks, table.positions, *table.angles]
        self._launch(self._cycle[0], inputs, [self.product, system.dots])

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        """Launch one thread a block of every world."""
        wp.launch(kernel, len(self.z), inputs, outputs, device=self.coupled.device)


class NewtonPCG(PCG):
    """Directions of a `CoupledNewton` to the forcing term and the goal of the system; see `PCG`.

    Args:
        tolerances: `ResidualTolerances`, whose ratios are overwritten; rtol: relative tolerance.
        relaxed: `RelaxedConvergence`, or None.
        keeps_levels: True if the multilevel preconditioner of a solve's first matrix serves the others, too.
    """

    def __init__(
        self,
        coupled,
        sparsity,
        substructuring,
        contact,
        linear,
        multilevel: bool,
        tolerances,
        rtol: float,
        relaxed,
        keeps_levels: bool,
        user_forces=None,
        rigid_bodies=None,
    ):
        self.scale, real = natural_scale(coupled), coupled.real
        parts = coupled, sparsity, substructuring, contact, linear, multilevel
        super().__init__(*parts, scale=self.scale, user_forces=user_forces, rigid_bodies=rigid_bodies)
        self._tolerances, self._rtol, self._relaxed = tolerances, rtol, relaxed
        self._keeps_levels = keeps_levels
        self._largest = Sums(coupled.worlds, tolerances.ratio.shape[1], real, coupled.device, largest=True)
        self._worst = wp.zeros(coupled.worlds, dtype=real, device=coupled.device)
        self._compare, self._confirm = coupled_pcg.confirm_kernels(real, linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, self._compare, self._confirm, *self._largest.kernels]

    @timer("pcg")
    def solve(self, system, islands, after_cycle: Callable[[], None] | None = None) -> None:
        """Compute directions; see `PCG.solve` and, for `after_cycle`, `PCG.iterate`."""
        self.begin(system, islands.iteration if self._keeps_levels else None)
        wp.capture_while(self.busy, lambda: self.reduce(system, islands, after_cycle))

    def reduce(self, system, islands, after_cycle: Callable[[], None] | None) -> None:
        """Iterate to the forcing term, then test the residual tolerance."""
        few = self._relaxed
        self.iterate(system, after_cycle)
        self.compare(system, islands)
        self._largest(self._tolerances.ratio, self._worst)
        if few:
            few.count(SPARE * self._rtol, self._tolerances.ratio, islands)
        number, most = (few.number, int(SPARE * few.most)) if few else (self._unread[0], 0)
        inputs = [self._worst, system.goal, number, most, FARTHEST, system.limit]
        outputs = [system.forcing, system.wanted, self.busy]
        wp.launch(self._confirm, self.coupled.worlds, inputs, outputs, device=self.coupled.device)

    def compare(self, system, islands) -> None:
        """Write the ratios of linear residuals over tolerances, in worlds with a finished solve."""
        tolerances = self._tolerances
        inputs = [self.rest, tolerances.blocks, system.wanted, self.coupled.blocks, self._unit]
        self._launch(self._compare, inputs, [self.z, tolerances.ratio])  # worlds that continue overwrite z
        tolerances.sum_up(self.z, self._rtol, islands, *self._unread)
