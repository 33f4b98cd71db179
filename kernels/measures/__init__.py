"""Measures: the geometry. A measure maps the local dofs of an element to a few strains.

The local dofs are q = [edge vectors of the stencil..., angles of its edges..., rotation vectors of joints..., positions...], so
that translation invariance holds by construction and forces on nodes are differences of edge forces; positions are there only
where the place in space is a strain, as the radius of a surface of revolution is, or a field differs from place to place. Where a
measure needs more it reads s, which stays constant during a step: lagged frames of a rod, or data of the element such as the
normal of a clamp or the magnetic field. w is the rest measure of the element (rest length, Voronoi length, area, volume): strains
are pointwise quantities, so a density and its parameters do not depend on the mesh.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp


@dataclass(frozen=True)
class Measure:
    """One kind of strain.

    Attributes:
        name: field's name of the measure.
        dim: dimension of space, 2 or 3.
        edges: pairs of local nodes; edge i of the stencil is x[j] - x[i].
        angles: how many edges bring their angle as a dof; of a rod the first of the stencil, of a triangle its sides.
        lag_size: reals of lagged data of the stencil; 0 for a measure without frames.
        data_size: reals of constant data of the element; 0 for a measure without.
        tensions: scalars of the geometric stiffness; 0 where it is left to the exact Hessian.
        spins: rotation vectors of rigid joints among the dofs, after the angles.
        points: how many nodes, the first of the stencil, are read as positions, too; after the rotation vectors.
        field: how many of the data, the last, are the magnetic field, which changes with time.
        apart: whether it couples what may be far apart along a rod, which preconditioners of chains leave out.
        frames: how many of the angles belong to edges with a reference frame, which the lagged data begin with.
        by_angle: whether a rod's curvature is its turning angle over the length, instead of 2 tan(phi/2).
        revolved: whether elements are of the meridian of a surface of revolution, in the plane y = 0.
        vectors: rows of the lagged data behind the frames, and of the constant data after these, at which a vector of space begins,
            three reals that turn with the element. (Frames turn too, and the field.)
        strains: names and units of the strains; those of a vector of space end in _x, _y, _z.
        functions: real -> (strains, jacobian, tension, curvature). `strains(q, s, w) -> E`; `jacobian(q, s, w) -> (E, J)`;
            `tension` is None, or `tension(q, w, slope) -> (c, shift)` with the second derivative of the strains,
            w slope : d2e = C + w J^T diag(shift) J. One edge has one tension, a scalar c with C = c I. A triangle has
            three, the vector c = (c11, c12, c22), and C has the blocks c_ij I between its edge vectors i and j.
            `curvature` is None, or `curvature(q, s, w, slope)`, of rod vertices and rigid joints: w slope : d2e as the upper
            triangle of a symmetric matrix, row by row.
        advance: None, or real -> advance(q, s): the lagged data beside the frames at the end of a step, from the dofs and frames there
            and what they were.
        stale: None, or real -> stale(q, s): whether frames have to be renewed before the next step of a solve.
        sample: None, or (random, count) -> of the elements that `ddg_warp.run.derivatives` tries the measure at what is to be chosen:
            nodes (nodes, 3), about which theirs lie; data (data_size, count); frame (6, frames * count), the first ones of all
            elements first; lag (rows, count), behind the frames; felt (slots, count), which of them the strains depend on. Else
            nodes lie unit steps along x, z and y in turns apart, data between 0.5 and 1.5, frames are 25 degrees old, lag is large.
    """

    name: str
    dim: int
    edges: tuple[tuple[int, int], ...]
    strains: tuple[str, ...]
    functions: Callable
    angles: int = 0
    lag_size: int = 0
    data_size: int = 0
    tensions: int = 0
    spins: int = 0
    points: int = 0
    field: int = 0
    apart: bool = False
    frames: int = 0
    advance: Callable | None = None
    stale: Callable | None = None
    by_angle: bool = False
    revolved: bool = False
    vectors: tuple[int, ...] = ()
    sample: Callable | None = None

    @property
    def size(self) -> int:
        """Number of local dofs."""
        return self.dim * (len(self.edges) + self.points) + self.angles + 3 * self.spins

    @property
    def nodes(self) -> int:
        """Nodes of the stencil."""
        return max((1 + max(pair) for pair in self.edges), default=self.points)

    @property
    def slots(self) -> int:
        """Nodes, angles and rotation vectors of the stencil."""
        return self.nodes + self.angles + self.spins

    @property
    def starts(self) -> tuple[int, int, int]:
        """First local dofs of angles, of rotation vectors, and of points."""
        angles = self.dim * len(self.edges)
        spins = angles + self.angles
        return angles, spins, spins + 3 * self.spins

    @property
    def ends(self) -> tuple[list[int], list[int]]:
        """Of each slot, the first local dof that it sees with weight 1, and with -1, -1 for none.

        A node sees the edge that ends in it and that which starts in it, of which there is one each at most, or itself as a position
        where no edge ends; angles and rotations see themselves.
        """
        angles, spins, points = self.starts
        own = [*range(angles, spins), *range(spins, points, 3)]
        minus, plus = ({edge[end]: 3 * i for i, edge in enumerate(self.edges)} for end in (0, 1))
        plus = {n: points + 3 * n for n in range(self.points)} | plus
        nodes = range(self.nodes)
        return [*(plus.get(n, -1) for n in nodes), *own], [*(minus.get(n, -1) for n in nodes), *([-1] * len(own))]

    @property
    def packed(self) -> int:
        """Reals of its second derivatives, contracted with stresses: an upper triangle; 0 where they are left to reverse mode."""
        return self.size * (self.size + 1) // 2 if self.functions(wp.float64)[3] else 0

    @property
    def twists(self) -> bool:
        """Whether the strains are the curvatures and the twist between two edges of a rod."""
        return self.strains[-1].startswith("twist")

    @property
    def vector(self) -> bool:
        """Whether the strains are the components of a vector in space."""
        return [name.split()[0][-2:] for name in self.strains] == ["_x", "_y", "_z"]

    @property
    def span(self) -> int:
        """Edges of a chain stencil: 1 for an edge, 2 for a vertex."""
        return len(self.edges)

    def types(self, real):
        """Vector of dofs, of lagged and constant data, of strains, and matrix of the Jacobian."""
        return (
            wp.types.vector(self.size, real),
            wp.types.vector(max(1, self.lag_size + self.data_size), real),
            wp.types.vector(len(self.strains), real),
            wp.types.matrix((len(self.strains), self.size), real),
        )


def lagged_frames(random: np.random.Generator, edges: np.ndarray) -> np.ndarray:
    """Reference frames (u, t) (6, ...) of edges (..., 3), with tangents 25 degrees from theirs at random; for samples."""
    t = edges / np.linalg.norm(edges, axis=-1, keepdims=True)
    across, director = np.cross(t, random.normal(size=t.shape)), random.normal(size=t.shape)
    t = t + across / np.linalg.norm(across, axis=-1, keepdims=True) * np.tan(np.radians(25.0))
    frame = np.stack([np.cross(t, director), t])
    frame /= np.linalg.norm(frame, axis=-1, keepdims=True)
    return np.moveaxis(frame, -1, 1).reshape(6, *t.shape[:-1])
