"""Islands: dofs with a common Newton loop, an uncoupled rod or the coupled system of one world.

Solver state of an island is an entry in one of two arrays, `flags` (integers) and `scalars`, each (row, island); rows are named here.
A kernel finds the island from its thread: the column of a rod, the world of the coupled system.

Measured: arguments are copied with every launch of a graph; two arrays instead of thirty save some percent of a step of few rods on a
GPU.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.core import outcome
from ddg_warp.kernels.newton.edge_rotation import STRAIGHT_ROTATION

FLAGS = (
    # The solve: outcome (see `outcome`), accepted iterates, and convergence test of the current iterate
    "status",
    "iteration",
    "not_converged",  # A residual is above tolerance and rounding floor.
    "below_rounding_floor",  # A residual is above tolerance, but within the rounding floor.
    # The line search, from the accepted iterate along the direction
    "energy_buffer",  # Which half of the energy buffer belongs to the accepted iterate.
    "backtracks",
    "needs_direction",  # Whether a direction is to be computed.
    "iterate_action",  # Remaining action on the iterate, see `kernels.newton.rod_iterate`.
    "edges_rotated",  # Whether the iterate came from an edge-rotation update, not a straight one.
    "frames_outdated",  # Whether frames have to be updated before the next step.
    # The matrix: whether compression is dropped, and pivots lost in all iterations and in this one
    "drop_compression",
    "lost_pivots_total",
    "lost_pivots",
    "projected_iterations",  # Iterations of a solve with a projected instead of the exact Hessian.
    "max_projected_iterations",  # Limit of projected iterations.
    # The step: whether it is a cold start (from the last state instead of the predictor), and its progress
    "cold_start",
    "retries",  # Of the current substep, or of the last one of a finished step.
    "failure_status",  # Outcome of the solve that made it fail for good.
    "rotate_predictor",  # Whether the predictor has to rotate edges.
    "substep_accepted",  # Whether this substep succeeded.
    "support_motion_pending",  # Whether supports blocked by contact moved in the last iteration; see `kernels.newton.contact_newton`.
    "ccd_limited",  # Whether CCD has limited the last motion, of the predictor or of an iteration.
    # In float32, see `kernels.newton.line_search`: whether the rounding floor decides and exceeds `ROUNDED` of the loads, the
    # iteration from which it decides anyway, and whether a solve has ended so.
    "doubtful",
    "polished",
    "doubted",
    # In the first column: whether any island is active, whether one rotates edges or updates frames, and, in the coupled system,
    # whether one needs a direction
    "any_active",
    "any_edge_rotation",
    "any_needs_direction",
)
SCALARS = (
    # The quadratic of inertia, coefficient * m |x - target|^2 / 2, and the reciprocal of the solve's step length
    "inertia_coefficient",
    "inverse_step",
    "load_scale",
    "max_residual",  # Largest.
    "step_length",
    "predicted_decrease",  # Predicted decrease of the energy by a full step.
    "residual_norm_sq",  # Squared residual of the accepted iterate.
    "angle_step_left",  # Remaining motion of twist angles along the direction.
    "max_edge_stiffness",  # Largest axial stiffness of an edge in a float32 matrix [N/m]; see `kernels.linear.mixed_axial_force`.
    "straight_rotation_limit",  # Largest edge rotation of a straight update [rad]; see `kernels.newton.edge_rotation`.
    # The fraction of the time step that is done, and of the current substep
    "step_progress",
    "substep_fraction",
    # The largest fraction tried at once, and the interval of a row of poses; see `solve.collision.support_arcs`
    "substep",
    "interval",
)
(
    STATUS,
    ITERATION,
    NOT_CONVERGED,
    BELOW_ROUNDING_FLOOR,
    ENERGY_BUFFER,
    BACKTRACKS,
    NEEDS_DIRECTION,
    ITERATE_ACTION,
    EDGES_ROTATED,
    FRAMES_OUTDATED,
) = range(10)
(
    DROP_COMPRESSION,
    LOST_PIVOTS_TOTAL,
    LOST_PIVOTS,
    PROJECTED_ITERATIONS,
    PROJECTED_LIMIT,
    COLD_START,
    RETRIES,
    FAILURE_STATUS,
    ROTATE_PREDICTOR,
    SUBSTEP_ACCEPTED,
    SUPPORT_MOTION_PENDING,
    CCD_LIMITED,
) = range(10, 22)
DOUBTFUL, POLISHED, DOUBTED = range(22, 25)
ANY_ACTIVE, ANY_EDGE_ROTATION, ANY_NEEDS_DIRECTION = range(25, len(FLAGS))
(
    INERTIA_COEFFICIENT,
    INVERSE_STEP,
    LOAD_SCALE,
    MAX_RESIDUAL,
    STEP_LENGTH,
    PREDICTED_DECREASE,
    RESIDUAL_NORM_SQ,
    ANGLE_STEP_LEFT,
) = range(8)
MAX_EDGE_STIFFNESS, STRAIGHT_ROTATION_LIMIT, STEP_PROGRESS, SUBSTEP_FRACTION, SUBSTEP, INTERVAL = range(8, len(SCALARS))
MAX_PROJECTED_ITERATIONS, LEAST = 30, 0.125  # Projected iterations of substeps larger than this fraction.


class Islands:
    """Solver state of `count` islands; each row is also an attribute, such as `islands.status`.

    Entries are zero at first, except `straight_rotation_limit`, `max_projected_iterations` and step fractions.

    Attributes:
        arrays: `flags` and `scalars`, for kernels.
        signals: the rows whose first entry alone counts.
    """

    def __init__(self, count: int, real, device):
        self.arrays = [
            wp.zeros((len(names), count), dtype=dtype, device=device)
            for names, dtype in ((FLAGS, int), (SCALARS, real))
        ]
        for names, array in zip((FLAGS, SCALARS), self.arrays, strict=True):
            for row, name in enumerate(names):
                setattr(self, name, array[row])
        self.straight_rotation_limit.fill_(STRAIGHT_ROTATION)
        self.substep.fill_(1.0)
        self.interval.fill_(1.0)
        self.max_projected_iterations.fill_(np.iinfo(np.int32).max)
        self.signals = self.arrays[0][ANY_ACTIVE:]
        self.any_active, self.any_edge_rotation, self.any_needs_direction = (self.signals[row, :1] for row in range(3))

    def __len__(self) -> int:
        return self.arrays[0].shape[1]


@cache
def projected_limit_function(real):
    """Return the device function `out_of_patience(flags, scalars, i)`: True if the solve of island i should end.

    It counts projected iterations. Where the exact Hessian is indefinite, an iteration omits second derivatives, and proceeds
    slowly along a curved valley or leaves a saddle. A shorter step, for which inertia makes the Hessian definite, is faster, and
    finds the solution that the motion leads to. After `MAX_PROJECTED_ITERATIONS` such iterations the solve ends, unless the substep
    is `LEAST` already or retries are off.
    """

    @wp.func
    def out_of_patience(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), i: int):
        projected = flags[PROJECTED_ITERATIONS, i] + flags[DROP_COMPRESSION, i]
        flags[PROJECTED_ITERATIONS, i] = projected
        flags[DROP_COMPRESSION, i] = 0
        if projected <= flags[PROJECTED_LIMIT, i] or scalars[SUBSTEP_FRACTION, i] <= real(LEAST) * scalars[SUBSTEP, i]:
            return False
        flags[STATUS, i] = wp.static(outcome.INDEFINITE)
        return True

    return out_of_patience


@cache
def attempt_functions(real, midpoint: bool):
    """Return the device functions `length` and `restart`.

    `length(scalars, i, dt)`: length of the implicit Euler step of the next solve of island i.
    `restart(...)`: reset the line search.
    """

    @wp.func
    def length(scalars: wp.array2d(dtype=real), i: int, dt: real):
        s = dt * scalars[SUBSTEP_FRACTION, i]
        if wp.static(midpoint):
            s *= real(0.5)
        return s

    @wp.func
    def restart(
        flags: wp.array2d(dtype=int),
        scalars: wp.array2d(dtype=real),
        i: int,
        rate: real,
        coefficient: real,
        load_scale: real,
    ):
        scalars[INERTIA_COEFFICIENT, i] = coefficient
        scalars[INVERSE_STEP, i] = rate
        scalars[LOAD_SCALE, i] = load_scale
        flags[STATUS, i] = 0
        flags[ITERATION, i] = 0
        flags[BACKTRACKS, i] = 0
        flags[FRAMES_OUTDATED, i] = 0
        flags[DROP_COMPRESSION, i] = 0
        flags[PROJECTED_ITERATIONS, i] = 0
        flags[NOT_CONVERGED, i] = 0
        flags[BELOW_ROUNDING_FLOOR, i] = 0
        flags[DOUBTFUL, i] = 0
        flags[POLISHED, i] = 0
        flags[ANY_ACTIVE, 0] = 1

    return length, restart
