"""Preconditioned conjugate gradients on all worlds of a net, on a device; see `kernels.solve.krylov`."""

import math

import warp as wp

from ddg_warp.kernels.solve import krylov
from ddg_warp.solve.net.multilevel import Multilevel
from ddg_warp.solve.net.system import Sums


class ConjugateGradients:
    """Directions of a `NetNewton`: H d = r in the worlds that want one, as exactly as its `forcing` and `goal` say.

    Args:
        newton: whose matrix, residual, direction and chains these are.
        multilevel: whether levels precondition what chains leave, or all; see `kernels.solve.levels`.

    Attributes:
        rest: the residual; z: preconditioned; p: the search direction; product: H p; inverse: of the diagonal blocks.
    """

    def __init__(self, newton, multilevel: bool):
        self.newton, net, linear, device = newton, newton.net, newton.linear, newton.device
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
        self.rest, self.z, self.p, self.product = (wp.zeros(newton.all, dtype=H, device=device) for _ in range(4))
        self.inverse = wp.zeros(newton.all, dtype=M, device=device)
        self.rho, self.rho_first, self.total, self.curvature = (
            wp.zeros(newton.worlds, dtype=linear, device=device) for _ in range(4)
        )
        self.busy = wp.zeros(1, dtype=int, device=device)
        self._unread = [wp.zeros(newton.worlds, dtype=int, device=device) for _ in range(2)]
        self._sum = Sums(newton.worlds, net.blocks, linear, device)
        self._worst = Sums(newton.worlds, newton.allowed.ratio.shape[1], newton.real, device, largest=True)
        self._invert, self._start, self._begin, *self._cycle = krylov.solver_kernels(linear)
        self._compare, self._confirm = krylov.confirm_kernels(newton.real, linear)
        self.levels = Multilevel(net, newton.system, linear) if multilevel else None
        self._limit = max(200, 100 * math.isqrt(net.blocks))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        own = [self._invert, self._start, self._begin, *self._cycle, self._compare, self._confirm]
        sums = [(kernel, krylov.THREADS) for part in (self._sum, self._worst) for kernel in part.kernels]
        return [*own, *sums, *(self.levels.kernels if self.levels else [])]

    def solve(self) -> None:
        """Directions; worlds where H or its preconditioner is not definite are noted, and end with what has been found so far."""
        newton = self.newton
        table, blocks, wanted, anew = newton.system, newton.net.blocks, newton.islands.wanted, newton.anew.wanted
        self._launch(
            self._invert,
            [newton.matrix, table.diagonal, newton.fixed, anew, blocks, table.positions],
            [self.inverse],
        )
        self._launch(
            self._start,
            [newton.right, self.inverse, wanted, blocks],
            [self.rest, newton.direction, self.p, newton.krylov_dots],
        )
        if newton.chains:
            newton.chains.prepare(newton.matrix, newton.fixed, anew, self._unread[0])
        if self.levels:
            self.levels.prepare(newton.matrix, newton.fixed, anew)
        self.precondition(self.p)
        self._sum(newton.krylov_dots, self.total)
        self.busy.zero_()
        wp.launch(
            self._begin,
            newton.worlds,
            [self.total],
            [wanted, self.rho, self.rho_first, newton.iterations, newton.indefinite, self.busy],
            device=newton.device,
        )
        wp.capture_while(self.busy, self.reduce)

    def reduce(self) -> None:
        """Iterate until the residual is small in the norm of the preconditioner, and go on where the tolerance says that it is not."""
        newton = self.newton
        allowed, wanted, rtol = newton.allowed, newton.islands.wanted, newton.options.rtol
        wp.capture_while(self.busy, self.cycle)
        self._launch(self._compare, [self.rest, allowed.blocks, wanted, newton.net.blocks], [allowed.ratio])
        allowed.sum_up(self.rest, rtol, newton.islands, *self._unread)
        self._worst(allowed.ratio, newton.worst)
        wp.launch(
            self._confirm,
            newton.worlds,
            [newton.worst, newton.goal, newton.options.linear_rtol],
            [newton.forcing, wanted, self.busy],
            device=newton.device,
        )

    def precondition(self, z: wp.array) -> None:
        """What chains and levels make of z, which holds the residual times the inverses of the diagonal blocks."""
        newton = self.newton
        wanted, dots = newton.islands.wanted, newton.krylov_dots
        if newton.chains:
            newton.chains.apply(newton.matrix, self.rest, wanted, z, dots)
        if self.levels:
            self.levels.apply(self.rest, newton.fixed, wanted, z, dots)

    def cycle(self) -> None:
        """One iteration."""
        newton = self.newton
        blocks, wanted, dots = newton.net.blocks, newton.islands.wanted, newton.krylov_dots
        _, advance, turn, test = self._cycle
        self.busy.zero_()
        if newton.chains and newton.chains.banded:
            newton.chains.product(newton.matrix, self.p, newton.fixed, wanted, self.product, dots)
        else:
            self.multiply(self.p)
        self._sum(dots, self.curvature)
        self._launch(
            advance,
            [self.p, self.product, self.inverse, self.rho, self.curvature, newton.iterations, wanted, blocks],
            [newton.direction, self.rest, self.z, dots],
        )
        self.precondition(self.z)
        self._sum(dots, self.total)
        self._launch(turn, [self.z, self.total, self.rho, wanted, blocks], [self.p])
        wp.launch(
            test,
            newton.worlds,
            [self.total, self.curvature, self.rho_first, newton.forcing, self._limit],
            [self.rho, newton.iterations, newton.indefinite, wanted, self.busy],
            device=newton.device,
        )
        newton.watch()

    def multiply(self, p: wp.array) -> None:
        """H p on free dofs where none of H lies in bands, and p . H p block by block."""
        newton = self.newton
        table, wanted = newton.system, newton.islands.wanted
        self._launch(
            self._cycle[0],
            [newton.matrix, table.columns, table.slices, newton.fixed, p, wanted, newton.net.blocks, table.positions],
            [self.product, newton.krylov_dots],
        )

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        """One thread for each block of every world."""
        wp.launch(kernel, self.newton.all, inputs, outputs, device=self.newton.device)
