"""Random positive definite banded matrices of rods."""

import numpy as np


def system(nb: int, counts: tuple[int, ...], rng, span: int = 2) -> tuple[np.ndarray, list]:
    """Return definite block-banded matrices of rods as bands (3 nb^2, nodes, columns), and the same as dense matrices.

    `counts`: nodes of each rod; `span`: bandwidth in blocks.
    """
    bands, matrices = np.zeros((3, nb, nb, max(counts), len(counts))), []
    for column, n in enumerate(counts):
        L = np.zeros((n, nb, n, nb))
        for k in range(n):
            for back in range(min(span + 1, k + 1)):
                L[k, :, k - back] = rng.normal(size=(nb, nb))
        L = L.reshape(n * nb, n * nb)
        H = (L @ L.T + 0.5 * np.eye(n * nb)).reshape(n, nb, n, nb)
        matrices.append(H.reshape(n * nb, n * nb))
        for k in range(n):
            for offset in range(min(span + 1, n - k)):
                bands[offset, :, :, k, column] = H[k, :, k + offset]
    return bands.reshape(3 * nb**2, max(counts), len(counts)), matrices
