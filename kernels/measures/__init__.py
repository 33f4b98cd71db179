"""Measures: the geometry. A measure maps the local dofs of an element to a few strains.

The local dofs are q = [edge vectors of the stencil..., angles of its edges...], so that translation invariance holds by
construction and forces on nodes are differences of edge forces. Where a measure needs frames it reads s, the lagged data of
the stencil, which stay constant during a step. w is the rest measure of the element (rest length, Voronoi length, area):
strains are pointwise quantities, so a density and its parameters do not depend on the mesh.
"""

from collections.abc import Callable
from dataclasses import dataclass

import warp as wp


@dataclass(frozen=True)
class Measure:
    """One kind of strain.

    Attributes:
        name: field's name of the measure.
        dim: dimension of space, 2 or 3.
        edges: pairs of local nodes; edge i of the stencil is x[j] - x[i].
        angles: how many of the edges (the first ones) bring their angle theta as a dof.
        lag_size: reals of lagged data of the stencil; 0 for a measure without frames.
        strains: names and units of the strains.
        functions: real -> (strains, jacobian, tension, curvature). `strains(q, s, w) -> E`; `jacobian(q, s, w) -> (E, J)`;
            `tension` is None, or `tension(q, w, slope) -> (c, shift)` with the second derivative of a strain of one edge,
            w slope : d2e = c I + w J^T diag(shift) J; `curvature(q, s, w, slope)` of measures of two edges is w slope : d2e as
            the upper triangle of a symmetric matrix, row by row.
    """

    name: str
    dim: int
    edges: tuple[tuple[int, int], ...]
    strains: tuple[str, ...]
    functions: Callable
    angles: int = 0
    lag_size: int = 0
    has_tension: bool = False

    @property
    def size(self) -> int:
        """Number of local dofs."""
        return self.dim * len(self.edges) + self.angles

    @property
    def span(self) -> int:
        """Edges of a chain stencil: 1 for an edge, 2 for a vertex."""
        return len(self.edges)

    def types(self, real):
        """Vector of dofs, of lagged data, of strains, and matrix of the Jacobian."""
        return (
            wp.types.vector(self.size, real),
            wp.types.vector(max(1, self.lag_size), real),
            wp.types.vector(len(self.strains), real),
            wp.types.matrix((len(self.strains), self.size), real),
        )
