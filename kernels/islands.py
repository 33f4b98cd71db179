"""Islands: what shares one Newton loop. A rod on its own is one; so is, in each world, everything that is coupled.

Whatever decides is an array over islands, whose entry a kernel finds from its thread: the column of a chain, the world of a net.
"""

from functools import cache

import warp as wp


@cache
def islands_type(real):
    """Where the search and the step of every island stand; the arrays are those of one solver (see `allocate`)."""
    I, R = wp.array(dtype=int), wp.array(dtype=real)

    @wp.struct
    class Islands:
        # the quadratic of inertia, coefficient * m |x - target|^2 / 2, and the reciprocal of the step that the solve is about
        coefficient: R
        rate: R
        # the solve: its outcome (`outcome`), accepted iterates, and how the iterate at hand compares with the tolerance
        status: I
        iteration: I
        unbalanced: I  # a residual is neither small nor rounding
        drowned: I  # a residual is not small, though it may be rounding
        load_scale: R
        residual: R  # largest
        # the line search: from the accepted iterate along the direction
        slot: I  # which half of the energies is the accepted iterate's
        step_length: R
        halvings: I
        decrement: R  # expected decrease of the energy by a whole step
        merit: R  # square of the accepted iterate's residual
        angle_change: R  # what angles have yet to move along the direction
        wanted: I  # whether a direction is
        todo: I  # what is left to be done with the iterate
        placed: I  # whether its edges were turned rather than moved straight
        turned: I  # whether frames have to be renewed before the next step
        # the matrix: whether it leaves out what compression takes away, and pivots lost in all iterations and in this one
        clamped: I
        lost: I
        bad: I
        # the step: the part of it that is done, the part being tried, and how
        progress: R
        portion: R
        cautious: I  # whether it starts from the last state instead of the predictor
        retries: I
        reason: I  # outcome of the solve that made it be given up
        bent: I  # whether the predictor has to turn edges
        moved: I  # whether this part of it succeeded
        # one flag for all: whether any is still active
        active: I

    return Islands


@cache
def attempt_functions(real, midpoint: bool):
    """length(islands, i, dt) of the implicit Euler step that the next solve of island i is about; restart(...) of its search."""
    Islands = islands_type(real)

    @wp.func
    def length(islands: Islands, i: int, dt: real):
        s = dt * islands.portion[i]
        if wp.static(midpoint):
            s *= real(0.5)
        return s

    @wp.func
    def restart(islands: Islands, i: int, rate: real, coefficient: real, load_scale: real):
        islands.coefficient[i] = coefficient
        islands.rate[i] = rate
        islands.load_scale[i] = load_scale
        islands.status[i] = 0
        islands.iteration[i] = 0
        islands.halvings[i] = 0
        islands.turned[i] = 0
        islands.clamped[i] = 0
        islands.unbalanced[i] = 0
        islands.drowned[i] = 0
        islands.active[0] = 1

    return length, restart


def allocate(count: int, real, device):
    """The arrays of `count` islands, all zero."""
    kind = islands_type(real)
    islands = kind()
    for name, variable in kind.vars.items():
        length = 1 if name == "active" else count
        setattr(islands, name, wp.zeros(length, dtype=variable.type.dtype, device=device))
    return islands
