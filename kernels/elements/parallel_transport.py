"""Parallel transport, reference frames and their twist (Bergou et al. 2008, 2010)."""

from functools import cache

import warp as wp


@cache
def functions(real):
    """Return the device functions `transport`, `reference_twist` and `rotate` of 3-vectors of `real`.

    `transport(d, t0, t1)`, `reference_twist(ue, uf, te, tf, lagged)`, `rotate(d, t, angle)`.
    """
    V = wp.types.vector(3, real)
    turn = wp.constant(real(6.283185307179586476925286766559))

    @wp.func
    def transport(d: V, t0: V, t1: V):
        """Rotate d by the smallest rotation that takes the unit vector t0 to t1. Singular where t1 = -t0."""
        b = wp.cross(t0, t1)
        c = wp.dot(t0, t1)
        return d * c + wp.cross(b, d) + b * (wp.dot(b, d) / (real(1.0) + c))

    @wp.func
    def reference_twist(ue: V, uf: V, te: V, tf: V, lagged: real):
        """Return the angle about tf from the transported ue to uf, on the branch nearest to the lagged value."""
        up = transport(ue, te, tf)
        angle = wp.atan2(wp.dot(wp.cross(up, uf), tf), wp.dot(up, uf))
        return angle - turn * wp.round((angle - lagged) / turn)

    @wp.func
    def rotate(d: V, t: V, angle: real):
        """Rotate d, perpendicular to the unit vector t, by `angle` about t."""
        return d * wp.cos(angle) + wp.cross(t, d) * wp.sin(angle)

    return transport, reference_twist, rotate


@cache
def stale_function(real):
    """Return the device function `stale(e, f, ue, te, uf, tf, lagged)`: True if a frame update is needed.

    That is where edge e or f has rotated by more than 90 degrees from its lagged tangent, or their reference twist nears a jump.
    """
    V = wp.types.vector(3, real)
    transport, reference_twist, _ = functions(real)

    @wp.func
    def stale(e: V, f: V, ue: V, te: V, uf: V, tf: V, lagged: real):
        along_e = wp.dot(e, te)
        along_f = wp.dot(f, tf)
        far = real(0.81)  # squared cosine of the rotation above which the reference twist can matter
        if along_e * wp.abs(along_e) >= far * wp.length_sq(e) and along_f * wp.abs(along_f) >= far * wp.length_sq(f):
            return False
        t = wp.normalize(e)
        s = wp.normalize(f)
        m = reference_twist(transport(ue, te, t), transport(uf, tf, s), t, s, lagged)
        return wp.min(along_e, along_f) < real(0.0) or wp.abs(m - lagged) > real(1.5)

    return stale
