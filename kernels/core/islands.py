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
from ddg_warp.kernels.newton.edge_rotation import TURNED

FLAGS = (
    # The solve: outcome (see `outcome`), accepted iterates, and convergence test of the current iterate
    "status",
    "iteration",
    "unbalanced",  # A residual is above tolerance and rounding floor.
    "drowned",  # A residual is above tolerance, but within the rounding floor.
    # The line search, from the accepted iterate along the direction
    "slot",  # Which half of the energy buffer belongs to the accepted iterate.
    "halvings",
    "wanted",  # Whether a direction is to be computed.
    "todo",  # Remaining action on the iterate, see `search`.
    "placed",  # Whether the iterate came from an edge-rotation update, not a straight one.
    "stale",  # Whether frames have to be updated before the next step.
    # The matrix: whether compression is dropped, and pivots lost in all iterations and in this one
    "clamped",
    "lost",
    "bad",
    "detours",  # Iterations of a solve with a projected instead of the exact Hessian.
    "patience",  # Limit of projected iterations.
    # The step: whether it is a cold start (from the last state instead of the predictor), and its progress
    "cautious",
    "retries",  # Of the current substep, or of the last one of a finished step.
    "reason",  # Outcome of the solve that made it fail for good.
    "bent",  # Whether the predictor has to rotate edges.
    "moved",  # Whether this substep succeeded.
    "driven",  # Whether supports blocked by contact moved in the last iteration; see `kernels.newton.contact_newton`.
    "cut",  # Whether CCD has limited the last motion, of the predictor or of an iteration.
    # In float32, see `judge`: whether the rounding floor decides and exceeds `ROUNDED` of the loads, the iteration from which it
    # decides anyway, and whether a solve has ended so.
    "doubtful",
    "polished",
    "doubted",
    # In the first column: whether any island is active, whether one rotates edges or updates frames, and, in the coupled system,
    # whether one needs a direction
    "active",
    "turning",
    "wanting",
)
SCALARS = (
    # The quadratic of inertia, coefficient * m |x - target|^2 / 2, and the reciprocal of the solve's step length
    "coefficient",
    "rate",
    "load_scale",
    "residual",  # Largest.
    "step_length",
    "decrement",  # Predicted decrease of the energy by a full step.
    "merit",  # Squared residual of the accepted iterate.
    "angle_change",  # Remaining motion of twist angles along the direction.
    "carried",  # Largest axial stiffness of an edge in a float32 matrix [N/m]; see `solve.tension`.
    "turn",  # Largest edge rotation of a straight update [rad]; see `turns`.
    # The fraction of the time step that is done, and of the current substep
    "progress",
    "portion",
    # The largest fraction tried at once, and the interval of a row of poses; see `solve.collision.support_arcs`
    "substep",
    "interval",
)
(STATUS, ITERATION, UNBALANCED, DROWNED, SLOT, HALVINGS, WANTED, TODO, PLACED, STALE) = range(10)
(CLAMPED, LOST, BAD, DETOURS, PATIENCE, CAUTIOUS, RETRIES, REASON, BENT, MOVED, DRIVEN, CUT) = range(10, 22)
DOUBTFUL, POLISHED, DOUBTED = range(22, 25)
ACTIVE, TURNING, WANTING = range(25, len(FLAGS))
(COEFFICIENT, RATE, LOAD_SCALE, RESIDUAL, STEP_LENGTH, DECREMENT, MERIT, ANGLE_CHANGE) = range(8)
CARRIED, TURN, PROGRESS, PORTION, SUBSTEP, INTERVAL = range(8, len(SCALARS))
DETOURS_ALLOWED, LEAST = 30, 0.125  # Projected iterations of substeps larger than this fraction.


class Islands:
    """Solver state of `count` islands; each row is also an attribute, such as `islands.status`.

    Entries are zero at first, except `turn`, `patience` and step fractions.

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
        self.turn.fill_(TURNED)
        self.substep.fill_(1.0)
        self.interval.fill_(1.0)
        self.patience.fill_(np.iinfo(np.int32).max)
        self.signals = self.arrays[0][ACTIVE:]
        self.active, self.turning, self.wanting = (self.signals[row, :1] for row in range(3))

    def __len__(self) -> int:
        return self.arrays[0].shape[1]


@cache
def patience_function(real):
    """Return the device function `out_of_patience(flags, scalars, i)`: True if the solve of island i should end.

    It counts projected iterations. Where the exact Hessian is indefinite, an iteration omits second derivatives, and proceeds slowly
    along a curved valley or leaves a saddle. A shorter step, for which inertia makes the Hessian definite, is faster, and finds the
    solution that the motion leads to. After `DETOURS_ALLOWED` such iterations the solve ends, unless the substep is `LEAST` already
    or retries are off.
    """

    @wp.func
    def out_of_patience(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), i: int):
        projected = flags[DETOURS, i] + flags[CLAMPED, i]
        flags[DETOURS, i] = projected
        flags[CLAMPED, i] = 0
        if projected <= flags[PATIENCE, i] or scalars[PORTION, i] <= real(LEAST) * scalars[SUBSTEP, i]:
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
        s = dt * scalars[PORTION, i]
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
        scalars[COEFFICIENT, i] = coefficient
        scalars[RATE, i] = rate
        scalars[LOAD_SCALE, i] = load_scale
        flags[STATUS, i] = 0
        flags[ITERATION, i] = 0
        flags[HALVINGS, i] = 0
        flags[STALE, i] = 0
        flags[CLAMPED, i] = 0
        flags[DETOURS, i] = 0
        flags[UNBALANCED, i] = 0
        flags[DROWNED, i] = 0
        flags[DOUBTFUL, i] = 0
        flags[POLISHED, i] = 0
        flags[ACTIVE, 0] = 1

    return length, restart
