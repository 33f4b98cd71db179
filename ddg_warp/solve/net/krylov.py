"""Preconditioned conjugate gradients on all worlds of a net, on a device; see `kernels.solve.krylov`."""

import math
from functools import partial

import numpy as np
import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.net.outliers import FARTHEST
from ddg_warp.kernels.solve import krylov
from ddg_warp.solve.net.multilevel import Multilevel
from ddg_warp.solve.net.system import Sums

SPARE = 0.5  # of the tolerance, and of those that may be out of it, what the last linear solve of a step may leave


def natural_scale(net) -> float:
    """Power of two by which forces and displacements are multiplied so that their products are of the size of one.

    Stretching an element of the coupled system by its length takes w k, measure times stiffness [J]. At lengths of 1e-9 m that is
    1e-25 J, and products of residuals and directions at a tolerance of 1e-8 lie beyond float32.
    """
    energies = [
        float(np.median(part.parameters["measure"])) * float(np.median(part.parameters["stiffness"]))
        for part in net.sets
        if part.term.name.endswith("_stretch") and {"measure", "stiffness"} <= set(part.parameters.values)
    ]
    largest = max(energies, default=1.0)
    return 2.0 ** round(-0.5 * math.log2(largest)) if largest > 0.0 else 1.0


class ConjugateGradients:
    """H d = r in the worlds that want it, to a residual as small as `forcing` says, in the norm of the preconditioner.

    Args:
        newton: a `NetNewton`, or what has its names, whose matrix, residual, direction and chains these are.
        multilevel: whether levels precondition what chains leave, or all; see `kernels.solve.levels`.
        scale: residuals and directions are multiplied by it on the way, a power of two, so that products of them neither underflow nor
            overflow in the precision of H; see `natural_scale`.
        indefinite: whether H may be.

    Attributes:
        rest: the residual, scaled; z: preconditioned; p: the search direction; product: H p; inverse: of the diagonal blocks.
        rho_first, total: squares of the norm of the first and of the last residual; sum: of values of blocks, world by world.
    """

    def __init__(self, newton, multilevel: bool, indefinite: bool = False, scale: float = 1.0):
        self._scale, self._unit = newton.linear(scale), newton.linear(1.0 / scale)
        self.newton, net, linear, device = newton, newton.net, newton.linear, newton.device
        H, M = wp.types.vector(3, linear), wp.types.matrix((3, 3), linear)
        self.rest, self.z, self.p, self.product = (wp.zeros(newton.all, dtype=H, device=device) for _ in range(4))
        self.inverse = wp.zeros(newton.all, dtype=M, device=device)
        self.rho, self.rho_first, self.total, self.curvature = (
            wp.zeros(newton.worlds, dtype=linear, device=device) for _ in range(4)
        )
        self.busy = wp.zeros(1, dtype=int, device=device)
        self._unread = [wp.zeros(newton.worlds, dtype=int, device=device) for _ in range(2)]
        self.sum = Sums(newton.worlds, net.blocks, linear, device)
        self._invert, self._start, self._begin, *self._cycle = krylov.solver_kernels(linear, indefinite)
        self._more = newton.contact.diagonal if newton.contact else wp.zeros(0, dtype=M, device=device)
        self.levels = Multilevel(net, newton.system, linear) if multilevel else None
        self._limit = max(200, 100 * math.isqrt(net.blocks))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        levels = self.levels.kernels if self.levels else []
        return [self._invert, self._start, self._begin, *self._cycle, *self.sum.kernels, *levels]

    def solve(self) -> None:
        """Directions; worlds where H or its preconditioner is not definite are noted, and end with what has been found so far."""
        newton = self.newton
        table, blocks, wanted, anew = newton.system, newton.net.blocks, newton.islands.wanted, newton.anew.wanted
        self._launch(
            self._invert,
            [newton.matrix, table.diagonal, newton.barred, anew, blocks, table.positions, self._more],
            [self.inverse],
        )
        self._launch(
            self._start,
            [newton.right, self.inverse, table.diagonal, newton.barred, wanted, blocks, self._scale],
            [self.rest, newton.direction, self.p, newton.krylov_dots],
        )
        if newton.chains:
            newton.chains.prepare(newton.matrix, newton.fixed, anew, self._unread[0])
        if self.levels:
            self.levels.prepare(newton.matrix, newton.fixed, anew)
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

    def precondition(self, z: wp.array) -> None:
        """What chains and levels make of z, which holds the residual times the inverses of the diagonal blocks."""
        newton = self.newton
        wanted, dots = newton.islands.wanted, newton.krylov_dots
        if newton.chains:
            newton.chains.apply(newton.matrix, self.rest, newton.barred, wanted, z, dots)
        if self.levels:
            self.levels.apply(self.rest, newton.barred, wanted, z, dots)

    def cycle(self) -> None:
        """One iteration."""
        newton = self.newton
        blocks, wanted, dots = newton.net.blocks, newton.islands.wanted, newton.krylov_dots
        _, advance, turn, test = self._cycle
        self.multiply(self.p)
        self.sum(dots, self.curvature)
        self._launch(
            advance,
            [self.p, self.product, self.inverse, newton.system.diagonal, newton.barred, self.rho, self.curvature]
            + [newton.iterations, wanted, blocks, self._unit],
            [newton.direction, self.rest, self.z, dots, self.busy],
        )
        self.precondition(self.z)
        self.sum(dots, self.total)
        self._launch(turn, [self.z, self.total, self.rho, newton.barred, wanted, blocks], [self.p])
        wp.launch(
            test,
            newton.worlds,
            [self.total, self.curvature, self.rho_first, newton.forcing, self._limit],
            [self.rho, newton.iterations, newton.indefinite, wanted, self.busy],
            device=newton.device,
        )

    def multiply(self, p: wp.array) -> None:
        """H p on dofs that are not barred, and p . H p block by block; contact's part is in no matrix."""
        newton, contact = self.newton, self.newton.contact
        own = self.multiply_bands if newton.chains and newton.chains.banded else self.multiply_matrix
        if not contact:
            own(p)
            return
        arrays.side_by_side([partial(own, p), partial(contact.spread, p)], newton.device)
        contact.settle(p, self.product)

    def multiply_bands(self, p: wp.array) -> None:
        """The same without contact, where what lies along rods is in bands."""
        newton = self.newton
        wanted, dots = newton.islands.wanted, newton.krylov_dots
        newton.chains.product(newton.matrix, p, newton.barred, wanted, self.product, dots)

    def multiply_matrix(self, p: wp.array) -> None:
        """The same without contact, where none of H lies in bands."""
        newton = self.newton
        table, wanted = newton.system, newton.islands.wanted
        self._launch(
            self._cycle[0],
            [newton.matrix, table.columns, table.slices, newton.barred, p, wanted, newton.net.blocks, table.positions],
            [self.product, newton.krylov_dots],
        )

    def _launch(self, kernel, inputs: list, outputs: list) -> None:
        """One thread for each block of every world."""
        wp.launch(kernel, self.newton.all, inputs, outputs, device=self.newton.device)


class Directions(ConjugateGradients):
    """Those of a `NetNewton`, as exactly as its `forcing` and `goal` say; `scale` is that of `ConjugateGradients`."""

    def __init__(self, newton, multilevel: bool):
        self.scale = natural_scale(newton.net)
        super().__init__(newton, multilevel, scale=self.scale)
        real = newton.real
        self._worst = Sums(newton.worlds, newton.allowed.ratio.shape[1], real, newton.device, largest=True)
        self._compare, self._confirm = krylov.confirm_kernels(real, newton.linear)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, self._compare, self._confirm, *self._worst.kernels]

    def iterate(self) -> None:
        """The same, and on where the tolerance says that the residual is not small."""
        wp.capture_while(self.busy, self.reduce)

    def reduce(self) -> None:
        """Until one of the two says so."""
        newton, few = self.newton, self.newton.outliers
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
            [newton.forcing, newton.islands.wanted, self.busy],
            device=newton.device,
        )

    def compare(self) -> None:
        """Ratios of `NetNewton.allowed` by what a solve has left, of worlds that are done."""
        newton, allowed = self.newton, self.newton.allowed
        inputs = [self.rest, allowed.blocks, newton.islands.wanted, newton.net.blocks, self._unit]
        self._launch(self._compare, inputs, [self.z, allowed.ratio])  # z is written anew by worlds that go on
        allowed.sum_up(self.z, newton.options.rtol, newton.islands, *self._unread)

    def cycle(self) -> None:
        """One iteration."""
        super().cycle()
        self.newton.watch()
