"""Laws of an overhand knot with a long braid of two strands and a loop.

The strands wind about each other n times and a loop joins one end of the braid to the other. They are helices of the radius h
of the rod and wave number k, in a braid of length l = 2 pi n / k. The loop's end curvature 1 / R separates them:
k^4 = 1 / (12 h^2 R^2), by the first integral of their bending. They press on each other by p = B h k^4 a length, with the bending
stiffness B, and friction takes mu p l. The loop is a planar elastica that leaves the braid and returns along its axis, l behind.
Loop and braid use up the slack e = lambda + l of the rod beyond the distance of its ends. Source: Jawed, Dieleman, Audoly and
Reis, Untangling the mechanics and topology in the frictional response of long overhand elastic knots, PRL 115, 118302, 2015.

`jawed` gives that law. It holds for many turns, and for friction that dominates the loop's traction but bends neither braid nor
tails. `drawn` includes their bending and is derived here, not by these authors.
"""

import numpy as np

NODES = 40  # of quadrature along half of a loop


def elastica(m: float) -> tuple[float, float]:
    """Return length lambda of the loop and distance l between the ends, over R.

    Its curvature is R kappa = s = (1 - m sin(theta / 2)^2)^(1/2), with theta the angle to the braid:

        lambda / R = 2 int_0^pi d theta / s ,  l / R = -2 int_0^pi cos(theta) d theta / s .

    Carlson's form of these complete elliptic integrals is accurate for small m. As m tends to 1 both grow as -2 log(1 - m).
    """
    from scipy.special import elliprd, elliprf

    whole = elliprf(0.0, 1.0 - m, 1.0)
    return 4.0 * whole, 8.0 / 3.0 * elliprd(0.0, 1.0 - m, 1.0) - 4.0 * whole


def shape(turns: float, slack: float) -> float:
    """Solve for the m of the loop: n^2 h / e = l^2 / (8 sqrt(3) pi^2 (lambda + l) R); slack is e / h."""
    from scipy.optimize import brentq

    def left(u):
        loop, distance = elastica(1.0 / (1.0 + np.exp(-u)))
        return distance**2 / (loop + distance) - 8.0 * np.sqrt(3.0) * np.pi**2 * turns**2 / slack

    # u of m = 1 / (1 + exp(-u)) resolves m near 1, of tight knots, and near 0, of loose ones
    return 1.0 / (1.0 + np.exp(-brentq(left, -30.0, 30.0, xtol=1e-12)))


def jawed(turns: float, slack: float, friction: float) -> float:
    """Return the traction F h^2 / B = mu (l / R)^3 / (96 sqrt(3) pi^2 n^2) at a slack e / h by the law of Jawed et al.

    A loose knot, with h far below R = e / 2 pi, needs mu n 2 pi / 12^(3/4) (h / R)^(3/2).
    """
    _, distance = elastica(shape(turns, slack))
    return friction * distance**3 / (96.0 * np.sqrt(3.0) * np.pi**2 * turns**2)


def drawn(turns: float, slack: float, friction: float) -> tuple[float, float]:
    """Return traction F h^2 / B and normal force P h^2 / B of a braid that bends under loop and traction.

    The loop's moment B kappa rotates the ends of the braid, a beam of stiffness 2 B, by phi against its tension S = F - Q.
    Q is the force of the loop on the braid. The moment also acts against the tail, which traction bends back by phi (F / B)^(1/2):

        B kappa = phi ((B F)^(1/2) + (2 B S)^(1/2) coth(l (S / 8 B)^(1/2))) .

    Strands separate by the difference kappa (1 + tau) of curvatures, tau = phi (F / B)^(1/2) / kappa. Friction shortens a braid,
    at most as if k^4 were twice that of a loose knot. Helices under tension add to the pressure:

        k^4 + k^2 S / 6 B = (1 + tau)^2 kappa^2 / 12 h^2 ,    P = (B k^4 + k^2 S / 2) h l ,

    and F = B kappa^2 / 2 - Q cos(phi) + mu P, the axial force of the loop's ends and friction. Nothing is fitted. phi is assumed
    small in the braid; in a loose knot with mu = 0, F = B / 2 R^2 (1 + n 6 / 12^(3/4) (h / R)^(1/2)).

    Args:
        turns: n
        slack: e / h
        friction: mu
    """
    from scipy.optimize import root

    nodes, weight = np.polynomial.legendre.leggauss(NODES)
    thin = 2.0 * np.pi / slack  # h over e / 2 pi; from here on e / 2 pi is the unit of length and B of stiffness

    def braid(m, phi, traction):
        """Return curvature of the loop's ends, Q, S, l, k^2 and P."""
        theta = phi + 0.5 * (np.pi - phi) * (nodes + 1.0)
        arc = (np.pi - phi) * weight / np.sqrt(1.0 - m * np.sin(0.5 * theta) ** 2)
        distance = -arc @ np.cos(theta)
        unit = 2.0 * np.pi / (arc.sum() + distance)
        bent, push, length = np.sqrt(1.0 - m * np.sin(0.5 * phi) ** 2) / unit, 0.25 * m / unit**2, distance * unit
        tension = max(traction - push, 1e-9)
        parted = (bent + phi * np.sqrt(traction)) ** 2 / 12.0 / thin**2
        wave = np.sqrt(parted + (tension / 12.0) ** 2) - tension / 12.0
        return bent, push, tension, length, wave, (wave**2 + 0.5 * wave * tension) * thin * length

    def left(unknown):
        m, phi, traction = 1.0 / (1.0 + np.exp(-unknown[0])), *np.exp(unknown[1:])
        bent, push, tension, length, wave, normal = braid(m, phi, traction)
        resistance = np.sqrt(traction) + np.sqrt(2.0 * tension) / np.tanh(length * np.sqrt(tension / 8.0))
        pulled = 0.5 * bent**2 - push * np.cos(phi) + friction * normal
        return np.log([phi * resistance / bent, np.sqrt(wave) * length / (2.0 * np.pi * turns), pulled / traction])

    m = shape(turns, slack)
    start = np.log([m / (1.0 - m), 0.2 * elastica(m)[1], 0.5 + jawed(turns, slack, friction) / thin**2])
    solution = root(left, start, tol=1e-10)
    if not solution.success:
        raise ValueError(f"turns = {turns}, slack = {slack}, friction = {friction}: no such braid, {solution.message}")
    m, phi, traction = 1.0 / (1.0 + np.exp(-solution.x[0])), *np.exp(solution.x[1:])
    return traction * thin**2, braid(m, phi, traction)[-1] * thin**2
