"""Strain measures: geometry. A measure maps the local dofs of an element to a few strains.

The local dofs are q = [edge vectors of the stencil..., twist angles of edges..., rotation vectors of joints..., positions...].
Translation invariance holds by construction, and forces on nodes are differences of edge forces. Positions are included only where a
strain depends on them: the radius of a surface of revolution, or a field that varies in space.

Measures may also read s, constant during a step: lagged frames of a rod, or element data such as a clamp's normal or the
magnetic field. The rest measure w of an element is its rest length, Voronoi length, area or volume. Strains are pointwise, so a density
and its parameters do not depend on the mesh.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp


@dataclass(frozen=True)
class Measure:
    """A kind of strain.

    Attributes:
        name: name of the measure.
        dim: dimension of space, 2 or 3.
        edges: pairs of local nodes; edge i of the stencil is x[j] - x[i].
        angles: number of edges with an angle as dof; of a rod the first of the stencil, of a triangle its sides.
        lag_size: reals of lagged data of the stencil; 0 for a measure without frames.
        data_size: reals of constant data of the element; 0 for a measure without.
        tensions: scalars of the geometric stiffness; 0 if left to the exact Hessian.
        spins: rotation vectors of rigid joints among the dofs, after the angles.
        points: number of nodes, the first of the stencil, read as positions, too; after the rotation vectors.
        field: number of data, the last, that are the magnetic field, which changes with time.
        apart: True if it couples nodes far apart along a rod; substructuring leaves it out.
        frames: number of angles of edges with a reference frame; the lagged data begin with these frames.
        by_angle: True if a rod's curvature is the turning angle over the length, instead of 2 tan(phi/2).
        revolved: True if elements are of the meridian of a surface of revolution, in the plane y = 0.
        vectors: rows of the lagged data behind the frames, and of the constant data after them, at which a vector of space begins,
            three reals that rotate with the element. (Frames and the field rotate, too.)
        strains: names and units of the strains; components of a vector of space end in _x, _y, _z.
        functions: real -> (strains, jacobian, tension, curvature). `strains(q, s, w) -> E`. `jacobian(q, s, w) -> (E, J)`. `tension`
            is None, or `tension(q, w, slope) -> (c, shift)` with the second derivative of the strains, w slope : d2e = C + w J^T
            diag(shift) J. One edge has one tension, a scalar c with C = c I. A triangle has three, the vector c = (c11, c12, c22),
            and C has the blocks c_ij I between its edge vectors i and j. `curvature` is None, or `curvature(q, s, w, slope)`, of rod
            vertices and rigid joints: w slope : d2e as the upper triangle of a symmetric matrix, row by row.
        advance: None, or real -> advance(q, s): lagged data behind the frames at the end of a step, from the dofs and frames there
            and the old data.
        stale: None, or real -> stale(q, s): True if frames have to be updated before the next step of a solve.
        prepared: None, or real -> (edge, functions, stale) of a vertex whose edges are evaluated once for both their vertices.
            `edge(e, u, t, angle)`: prepared data of an edge from its vector, lagged frame and twist angle, as a vector. `functions`
            and `stale` are the above, with the prepared data of both edges and the lagged data behind the frames as s.
        sample: None, or (random, count) -> non-default data of sample elements for `ddg_warp.run.derivative_checks`, by name. `nodes
            (nodes, 3)`: centres of the nodes. `data (data_size, count)`. `frame (6, frames * count)`: the first frames of all
            elements first. `lag (rows, count)`: behind the frames. `felt (slots, count)`: local nodes that the strains depend on.
            Default nodes are unit steps along x, z and y in alternation, data between 0.5 and 1.5, frames 25 degrees old, the lag
            large.
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
    prepared: Callable | None = None
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
        """Number of nodes of the stencil."""
        return max((1 + max(pair) for pair in self.edges), default=self.points)

    @property
    def slots(self) -> int:
        """Number of nodes, angles and rotation vectors of the stencil."""
        return self.nodes + self.angles + self.spins

    @property
    def starts(self) -> tuple[int, int, int]:
        """First local dofs of angles, of rotation vectors, and of points."""
        angles = self.dim * len(self.edges)
        spins = angles + self.angles
        return angles, spins, spins + 3 * self.spins

    @property
    def ends(self) -> tuple[list[int], list[int]]:
        """First local dofs seen with weight 1, and with -1, by each node, angle and rotation; -1 for none.

        A node sees the edge that ends in it and the edge that starts in it, at most one each, or its own position where no edge ends.
        Angles and rotations see themselves.
        """
        angles, spins, points = self.starts
        single = [*range(angles, spins), *range(spins, points, 3)]
        minus, plus = ({edge[end]: 3 * i for i, edge in enumerate(self.edges)} for end in (0, 1))
        plus = {n: points + 3 * n for n in range(self.points)} | plus
        nodes = range(self.nodes)
        return [*(plus.get(n, -1) for n in nodes), *single], [*(minus.get(n, -1) for n in nodes), *([-1] * len(single))]

    @property
    def packed(self) -> int:
        """Number of reals of second derivatives contracted with stresses (an upper triangle); 0 if left to reverse mode."""
        return self.size * (self.size + 1) // 2 if self.functions(wp.float64)[3] else 0

    @property
    def twists(self) -> bool:
        """True if the strains are the curvatures and the twist between two edges of a rod."""
        return self.strains[-1].startswith("twist")

    @property
    def vector(self) -> bool:
        """True if the strains are the components of a vector in space."""
        return [name.split()[0][-2:] for name in self.strains] == ["_x", "_y", "_z"]

    @property
    def span(self) -> int:
        """Number of edges of a rod stencil: 1 for an edge, 2 for a vertex."""
        return len(self.edges)

    def types(self, real):
        """Return the types of dofs, of lagged and constant data, of strains (vectors) and of the Jacobian (matrix)."""
        return (
            wp.types.vector(self.size, real),
            wp.types.vector(max(1, self.lag_size + self.data_size), real),
            wp.types.vector(len(self.strains), real),
            wp.types.matrix((len(self.strains), self.size), real),
        )


def lagged_frames(random: np.random.Generator, edges: np.ndarray) -> np.ndarray:
    """Return reference frames (u, t) (6, ...) of edges (..., 3), with tangents rotated by 25 degrees at random; for samples."""
    t = edges / np.linalg.norm(edges, axis=-1, keepdims=True)
    across, director = np.cross(t, random.normal(size=t.shape)), random.normal(size=t.shape)
    t = t + across / np.linalg.norm(across, axis=-1, keepdims=True) * np.tan(np.radians(25.0))
    frame = np.stack([np.cross(t, director), t])
    frame /= np.linalg.norm(frame, axis=-1, keepdims=True)
    return np.moveaxis(frame, -1, 1).reshape(6, *t.shape[:-1])
