"""Division by magnitudes that may be zero, without a smallest magnitude, which a quantity with a dimension lacks."""

from functools import cache

import warp as wp


@cache
def nonzero_function(real):
    """Return the device function `nonzero(x)`: x if positive, else 1, for quotients whose dividend is then zero."""

    @wp.func
    def nonzero(x: real):
        return wp.where(x > real(0.0), x, real(1.0))

    return nonzero
