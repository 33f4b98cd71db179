"""Newton's method on rod groups with preconditioned conjugate gradients: closed rods, and open ones as a check of the sweep."""

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.linear import rod_matrix, rod_pcg
from ddg_warp.kernels.newton import line_search
from ddg_warp.solve.newton.rod_newton import FROZEN, FROZEN_ONLY, NewtonOptions
from ddg_warp.solve.newton.rod_newton_assembled import AssembledNewton
from ddg_warp.timers import timer


class PcgNewton(AssembledNewton):
    """Newton's method with the system assembled in blocks and solved by conjugate gradients; see `RodNewton`.

    Args:
        preconditioner: "jacobi", "block_jacobi", or "chain": block LDL^T of the open rod, exact without closure; a closed rod takes
            a few iterations.
    """

    def __init__(
        self, model, group, options: NewtonOptions, preconditioner: str = "chain", linear=None, midpoint: bool = False
    ):
        if preconditioner not in rod_pcg.PRECONDITIONERS:
            raise SceneError(f"preconditioner {preconditioner!r}: it is one of {', '.join(rod_pcg.PRECONDITIONERS)}")
        if preconditioner != "chain" and options.psd in ("progressive", "none"):
            raise SceneError(
                f"psd {options.psd!r}: preconditioner {preconditioner!r} does not detect an indefinite matrix; use 'chain'"
            )
        by_chain = self._by_chain = preconditioner == "chain"
        super().__init__(model, group, options, linear, midpoint)
        kind, device, columns = group.kind, model.wp_device, group.columns
        self.factors = self.vectors(3 * kind.block**2 + kind.block) if by_chain else self.blocks
        self.rest, self.z, self.p, self.q = (self.vectors() for _ in range(4))
        self._repeats = self.psd in ("progressive", "none")
        self.rho, self.rho_first = (wp.zeros(columns, dtype=self.linear, device=device) for _ in range(2))
        self.iterations, self.negative = (wp.zeros(columns, dtype=int, device=device) for _ in range(2))
        self.busy = wp.zeros(1, dtype=int, device=device)
        self.pcg_work = wp.zeros(1, dtype=wp.int64, device=device)
        self._judge = line_search.line_search_kernel(kind, self.real, self.linear)
        self._factor = rod_matrix.factor_kernel(kind, self.linear) if by_chain else None
        self._start, self._product, self._advance = rod_pcg.solver_kernels(kind, self.linear, preconditioner)
        self._repeat = rod_pcg.repeat_kernel(self.real, self.psd == "none") if self._repeats else None
        self._take = rod_pcg.take_kernel(kind, self.real, self.linear)
        self._limit = 10 * kind.block * group.nodes

    @property
    def definite(self) -> bool:
        """True if matrices always drop compression: PCG needs definite ones where it cannot detect indefinite ones."""
        return self.psd not in ("progressive", "none")

    def automatic_psd(self) -> str:
        """Return the `psd` mode that suits the rods: Gauss-Newton where an indefinite matrix would go undetected."""
        return super().automatic_psd() if self._by_chain and not self.reuse else "gauss_newton"

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        kernels = [self._assemble, self._judge, self._start, self._product, self._advance, self._take]
        return [*self.kernels_around, *kernels, *filter(None, (self._factor, self._repeat))]

    def sweep(self) -> None:
        """Assemble, decide, solve for a direction and take it."""
        self.assemble()
        self._repeat_indefinite(0)
        self.direct()
        self._repeat_indefinite(1)
        group, device = self.group, self.device
        wp.launch(
            self._take,
            group.columns,
            [self.rhs, self.iterations, group.count, self.options.rotation_cap],
            [
                self.direction,
                group.fixed,
                group.anchor,
                self.base,
                self.x,
                self.theta,
                *self.islands.arrays,
                self.pcg_work,
            ],
            device=device,
        )

    def _repeat_indefinite(self, done: int) -> None:
        """Repeat the iterate of rods with an indefinite exact Hessian, before or after directions are computed."""
        if self._repeat:
            wp.launch(
                self._repeat,
                self.group.columns,
                [done, *self.islands.arrays, self.negative],
                device=self.device,
            )

    def assemble(self) -> None:
        """Assemble blocks and residuals of active rods, run the line search, and factorise where a direction is needed."""
        group, options, device = self.group, self.options, self.device
        self.assemble_blocks()
        wp.launch(
            self._judge,
            group.columns,
            [self.rhs, self.energy_change, self.energy_noise, group.count, options.floor_factor * self.eps]
            + [options.max_iterations, options.max_halvings, self.direction, group.fixed, group.anchor, self.base]
            + [self.x, self.theta, self.frame, *self.islands.arrays],
            device=device,
        )
        if self._factor:
            self.factorise()

    @timer("factorise")
    def factorise(self) -> None:
        """Factorise the open rods, without closure, that need a direction."""
        group, islands = self.group, self.islands
        wp.launch(
            self._factor,
            group.columns,
            [self.blocks, group.count, islands.needs_direction, islands.iteration, int(self.reuse)],
            [self.factors, self.negative if self._repeat else islands.lost_pivots_total],
            device=self.device,
        )

    @timer("pcg")
    def direct(self) -> None:
        """Compute directions by conjugate gradients."""
        group = self.group
        self.busy.zero_()
        wp.launch(
            self._start,
            group.columns,
            [self.blocks, self.factors, group.count, self.islands.needs_direction, self.rhs],
            [self.rest, self.direction, self.z, self.p, self.rho, self.rho_first, self.iterations, self.busy],
            device=self.device,
        )
        wp.capture_while(self.busy, self._iterate_pcg)

    def _iterate_pcg(self) -> None:
        group, device = self.group, self.device
        wp.launch(
            self._product,
            (group.nodes, group.columns),
            [self.blocks, self.p, group.count, self.islands.needs_direction],
            [self.q, self.busy],
            device=device,
        )
        wp.launch(
            self._advance,
            group.columns,
            [self.blocks, self.factors, group.count, self.options.linear_rtol, self._limit],
            [self.q, self.rest, self.direction, self.z, self.p, self.rho, self.rho_first]
            + [self.iterations, self.islands.needs_direction, self.busy, self.negative],
            device=device,
        )

    def pcg_iterations(self) -> int:
        """Return the iterations of all solves so far."""
        return int(np.asarray(self.pcg_work.numpy())[0])


class RodModifiedNewton(PcgNewton):
    """Modified Newton: the matrix of a step's first iterate is projected, factorised once and used for the whole step.

    An iteration costs a gradient and a substitution instead of a sweep, and converges linearly. This pays where the matrix hardly
    changes
    within a step: small steps and loose tolerances. The frozen matrix of a closed rod omits its closure.
    """

    reuse = True

    def __init__(self, model, group, options: NewtonOptions, linear=None, midpoint: bool = False):
        if options.psd not in FROZEN:
            raise SceneError(FROZEN_ONLY.format(options.psd))
        super().__init__(model, group, options, "chain", linear, midpoint)
        self._direct = rod_matrix.direct_kernel(group.kind, self.linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self.kernels_around, self._assemble, self._judge, self._factor, self._direct, self._take]

    @timer("direction")
    def direct(self) -> None:
        """Compute directions by the factors of the first iterate."""
        wp.launch(
            self._direct,
            self.group.columns,
            [self.factors, self.rhs, self.group.count, self.islands.needs_direction],
            [self.direction],
            device=self.device,
        )
