"""Newton's method on rod groups with the system assembled in blocks, for solvers that need the whole matrix."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.errors import SceneError
from ddg_warp.kernels.linear import rod_matrix
from ddg_warp.kernels.newton import line_search, rod_iterate
from ddg_warp.solve.linear.cyclic_reduction import Elimination
from ddg_warp.solve.newton.rod_newton import FROZEN, FROZEN_ONLY, NewtonOptions, RodNewton
from ddg_warp.timers import timer


class AssembledNewton(RodNewton):
    """Newton's method with the matrix of every node in memory; see `RodNewton` and `kernels.linear.rod_matrix`.

    Args:
        ranges: ranges of nodes by which a rod is summed; see `kernels.newton.line_search`.

    Attributes:
        blocks: D, E and F of every node, (3 block^2, nodes, columns).
    """

    def __init__(
        self,
        model,
        group,
        options: NewtonOptions,
        linear=None,
        midpoint: bool = False,
        mixed_axial: bool = False,
        ranges: int = 1,
    ):
        super().__init__(model, group, options, linear, midpoint, mixed_axial)
        kind, self.ranges = group.kind, ranges
        self.blocks = self.vectors(3 * kind.block**2)
        self.islands.edges_rotated.fill_(1)  # `base` is the start of every step
        self.partial = device_arrays.allocate((4, ranges, group.columns), self.real, self.device)
        self._assemble = rod_matrix.assemble_kernel(kind, self.real, self.linear, self.exact_from)
        self._weigh, self._gauge = line_search.sum_kernels(kind, self.real, self.linear)
        self._decide_action, self._take = line_search.decide_kernels(kind, self.real, self.exact, self.psd == "none")

    def _sides(self, mixed_axial: bool) -> int:
        """Return zero: the matrix is assembled, not swept."""
        return 0

    def _prepare_sweep(self, mixed_axial: bool) -> None:
        """Prepare nothing."""
        self._sums = None

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture, except the kernels of `direct` and `move`."""
        return [*self.kernels_around, self._assemble, self._weigh, self._gauge, self._decide_action, self._take]

    def vectors(self, rows: int | None = None) -> wp.array:
        """Return zeros of the linear algebra for every node, by default as many as its dofs."""
        group = self.group
        return device_arrays.allocate((rows or group.kind.block, group.nodes, group.columns), self.linear, self.device)

    def sweep(self) -> None:
        """Assemble, decide, solve for a direction and take it."""
        self.assemble_blocks()
        self.decide_action()
        self.direct()
        self.take()
        self.move()

    @timer("assemble")
    def assemble_blocks(self) -> None:
        """Assemble the blocks of active rods."""
        group = self.group
        wp.launch(
            self._assemble,
            (-(-group.columns // rod_matrix.TILE), group.node_threads[0], min(rod_matrix.TILE, group.columns)),
            [self.elements.factor, self.elements.geometric, group.count, self.loading.mass, self.loading.rotary]
            + [group.fixed, *self.islands.arrays, int(self.reuse)],
            [self.blocks],
            device=self.device,
        )

    @timer("line search")
    def decide_action(self) -> None:
        """Stop rods, reject their iterates, or request a direction."""
        options = self.options
        self._launch(
            self._weigh,
            self.ranges,
            [self.rhs, self.norms.change, self.norms.rounding_error]
            + [self.run, self.group.count, self.islands.status, self.ranges],
            [self.partial],
        )
        wp.launch(
            self._decide_action,
            self.group.columns,
            [self.partial, self.ranges, options.floor_factor * self.eps, options.max_iterations, options.max_halvings]
            + self.islands.arrays,
            device=self.device,
        )

    @timer("step length")
    def take(self) -> None:
        """Compute the step lengths along the directions."""
        group = self.group
        self._launch(
            self._gauge,
            self.ranges,
            [self.rhs, self.direction, self.iterates.x, group.count, self.islands.needs_direction, self.ranges],
            [self.iterates.base, self.partial],
        )
        wp.launch(
            self._take,
            group.columns,
            [self.partial, self.ranges, self.options.rotation_cap, *self.islands.arrays],
            device=self.device,
        )

    def _launch(self, kernel, size: int, inputs: list, outputs: list) -> None:
        """Launch one thread for each of `size` ranges or nodes of every rod."""
        wp.launch(kernel, (size, self.group.columns), inputs, outputs, device=self.device)


class EliminationNewton(AssembledNewton):
    """Newton's method on closed rods: the assembled system by block LDL^T, one thread a rod; see `kernels.linear.closed_rod`."""

    def __init__(self, model, group, options: NewtonOptions, linear=None, midpoint: bool = False):
        super().__init__(model, group, options, linear, midpoint)
        iteration = self.islands.iteration if self.reuse else None
        size = group.nodes, group.columns
        self.solver = Elimination(group.kind, *size, self.linear, self.device, iteration)
        self._adjust = rod_iterate.adjust_kernel(group.kind, self.real, self.linear, assembled=True)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, *self.solver.kernels, self._adjust]

    @timer("block LDL^T")
    def direct(self) -> None:
        """Compute directions by the factors."""
        count, islands = self.group.count, self.islands
        self.solver.solve(self.blocks, self.rhs, count, islands.needs_direction, self.direction, islands.lost_pivots)

    def move(self) -> None:
        """Apply the pending update of every rod."""
        self.adjust()


class RodModifiedNewton(EliminationNewton):
    """Modified Newton: the matrix of a step's first iterate is projected, factorised once and used for the whole step.

    An iteration costs a gradient and a substitution instead of a sweep, and converges linearly. This pays where the matrix hardly
    changes within a step: small steps and loose tolerances.
    """

    reuse = True

    def __init__(self, model, group, options: NewtonOptions, linear=None, midpoint: bool = False):
        if options.psd not in FROZEN:
            raise SceneError(FROZEN_ONLY.format(options.psd))
        super().__init__(model, group, options, linear, midpoint)

    @property
    def definite(self) -> bool:
        """True: a frozen matrix drops compression."""
        return True

    def automatic_psd(self) -> str:
        """Return the mode of the frozen matrix."""
        return "gauss_newton"
