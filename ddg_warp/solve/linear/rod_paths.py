"""Rod paths of the coupled system on a device: the columns of path nodes that substructuring eliminates."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.linear.rod_band_assembly import layout_type


class RodPaths:
    """Rod paths of a bound `SubstructuringPlan`, in columns of all worlds. Unnamed shapes: see the plan.

    Attributes:
        `places`, `path`: blocks of every path node, and its path.
        `count`: path nodes of the columns of a world; `where`: (blocks,) path node of every block.
        `held`: bits of fixed dofs of path nodes.
        idle: (columns,) nonzero for paths without active dofs in a direction, see `DofMasks`.
        longest, width, columns: path nodes of a column, columns of a world and of all worlds.
        layout: struct of these for kernels, with the positions of blocks in a `SparseSystem`.
    """

    def __init__(self, coupled, plan, sparsity):
        device = coupled.device

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        self.places = device_arrays.upload(plan.places.astype(np.int32), int, device)
        self.path, self.count, self.where = put(plan.path), put(plan.count), put(plan.where)
        self.held = device_arrays.upload(plan.held(coupled.host), wp.uint8, device)
        self.longest, self.width = plan.path.shape
        self.columns = coupled.worlds * self.width
        self.idle = wp.zeros(self.columns, dtype=int, device=device)
        self.layout = layout_type()()
        for name in ("places", "path", "count", "held", "idle"):
            setattr(self.layout, name, getattr(self, name))
        self.layout.diagonal, self.layout.positions = sparsity.diagonal, sparsity.positions

    def allocate(self, rows: int, linear, solves: int = 1) -> wp.array:
        """Return zeros [row][path node][column], for a number of right-hand sides."""
        return device_arrays.allocate((rows, self.longest, solves * self.columns), linear, self.count.device)
