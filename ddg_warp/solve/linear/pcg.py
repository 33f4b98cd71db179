"""Preconditioned conjugate gradients on all worlds of the coupled system, on a device; see `kernels.linear.coupled_pcg`."""

import math
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
    """Preconditioned conjugate gradients for H d = r, to the forcing term `forcing` in the preconditioner norm.

    Args:
        newton: a `CoupledNewton`, or an object with the same names, whose matrix, residual, direction and substructuring are used.
        multilevel: True to add BPX multilevel corrections, or to use these alone; see `kernels.linear.multilevel`.
        scale: power of two by which residuals and directions are scaled, against underflow and overflow of products; see
            `natural_scale`.
        indefinite: True if H may be indefinite.

    Attributes:
        `rest`, `z`: scaled residual, preconditioned residual.
        `p`, `product`: search direction, H p.
        `inverse`: inverse diagonal blocks.
        `rho_first`, `total`: squared norms of the first and the last residual.
        `sum`: sums of block values over each world.
    """

    def __init__(self, newton, multilevel: bool, indefinite: bool = False, scale: float = 1.0):
        self._scale, self._unit = newton.linear(scale), newton.linear(1.0 / scale)
        self.newton, coupled, linear, device = newton, newton.coupled, newton.linear, newton.device
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
        self.rest, self.z, self.p, self.product = (wp.zeros(newton.all, dtype=H, device=device) for _ in range(4))
        self.inverse = wp.zeros(newton.all, dtype=M, device=device)
        self.rho, self.rho_first, self.total, self.curvature = (
            wp.zeros(newton.worlds, dtype=linear, device=device) for _ in range(4)
        )
        self.busy = wp.zeros(1, dtype=int, device=device)
        self._unread = [wp.zeros(newton.worlds, dtype=int, device=device) for _ in range(2)]
        self.sum = Sums(newton.worlds, coupled.blocks, linear, device)
        self._invert, self._start, self._begin, *self._cycle = coupled_pcg.solver_kernels(linear, indefinite)
        self._more = newton.contact.diagonal if newton.contact else wp.zeros(0, dtype=M, device=device)
        self.levels = Multilevel(coupled, newton.system, linear) if multilevel else None
        self._limit = max(200, 100 * math.isqrt(coupled.blocks))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        levels = self.levels.kernels if self.levels else []
        return [self._invert, self._start, self._begin, *self._cycle, *self.sum.kernels, *levels]

    @timer("pcg")
    def solve(self) -> None:
        """Compute directions. Worlds with an indefinite H or preconditioner are marked and keep the present approximation."""
        newton = self.newton
        table, blocks, wanted, outdated = (
            newton.system,
            newton.coupled.blocks,
            newton.islands.needs_direction,
            newton.anew.needs_direction,
        )
        self._launch(
            self._invert,
            [newton.matrix, table.diagonal, newton.inactive_mask, outdated, blocks, table.positions, self._more],
            [self.inverse],
        )
        self._launch(
            self._start,
            [newton.rhs, self.inverse, table.diagonal, newton.inactive_mask, wanted, blocks, self._scale],
            [self.rest, newton.direction, self.p, newton.krylov_dots],
        )
        if newton.chains:
            newton.chains.prepare(newton.matrix, newton.fixed, outdated, self._unread[0])
        if self.levels:
            self.levels.prepare(newton.matrix, newton.fixed, outdated)
        self.precondition(self.p)
        self.sum(newton.krylov_dots, self.total)
        self.busy.zero_()
        wp.launch(
            self._begin,
            newton.worlds,
            [self.total],
            [wanted, self.rho, self.rho_first, newton.iterations, newton.indefinite, self.busy],
            device=newton.device,
        )
        self.iterate()

    def iterate(self) -> None:
        """Iterate until the residual is small in the norm of the preconditioner."""
        wp.capture_while(self.busy, self.cycle)

    @timer("preconditioner")
    def precondition(self, z: wp.array) -> None:
        """Apply substructuring and multilevel to z, on entry the residual times inverse diagonal blocks; write r . z."""
        newton = self.newton
        wanted, dots = newton.islands.needs_direction, newton.krylov_dots
        if newton.chains:
            newton.chains.apply(newton.matrix, self.rest, newton.inactive_mask, wanted, z, dots)
        if self.levels:
            self.levels.apply(self.rest, newton.inactive_mask, wanted, z, dots)

    def cycle(self) -> None:
        """Run one iteration."""
        newton = self.newton
        blocks, wanted, dots = newton.coupled.blocks, newton.islands.needs_direction, newton.krylov_dots
        _, advance, turn, test = self._cycle
        self.multiply(self.p)
        self.sum(dots, self.curvature)
        self._launch(
            advance,
            [self.p, self.product, self.inverse, newton.system.diagonal, newton.inactive_mask, self.rho, self.curvature]
            + [newton.iterations, wanted, blocks, self._unit],
            [newton.direction, self.rest, self.z, dots, self.busy],
        )
        self.precondition(self.z)
        self.sum(dots, self.total)
        self._launch(turn, [self.z, self.total, self.rho, newton.inactive_mask, wanted, blocks], [self.p])
        wp.launch(
            test,
            newton.worlds,
            [self.total, self.curvature, self.rho_first, newton.forcing, self._limit],
            [self.rho, newton.iterations, newton.indefinite, wanted, self.busy],
            device=newton.device,
        )

    @timer("product")
    def multiply(self, p: wp.array) -> None:
        """Write H p on active dofs, and p . H p block by block; no matrix has the contact terms."""
        newton, contact = self.newton, self.newton.contact
        multiply_elements = self.multiply_bands if newton.chains and newton.chains.banded else self.multiply_matrix
        if not contact:
            multiply_elements(p)
            return
        device_arrays.side_by_side([partial(multiply_elements, p), partial(contact.spread, p)], newton.device)
        contact.settle(p, self.product)

    def multiply_bands(self, p: wp.array) -> None:
        """Write the product without contact, with elements along rods stored in bands."""
        newton = self.newton
        wanted, dots = newton.islands.needs_direction, newton.krylov_dots
        newton.chains.product(newton.matrix, p, newton.inactive_mask, wanted, self.product, dots)

    def multiply_matrix(self, p: wp.array) -> None:
        """Write the product without contact, with all of H in the sparse matrix."""
        newton = self.newton
        table, wanted = newton.system, newton.islands.needs_direction
        self._launch(
            self._cycle[0],
            [
                newton.matrix,
                table.columns,
                table.slices,
                newton.inactive_mask,
                p,
                wanted,
                newton.coupled.blocks,
                table.positions,
            ],
            [self.product, newton.krylov_dots],
        )

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        """Launch one thread a block of every world."""
        wp.launch(kernel, self.newton.all, inputs, outputs, device=self.newton.device)


class NewtonPCG(PCG):
    """Directions of a `CoupledNewton` to the accuracy of `forcing` and `goal`; `scale` as of `PCG`."""

    def __init__(self, newton, multilevel: bool):
        self.scale = natural_scale(newton.coupled)
        super().__init__(newton, multilevel, scale=self.scale)
        real = newton.real
        self._worst = Sums(newton.worlds, newton.allowed.ratio.shape[1], real, newton.device, largest=True)
        self._compare, self._confirm = coupled_pcg.confirm_kernels(real, newton.linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, self._compare, self._confirm, *self._worst.kernels]

    def iterate(self) -> None:
        """Iterate until the residual is small in the norm of the preconditioner and by the tolerance."""
        wp.capture_while(self.busy, self.reduce)

    def reduce(self) -> None:
        """Iterate to the forcing term, then test the residual tolerance."""
        newton, few = self.newton, self.newton.unconverged_fraction
        super().iterate()
        self.compare()
        self._worst(newton.allowed.ratio, newton.worst)
        if few:
            few.count(SPARE * newton.options.rtol)
        number, most = (few.number, int(SPARE * few.most)) if few else (self._unread[0], 0)
        wp.launch(
            self._confirm,
            newton.worlds,
            [newton.worst, newton.goal, number, most, FARTHEST, newton.limit],
            [newton.forcing, newton.islands.needs_direction, self.busy],
            device=newton.device,
        )

    def compare(self) -> None:
        """Write ratios of `CoupledNewton.allowed` for linear residuals, in worlds with a finished solve."""
        newton, allowed = self.newton, self.newton.allowed
        inputs = [self.rest, allowed.blocks, newton.islands.needs_direction, newton.coupled.blocks, self._unit]
        self._launch(self._compare, inputs, [self.z, allowed.ratio])  # worlds that continue overwrite z
        allowed.sum_up(self.z, newton.options.rtol, newton.islands, *self._unread)

    def cycle(self) -> None:
        """Run one iteration, and watch the length of directions."""
        super().cycle()
        self.newton.watch()
