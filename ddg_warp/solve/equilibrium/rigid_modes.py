"""Rigid-body modes that supports leave: of every free component, and the spin of rods about their axes.

Rods, shells and shells of revolution are bodies with three translations, three rotations and, for rods with twist, a spin. Motions of
bodies agree on common dofs (hinges, attachments, rotations of rigid joints) and vanish at fixed dofs. Motions in the null space of the
tangent stiffness are zero modes: all of them without loads, else the motions along which the loads do no work.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

MOST = 64  # Largest number of bodies of a component with separate motions; beyond it the component moves as a whole.
DEPENDENT = 1e-9  # Singular values of dependent unit vectors, or of constrained motions.
ROUNDING = 1e3  # Stiffness over its diagonal that counts as zero, in rounding units.


@dataclass(frozen=True)
class Body:
    """Dofs of a body that can move rigidly.

    Attributes:
        nodes: dofs of positions (n, 3), -1 where absent.
        angles: dofs of twist angles (m,); ends: row of `nodes` of both edge nodes (m, 2).
        spins: dofs of rotations of rigid joints (s, 3).
    """

    nodes: np.ndarray
    angles: np.ndarray
    ends: np.ndarray
    spins: np.ndarray

    def motions(self, q: np.ndarray, centre: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
        """Return dofs (d,) and rates (d, 7) in three translations, three rotations about a centre, and spin."""
        exists = self.nodes >= 0
        x = np.where(exists, q[self.nodes], 0.0)
        axes = np.eye(3)
        columns = np.zeros((len(x), 3, 7))
        columns[:, :, :3] = axes
        columns[:, :, 3:6] = np.stack([np.cross(axis, x - centre) for axis in axes], axis=2) / size
        edges = x[self.ends[:, 1]] - x[self.ends[:, 0]]
        turn = np.zeros((len(self.angles), 7))
        turn[:, 3:6] = edges / np.linalg.norm(edges, axis=1, keepdims=True) / size
        turn[:, 6] = 1.0 / size
        spin = np.zeros((len(self.spins), 3, 7))
        spin[:, :, 3:6] = axes / size
        dofs = np.concatenate([self.nodes[exists], self.angles, self.spins.ravel()])
        return dofs, np.concatenate([columns[exists], turn, spin.reshape(-1, 7)])


def rigid_modes(tangent, state, stiffness: sparse.csc_matrix) -> np.ndarray:
    """Return independent zero modes (size, number) of the supports and the tangent stiffness (size, size)."""
    q = tangent.dofs(state)
    bodies = [body for part in tangent.parts for body in part.bodies()]
    present_dofs = np.concatenate([body.nodes.max(axis=1) for body in bodies])
    inside = np.concatenate([np.where(body.nodes >= 0, q[body.nodes], 0.0) for body in bodies])[present_dofs >= 0]
    centre, size = inside.mean(axis=0), max(1e-300, np.linalg.norm(np.ptp(inside, axis=0)))
    # angles times the size are comparable with displacements at any size
    lever = np.where(tangent.angle, size, 1.0)
    motions = [
        (dofs, lever[dofs][:, None] * columns) for dofs, columns in (body.motions(q, centre, size) for body in bodies)
    ]
    belongs = sparse.csr_matrix(
        (
            np.ones(sum(len(dofs) for dofs, _ in motions)),
            np.concatenate([dofs for dofs, _ in motions]),
            np.cumsum([0] + [len(dofs) for dofs, _ in motions]),
        ),
        shape=(len(bodies), tangent.size),
    )
    count, piece = connected_components(belongs @ belongs.T, directed=False)
    order = np.argsort(piece, kind="stable")
    result = []
    tolerance = ROUNDING * tangent.model.types.eps
    for members in np.split(order, np.searchsorted(piece[order], np.arange(1, count))):
        dofs, columns = _of_piece([motions[i] for i in members], tangent.free)
        if columns.shape[1]:
            result += _unresisted(dofs, columns / lever[dofs][:, None], stiffness, tolerance)
    modes = np.zeros((tangent.size, len(result)))
    for mode, (dofs, values) in zip(modes.T, result, strict=True):
        mode[dofs] = values
    return modes


def _of_piece(motions: list, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return dofs of a component (d,) and motions (d, m), zero at fixed dofs and compatible between bodies."""
    every = np.concatenate([dofs for dofs, _ in motions])
    dofs, first, inverse = np.unique(every, return_index=True, return_inverse=True)
    if len(motions) > MOST:
        columns = np.concatenate([columns[:, :6] for _, columns in motions])
    else:
        columns = np.zeros((len(every), 7 * len(motions)))
        ends = np.cumsum([0] + [len(d) for d, _ in motions])
        for i, (_, values) in enumerate(motions):
            columns[ends[i] : ends[i + 1], 7 * i : 7 * i + 7] = values
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    twice = np.setdiff1d(np.arange(len(every)), first)
    conditions = np.concatenate([columns[~free[every]], columns[twice] - columns[first[inverse[twice]]]])
    values, sizes, _ = np.linalg.svd(columns[first] @ _null_space(conditions, DEPENDENT), full_matrices=False)
    return dofs, values[:, sizes > DEPENDENT]  # spin and rotation of a straight rod are one motion


def _unresisted(dofs: np.ndarray, columns: np.ndarray, stiffness, tolerance: float) -> list:
    """Return (dofs, values) of the independent motions in the null space of the stiffness."""
    matrix = stiffness[:, dofs]
    root = np.sqrt(np.abs(stiffness.diagonal()))
    largest = root.max(initial=0.0)
    root = np.where(root > 0.0, root, largest or 1.0)
    weight = root[dofs]
    basis = np.linalg.qr(weight[:, None] * columns)[0]
    force = (matrix @ (basis / weight[:, None])) / root[:, None]
    null = _null_space(force, tolerance)
    return [(dofs, values) for values in ((basis @ null) / weight[:, None]).T]


def _null_space(rows: np.ndarray, tolerance: float) -> np.ndarray:
    """Return the orthonormal null space (columns, m) of `rows`, to a tolerance."""
    size = rows.shape[1]
    if not len(rows):
        return np.eye(size)
    _, values, vectors = np.linalg.svd(np.linalg.qr(rows, mode="r"), full_matrices=True)
    return vectors[np.append(values, np.zeros(size - len(values))) <= tolerance].T
