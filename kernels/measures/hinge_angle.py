"""Dihedral angle of an interior edge [rad]: four nodes, 0 and 1 on the edge, 2 and 3 opposite (Grinspun et al. 2003).

With e = x1 - x0, a = x2 - x0, b = x3 - x0 the area normals are n = e x a and m = b x e, and

    theta = atan2((n x m) . e / |e|, n . m),   positive where the surface is convex seen from the side that the normals point to.

Derivatives, with the heights h = |n| / |e| and k = |m| / |e|:

    d theta / da = -n / (|n| h),   d theta / db = -m / (|m| k);

d theta / de follows from rotation invariance (Wardetzky et al. 2007; Tamstorf and Grinspun 2013). A triangle without area has zero
derivatives; theta jumps by 2 pi where the surface folds onto itself.

The quadratic density with stiffness k [J] and w = |e|^2 / A_e, A_e a third of the two triangles' rest area (Grinspun et al.
2003), gives the energy k w theta^2 / 2. On a mesh of equilateral triangles this is the plate of bending stiffness D = 3 k with
Gaussian modulus -4 k = -(4/3) D (Seung and Nelson 1988). Its Poisson's ratio is -1/3 for every material. So k = D / 3 is correct for
cylinders on that mesh, and gives spheres the energy of nu = -1/3. On right triangles with the diagonal at 45 degrees, cylinders bent
along 0, 90 and 135 degrees have D = 3 k, but 9 k along 45 degrees, and refining does not change it.
"""

from functools import cache

import warp as wp

from ddg_warp.kernels.core.division import nonzero_function
from ddg_warp.kernels.measures import Measure


@cache
def dihedral(real):
    """Return the device functions `angle` and `derivative` of an edge e with corners a and b on both sides.

    Vectors start at the first node of the edge. `angle(e, a, b) -> theta`. `derivative(e, a, b) -> (theta, dtheta/de, dtheta/da,
    dtheta/db)`.
    """
    V, nonzero = wp.types.vector(3, real), nonzero_function(real)

    @wp.func
    def angle(e: V, a: V, b: V):
        n = wp.cross(e, a)
        m = wp.cross(b, e)
        return wp.atan2(wp.dot(wp.cross(n, m), e), wp.dot(n, m) * wp.length(e))

    @wp.func
    def by_height(n: V, length: real):
        """Return the unit normal divided by the height of a triangle over an edge of `length`; zero without area."""
        h = n / length
        return h / nonzero(wp.dot(h, h))

    @wp.func
    def derivative(e: V, a: V, b: V):
        length = wp.length(e)
        da = -by_height(wp.cross(e, a), length)
        db = -by_height(wp.cross(b, e), length)
        de = -(da * wp.dot(a, e) + db * wp.dot(b, e)) / (length * length)
        return angle(e, a, b), de, da, db

    return angle, derivative


@cache
def _functions(real):
    Q, S, E, M = hinge_angle.types(real)
    V = wp.types.vector(3, real)
    angle, derivative = dihedral(real)

    @wp.func
    def strains(q: Q, s: S, w: real):
        return E(angle(V(q[0], q[1], q[2]), V(q[3], q[4], q[5]), V(q[6], q[7], q[8])))

    @wp.func
    def jacobian(q: Q, s: S, w: real):
        theta, e, a, b = derivative(V(q[0], q[1], q[2]), V(q[3], q[4], q[5]), V(q[6], q[7], q[8]))
        return E(theta), wp.matrix_from_rows(Q(e[0], e[1], e[2], a[0], a[1], a[2], b[0], b[1], b[2]))

    return strains, jacobian, None, None


hinge_angle = Measure("hinge_angle", 3, ((0, 1), (0, 2), (0, 3)), ("angle [rad]",), _functions)
