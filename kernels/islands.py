"""Islands: what shares one Newton loop. A rod on its own is one; so is, in each world, everything that is coupled.

Whatever decides is an entry of an island in one of two arrays, `flags` (integers) and `scalars`, each (row, island); the rows are
named here. A kernel finds the island from its thread: the column of a chain, the world of a net. (A kernel's arguments are copied with
every launch of a graph: two arrays instead of thirty are worth some percent of a step of few rods on a GPU.)
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels import outcome
from ddg_warp.kernels.turns import TURNED

FLAGS = (
    # the solve: its outcome (see `outcome`), accepted iterates, and how the iterate at hand compares with the tolerance
    "status",
    "iteration",
    "unbalanced",  # a residual is neither small nor rounding
    "drowned",  # a residual is not small, though it may be rounding
    # the line search, from the accepted iterate along the direction
    "slot",  # which half of the energies is the accepted iterate's
    "halvings",
    "wanted",  # whether a direction is
    "todo",  # what is left to be done with the iterate
    "placed",  # whether its edges were turned rather than moved straight
    "stale",  # whether frames have to be renewed before the next step
    # the matrix: whether it leaves out what compression takes away, and pivots lost in all iterations and in this one
    "clamped",
    "lost",
    "bad",
    "detours",  # iterations of a solve with such a matrix in place of the exact Hessian
    "patience",  # how many there may be
    # the step: whether it starts from the last state instead of the predictor, and what became of it
    "cautious",
    "retries",  # of the part of the step at hand, or of the last one of a step that is done
    "reason",  # outcome of the solve that made it be given up
    "bent",  # whether the predictor has to turn edges
    "moved",  # whether this part of it succeeded
    "driven",  # whether supports that contact holds up moved in the last step of the solve; see `kernels.net.touch`
    "cut",  # whether contact has cut the last motion, of the predictor or of a step
    # in float32, see `judge`: whether rounding excuses more than `ROUNDED` of the loads, the iteration from which on it excuses all,
    # and whether a solve has ended so
    "doubtful",
    "polished",
    "doubted",
    # in the first column, whether any island is still active, and whether one turns the edges of a step or renews its frames; of
    # nets, whether one wants a direction
    "active",
    "turning",
    "wanting",
)
SCALARS = (
    # the quadratic of inertia, coefficient * m |x - target|^2 / 2, and the reciprocal of the step that the solve is about
    "coefficient",
    "rate",
    "load_scale",
    "residual",  # largest
    "step_length",
    "decrement",  # expected decrease of the energy by a whole step
    "merit",  # square of the accepted iterate's residual
    "angle_change",  # what angles have yet to move along the direction
    "carried",  # largest stiffness of an edge that a matrix in float32 has [N/m]; see `solve.tension`
    "turn",  # largest turn of an edge that is still taken straight [rad]; see `turns`
    # the part of the time step that is done, and the part being tried
    "progress",
    "portion",
    # the largest part that is tried at once, and the part that a row of the poses of motions is of; see `solve.net.arcs`
    "substep",
    "interval",
)
(STATUS, ITERATION, UNBALANCED, DROWNED, SLOT, HALVINGS, WANTED, TODO, PLACED, STALE) = range(10)
(CLAMPED, LOST, BAD, DETOURS, PATIENCE, CAUTIOUS, RETRIES, REASON, BENT, MOVED, DRIVEN, CUT) = range(10, 22)
DOUBTFUL, POLISHED, DOUBTED = range(22, 25)
ACTIVE, TURNING, WANTING = range(25, len(FLAGS))
(COEFFICIENT, RATE, LOAD_SCALE, RESIDUAL, STEP_LENGTH, DECREMENT, MERIT, ANGLE_CHANGE) = range(8)
CARRIED, TURN, PROGRESS, PORTION, SUBSTEP, INTERVAL = range(8, len(SCALARS))
DETOURS_ALLOWED, LEAST = 30, 0.125  # by parts of a time step, or of its substeps, that are larger than this


class Islands:
    """The entries of `count` islands, zero at first but for `turn`, `patience` and parts of steps; each row by its name, too, such as
    `islands.status`.

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
    """out_of_patience(flags, scalars, i): enters an iteration of island i by its kind of matrix; whether the solve should end.

    Where the exact Hessian is indefinite an iteration does without second derivatives, and goes on slowly along a valley that bends,
    or leaves a saddle. A shorter step, for which inertia makes the Hessian definite, gets there sooner, and to the solution that the
    motion leads to. `DETOURS_ALLOWED` such iterations are enough, unless the part of the step is the `LEAST` already, or steps may
    not be tried again.
    """

    @wp.func
    def out_of_patience(flags: wp.array2d(dtype=int), scalars: wp.array2d(dtype=real), i: int):
        detours = flags[DETOURS, i] + flags[CLAMPED, i]
        flags[DETOURS, i] = detours
        flags[CLAMPED, i] = 0
        if detours <= flags[PATIENCE, i] or scalars[PORTION, i] <= real(LEAST) * scalars[SUBSTEP, i]:
            return False
        flags[STATUS, i] = wp.static(outcome.INDEFINITE)
        return True

    return out_of_patience


@cache
def attempt_functions(real, midpoint: bool):
    """length(scalars, i, dt) of the implicit Euler step that the next solve of island i is about; restart(...) of its search."""

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
