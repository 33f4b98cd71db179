"""Hat functions on background grids over the rest shape, as coarse spaces of a mesh; see `kernels.linear.multilevel`."""

from dataclasses import dataclass

import numpy as np

COARSEST = 60  # hats of the last level, at most
GROWTH = 2.0 ** (1.0 / 3.0)  # of the grid spacing, while a grid has too many hats
RATIO = 0.35  # hats for a coarsened point, at most; flat meshes have 1 / 4, and more along rims
CUT = 0.5  # the same, once cut by connectivity
LEAST = 0.3  # points that a level coarsens, at least
COARSE = 0.75  # grid spacings: distance to the nearest neighbour from which a point is a hat by itself
FLAT = 0.25  # grid spacings: extent below which an axis of the grid is left out
SNAP = 0.02  # grid spacings: distance to a grid plane that counts as none


@dataclass
class Level:
    """Hats of a level over the points of the level below.

    Attributes:
        weights: (points, hats) CSR matrix P; rows sum to one, or to zero for points without neighbours.
        product: pattern of A P, for the matrix A of the level below, as a CSR matrix.
        pattern: pattern of P^T A P, as a CSR matrix.
    """

    weights: object
    product: object
    pattern: object


def coarse_levels(points: np.ndarray, pattern) -> list[Level]:
    """Return the levels of hats from fine to coarse, until about `COARSEST` are left.

    Args:
        points: (n, 3) rest positions [m].
        pattern: (n, n) CSR pattern of the matrix, symmetric with its diagonal.

    A hat is trilinear over a grid cell in each direction. Spacing doubles from level to level. A support with components that
    no entry of the matrix joins has one hat for each of them: layers near each other stay independent. Points whose neighbours are far
    apart, compared with the spacing, are carried to the next level. So graded meshes are coarsened from the finest cells on.

    Alternative: quadratic B-splines on levels over 50,000 hats, without the kinks of trilinear hats, which cost bending energy. Their
    matrices have 49 blocks a row, not 25.

    Measured: by B-splines a sheet of 512 x 512 takes 33 iterations a step instead of 38. A step at rtol 0.1 takes 9.1 ms on an H100
    instead of 4.3, most of it for the set-up.
    """
    from scipy.sparse import identity

    joined = np.diff(pattern.indptr) > 1
    if np.count_nonzero(joined) <= COARSEST:
        return []
    embedding = identity(len(points), format="csr")[:, joined]
    x, pattern, levels, size = points[joined], pattern[joined][:, joined], [], None
    x = x @ _axes(x)
    while len(x) > COARSEST:
        near = _nearest(x, pattern)
        finite = np.isfinite(near)
        if not finite.any():
            break
        if size is None:
            size = _fitted(x, 2.0 * np.quantile(near[finite], 0.1))
        weights, x, size = _hats(x, near, pattern, size)
        product = _ones(pattern @ _ones(weights))
        pattern = _ones(_ones(weights).T @ product)
        if not levels:
            weights, product = embedding @ weights, _ones(embedding @ product)
        levels.append(Level(weights, product, pattern))
        size = 2.0 * size
    return levels


def _axes(points: np.ndarray) -> np.ndarray:
    """Return the principal axes (3, 3) in columns; coordinate axes where rounding decides."""
    x = points - points.mean(0)
    covariance = x.T @ x
    covariance[np.abs(covariance) < 1e-9 * np.trace(covariance)] = 0.0
    return np.linalg.eigh(covariance)[1]


def _ones(matrix):
    """Return a CSR pattern with sorted columns, ones as entries."""
    from scipy.sparse import csr_matrix

    result = csr_matrix(matrix)
    result.sort_indices()
    return csr_matrix((np.ones(result.nnz, np.int32), result.indices, result.indptr), shape=result.shape)


def _nearest(x: np.ndarray, pattern) -> np.ndarray:
    """Return distances (n,) to the nearest neighbours in the pattern; infinite without neighbours."""
    row = np.repeat(np.arange(len(x)), np.diff(pattern.indptr))
    distance = np.linalg.norm(x[row] - x[pattern.indices], axis=1)
    distance[(row == pattern.indices) | (distance == 0.0)] = np.inf
    return np.minimum.reduceat(distance, pattern.indptr[:-1])


def _fitted(x: np.ndarray, spacing: float) -> np.ndarray:
    """Return the cell size (3,) near a spacing, such that whole cells cover the points along each axis."""
    span = np.ptp(x, axis=0)
    return np.where(span < FLAT * spacing, spacing, span / np.maximum(1, np.round(span / spacing)))


def _hats(x: np.ndarray, near: np.ndarray, pattern, size: np.ndarray):
    """Return the weights of few enough hats as a CSR matrix (n, hats), positions of hats, and the cell size of their grid.

    Args:
        near: distance to the nearest neighbour (n,) [m].
        size: cell size to begin with (3,) [m]. Twice the size of the level below nests the grids, so that hats have few parents.
    """
    low, span = x.min(0), np.ptp(x, axis=0)
    corner = np.array([[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)])
    while True:
        spacing = size.max()
        alone = near > COARSE * spacing
        coarsened = np.count_nonzero(~alone)
        flat = span < FLAT * size
        if coarsened >= LEAST * len(x) or flat.all():
            t = np.where(flat, 0.0, (x - low) / size)
            cells = np.maximum(1, np.ceil(t.max(0) - SNAP)).astype(np.int64)
            cell = np.clip(np.floor(t + SNAP), 0, cells - 1).astype(np.int64)
            f = np.clip(t - cell, 0.0, 1.0)
            f = np.where(f < SNAP, 0.0, np.where(f > 1.0 - SNAP, 1.0, f))
            vertex = cell[:, None] + corner
            weights = np.where(corner, f[:, None], 1.0 - f[:, None]).prod(-1)
            keys = (vertex[..., 0] * (cells[1] + 2) + vertex[..., 1]) * (cells[2] + 2) + vertex[..., 2]
            if len(np.unique(keys[~alone][weights[~alone] > 0.0])) <= RATIO * coarsened or flat.all():
                where = low + vertex * np.where(flat, 0.0, size)
                weights[alone] = [1.0] + 7 * [0.0]
                keys[alone, 0] = keys.max() + 1 + np.flatnonzero(alone)
                where[alone, 0] = x[alone]
                hats, positions = _cut(keys, weights, where, pattern)
                if len(positions) - (len(x) - coarsened) <= CUT * coarsened or flat.all():
                    return hats, positions, size
        size = _fitted(x, GROWTH * spacing)


def _cut(keys: np.ndarray, weights: np.ndarray, where: np.ndarray, pattern):
    """Return the weights (n, hats) as a CSR matrix, and the positions of hats; one hat for each component of a support.

    Args:
        keys, weights, where: grid corners of each point (n, 8): number, weight, and position (n, 8, 3).
    """
    from scipy.sparse import coo_matrix, csr_matrix
    from scipy.sparse.csgraph import connected_components

    used = np.flatnonzero((weights > 0.0).any(0))
    keys, weights, where = keys[:, used], weights[:, used], where[:, used]
    positive = weights > 0.0
    number = np.cumsum(positive.ravel()).reshape(positive.shape) - 1
    row = np.repeat(np.arange(len(keys)), np.diff(pattern.indptr))
    upper = row < pattern.indices
    i, j = row[upper], pattern.indices[upper]
    first, second = [], []
    for a in range(len(used)):
        for b in range(len(used)):
            both = np.flatnonzero(keys[i, a] == keys[j, b])
            both = both[positive[i[both], a] & positive[j[both], b]]
            first.append(number[i[both], a])
            second.append(number[j[both], b])
    first, second = np.concatenate(first), np.concatenate(second)
    entries = np.count_nonzero(positive)
    graph = coo_matrix((np.ones(len(first), bool), (first, second)), shape=(entries, entries))
    count, component = connected_components(graph, directed=False)
    positions = np.zeros((count, 3))
    positions[component] = where[positive]
    hats = csr_matrix((weights[positive], (np.nonzero(positive)[0], component)), shape=(len(keys), count))
    hats.sort_indices()
    return hats, positions
