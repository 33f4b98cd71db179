"""Laws of an overhand knot with a long braid: two strands wind about each other n times, and a loop joins one end to the other.

The strands are helices of radius h, that of the rod, and wave number k in a braid of length l = 2 pi n / k. They part where the
curvature of the loop at its ends, 1 / R, against none of the tails pulls them apart: k^4 = 1 / (12 h^2 R^2), by the first integral
of their bending. One presses on the other with p = B h k^4 a length, B the bending stiffness, and friction takes mu p l. The loop
is a planar elastica that leaves the braid along it and comes back along it, l behind. Of the rod, loop and braid take the slack
e = lambda + l more than the distance of its ends (Jawed, Dieleman, Audoly and Reis, Untangling the mechanics and topology in the
frictional response of long overhand elastic knots, PRL 115, 118302, 2015).

That law, which `jawed` gives, is of many turns, and of friction that is large beside the loop's own traction but bends neither braid
nor tails. `drawn`, which lets them bend, is derived here from the same parts and not by these authors.
"""

import numpy as np

NODES = 40  # of quadrature along half of a loop


def elastica(m: float) -> tuple[float, float]:
    """Length lambda of the loop and distance l of its ends, over R; curvature R kappa = s = (1 - m sin(theta / 2)^2)^(1/2).

    lambda / R = 2 int_0^pi d theta / s and l / R = -2 int_0^pi cos(theta) d theta / s, theta the angle to the braid, are complete
    elliptic integrals; in Carlson's form they lose little where m is small. As m tends to 1 both grow as -2 log(1 - m).
    """
    from scipy.special import elliprd, elliprf

    whole = elliprf(0.0, 1.0 - m, 1.0)
    return 4.0 * whole, 8.0 / 3.0 * elliprd(0.0, 1.0 - m, 1.0) - 4.0 * whole


def shape(turns: float, slack: float) -> float:
    """The m of the loop at which n^2 h / e = l^2 / (8 sqrt(3) pi^2 (lambda + l) R); slack is e / h."""
    from scipy.optimize import brentq

    def left(u):
        loop, apart = elastica(1.0 / (1.0 + np.exp(-u)))
        return apart**2 / (loop + apart) - 8.0 * np.sqrt(3.0) * np.pi**2 * turns**2 / slack

    # u of m = 1 / (1 + exp(-u)) tells m that are near 1, of tight knots, as well as those near 0, of loose ones
    return 1.0 / (1.0 + np.exp(-brentq(left, -30.0, 30.0, xtol=1e-12)))


def jawed(turns: float, slack: float, friction: float) -> float:
    """Traction F h^2 / B = mu (l / R)^3 / (96 sqrt(3) pi^2 n^2) at a slack e / h by the law of Jawed et al.

    A loose knot, of h far below R = e / 2 pi, needs mu n 2 pi / 12^(3/4) (h / R)^(3/2).
    """
    _, apart = elastica(shape(turns, slack))
    return friction * apart**3 / (96.0 * np.sqrt(3.0) * np.pi**2 * turns**2)


def drawn(turns: float, slack: float, friction: float) -> tuple[float, float]:
    """Traction F h^2 / B and normal force P h^2 / B of a braid that the loop bends and that traction straightens.

    The loop's moment B kappa turns the ends of the braid, a beam of 2 B, by phi against its tension S = F - Q, where Q is how
    strongly the loop pushes on it, and against the tail, which traction then bends the other way by phi (F / B)^(1/2):

        B kappa = phi ((B F)^(1/2) + (2 B S)^(1/2) coth(l (S / 8 B)^(1/2))) .

    Strands part by the difference kappa (1 + tau) of curvatures, tau = phi (F / B)^(1/2) / kappa: friction makes a braid
    shorter, up to as if k^4 was twice what it is in a loose knot. Helices under tension press by it too:

        k^4 + k^2 S / 6 B = (1 + tau)^2 kappa^2 / 12 h^2 ,    P = (B k^4 + k^2 S / 2) h l ,

    and F = B kappa^2 / 2 - Q cos(phi) + mu P, what goes along the rod in the loop's ends and friction. Nothing is fitted. phi is
    taken to be small in the braid; in a loose knot with mu = 0, F = B / 2 R^2 (1 + n 6 / 12^(3/4) (h / R)^(1/2)).

    Args:
        turns: n
        slack: e / h
        friction: mu
    """
    from scipy.optimize import root

    at, weight = np.polynomial.legendre.leggauss(NODES)
    thin = 2.0 * np.pi / slack  # h over e / 2 pi, which is the unit of length from here on, and B that of stiffness

    def braid(m, phi, traction):
        """Curvature of the loop's ends, Q, S, l, k^2 and P."""
        theta = phi + 0.5 * (np.pi - phi) * (at + 1.0)
        share = (np.pi - phi) * weight / np.sqrt(1.0 - m * np.sin(0.5 * theta) ** 2)
        apart = -share @ np.cos(theta)
        unit = 2.0 * np.pi / (share.sum() + apart)
        bent, push, length = np.sqrt(1.0 - m * np.sin(0.5 * phi) ** 2) / unit, 0.25 * m / unit**2, apart * unit
        tension = max(traction - push, 1e-9)
        parted = (bent + phi * np.sqrt(traction)) ** 2 / 12.0 / thin**2
        wave = np.sqrt(parted + (tension / 12.0) ** 2) - tension / 12.0
        return bent, push, tension, length, wave, (wave**2 + 0.5 * wave * tension) * thin * length

    def left(unknown):
        m, phi, traction = 1.0 / (1.0 + np.exp(-unknown[0])), *np.exp(unknown[1:])
        bent, push, tension, length, wave, normal = braid(m, phi, traction)
        held = np.sqrt(traction) + np.sqrt(2.0 * tension) / np.tanh(length * np.sqrt(tension / 8.0))
        pulled = 0.5 * bent**2 - push * np.cos(phi) + friction * normal
        return np.log([phi * held / bent, np.sqrt(wave) * length / (2.0 * np.pi * turns), pulled / traction])

    m = shape(turns, slack)
    start = np.log([m / (1.0 - m), 0.2 * elastica(m)[1], 0.5 + jawed(turns, slack, friction) / thin**2])
    found = root(left, start, tol=1e-10)
    if not found.success:
        raise ValueError(f"turns = {turns}, slack = {slack}, friction = {friction}: no such braid, {found.message}")
    m, phi, traction = 1.0 / (1.0 + np.exp(-found.x[0])), *np.exp(found.x[1:])
    return traction * thin**2, braid(m, phi, traction)[-1] * thin**2
