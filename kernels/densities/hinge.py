"""Law of a hinge between rigid bodies, of its separation, the angles between the axes, and the angle theta about the axis.

psi = sum_i k_i (e_i - e0_i)^2 / 2 + c / h (theta - theta_n)^2 / 2 - tau theta + k_l (theta - [theta_min, theta_max])^2 / 2 ,

with the motor's angle in e0, damping c, the angle theta_n at the last step and its length h, the motor's torque tau, and stops of
stiffness k_l: the last bracket is the closest angle between the stops.
"""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.kernels.densities import FINITE, NOT_NEGATIVE, Density, Parameter, each

ANGLE = 5  # strain that is the angle about the axis


@cache
def _laws(real, n):
    E, P = wp.types.vector(6, real), wp.types.vector(17 + 7, real)

    @wp.func
    def beyond(theta: real, p: P):
        """Return the angle beyond the stops."""
        return theta - wp.min(wp.max(theta, p[14]), p[15])

    @wp.func
    def energy(e: E, p: P):
        total = real(0.0)
        for i in range(6):
            strain = e[i] - p[6 + i]
            total += real(0.5) * p[i] * strain * strain
        theta = e[wp.static(ANGLE)]
        moved = theta - p[17 + wp.static(ANGLE)]
        over = beyond(theta, p)
        return total + real(0.5) * p[12] * p[23] * moved * moved - p[13] * theta + real(0.5) * p[16] * over * over

    @wp.func
    def slope(e: E, p: P):
        f = E()
        for i in range(6):
            f[i] = p[i] * (e[i] - p[6 + i])
        theta = e[wp.static(ANGLE)]
        f[wp.static(ANGLE)] = (
            f[wp.static(ANGLE)] + p[12] * p[23] * (theta - p[17 + wp.static(ANGLE)]) - p[13] + p[16] * beyond(theta, p)
        )
        return f

    @wp.func
    def curvature(e: E, p: P):
        c = E()
        for i in range(6):
            c[i] = p[i]
        stops = wp.where(beyond(e[wp.static(ANGLE)], p) == real(0.0), real(0.0), p[16])
        c[wp.static(ANGLE)] = c[wp.static(ANGLE)] + p[12] * p[23] + stops
        return c

    return energy, slope, curvature


def _parameters(n):
    return (
        *each(6, "stiffness", "N/m; N m of angles", NOT_NEGATIVE),
        *each(6, "rest", "m; rad of angles", FINITE, rest=True, default=0.0),
        Parameter("damping", "N m s", NOT_NEGATIVE, default=0.0),
        Parameter("torque", "N m", FINITE, default=0.0),
        Parameter("lower", "rad", ("a number", lambda v: ~np.isnan(v)), default=-1e30),
        Parameter("upper", "rad", ("a number", lambda v: ~np.isnan(v)), default=1e30),
        Parameter("stop", "N m", NOT_NEGATIVE, default=0.0),
    )


hinge_law = Density("hinge", _parameters, _laws, strains=6, lagged=True)
