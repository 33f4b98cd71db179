"""Newton's method on rod groups with the system assembled in blocks, for solvers that need the whole matrix."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear import rod_matrix
from ddg_warp.solve.newton.rod_newton import NewtonOptions, RodNewton
from ddg_warp.timers import timer


class AssembledNewton(RodNewton):
    """Newton's method with the matrix of every node in memory; see `RodNewton` and `kernels.linear.rod_matrix`.

    Args:
        stored: scalar type of the blocks, if it differs from the elements'.

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
        split: bool = False,
        stored=None,
    ):
        super().__init__(model, group, options, linear, midpoint, split)
        kind, self.stored = group.kind, stored or self.linear
        self.blocks = self.vectors(3 * kind.block**2)
        self.islands.edges_rotated.fill_(1)  # `base` is the start of every step
        self._assemble = rod_matrix.assemble_kernel(kind, self.real, self.linear, self.exact_from, self.stored)

    def vectors(self, rows: int | None = None) -> wp.array:
        """Return zeros of the linear algebra for every node, by default as many as its dofs."""
        group = self.group
        return device_arrays.allocate((rows or group.kind.block, group.nodes, group.columns), self.stored, self.device)

    @timer("assemble")
    def assemble_blocks(self) -> None:
        """Assemble the blocks of active rods."""
        group = self.group
        wp.launch(
            self._assemble,
            (-(-group.columns // rod_matrix.TILE), group.nodes, min(rod_matrix.TILE, group.columns)),
            [self.factor, self.geometric, group.count, self.mass, self.rotary, group.fixed, *self.islands.arrays]
            + [int(self.reuse)],
            [self.blocks],
            device=self.device,
        )
