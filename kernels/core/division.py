"""Division by sizes that may be zero, without a smallest size: what has a dimension has none."""

from functools import cache

import warp as wp


@cache
def nonzero_function(real):
    """nonzero(x): x where it is positive, else 1, for quotients whose dividend is zero there."""

    @wp.func
    def nonzero(x: real):
        return wp.where(x > real(0.0), x, real(1.0))

    return nonzero
