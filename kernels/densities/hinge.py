"""Law of a hinge between rigid bodies, of its separation, the angles between the axes, and the angle theta about the axis.

psi = sum_i k_i (e_i - e0_i)^2 / 2 + c / h (theta - theta_n)^2 / 2 - tau theta + k_l (theta - [theta_min, theta_max])^2 / 2 ,

with the motor's angle in e0, its torque tau, damping c, the angle theta_n at the last step, and the step length h. Stops have the
stiffness k_l: the last bracket is the closest angle between the stops.
"""

from functools import cache

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
    def stiffness(p: P):
        return E(p[0], p[1], p[2], p[3], p[4], p[5])

    @wp.func
    def strain(e: E, p: P):
        """Return the strains less the rest strains."""
        return e - E(p[6], p[7], p[8], p[9], p[10], p[11])

    @wp.func
    def energy(e: E, p: P):
        d, theta = strain(e, p), e[wp.static(ANGLE)]
        moved, over = theta - p[17 + wp.static(ANGLE)], beyond(theta, p)
        of_angle = p[12] * p[23] * moved * moved + p[16] * over * over
        return real(0.5) * (wp.dot(d, wp.cw_mul(stiffness(p), d)) + of_angle) - p[13] * theta

    @wp.func
    def slope(e: E, p: P):
        f, theta = wp.cw_mul(stiffness(p), strain(e, p)), e[wp.static(ANGLE)]
        damping = p[12] * p[23] * (theta - p[17 + wp.static(ANGLE)])
        return E(f[0], f[1], f[2], f[3], f[4], f[5] + damping - p[13] + p[16] * beyond(theta, p))

    @wp.func
    def curvature(e: E, p: P):
        stops = wp.where(beyond(e[wp.static(ANGLE)], p) == real(0.0), real(0.0), p[16])
        return E(p[0], p[1], p[2], p[3], p[4], p[5] + p[12] * p[23] + stops)

    return energy, slope, curvature


def _parameters(n):
    return (
        *each(6, "stiffness", "N/m; N m of angles", NOT_NEGATIVE),
        *each(6, "rest", "m; rad of angles", FINITE, rest=True, default=0.0),
        Parameter("damping", "N m s", NOT_NEGATIVE, default=0.0),
        Parameter("torque", "N m", FINITE, default=0.0),
        Parameter("lower", "rad", ("a number", lambda v: abs(v) >= 0.0), default=-1e30),
        Parameter("upper", "rad", ("a number", lambda v: abs(v) >= 0.0), default=1e30),
        Parameter("stop", "N m", NOT_NEGATIVE, default=0.0),
    )


hinge_law = Density("hinge", _parameters, _laws, strains=6, lagged=True)
