"""Exact Hessian of contact as a sparse matrix on the host, for tangents of equilibria."""

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact.assembly import PAIR_NODES
from ddg_warp.kernels.collision.contact.pair_evaluation import columns_kernel

COLUMNS = 3 * PAIR_NODES


def hessian(terms, x: wp.array) -> sparse.csc_matrix:
    """Return the Hessian of the contact energy of `ContactPotential` at x (W N,), as evaluated last (3 W N, 3 W N) [N/m].

    Without friction. Reads from the device.
    """
    size = 3 * len(x)
    total = sparse.csc_matrix((size, size))
    for elements in terms.lists:
        rows, columns, values = _entries(elements, terms.law, x)
        total += sparse.csc_matrix((values, (rows, columns)), shape=(size, size))
    return 0.5 * (total + total.T)


def _entries(elements, law, x: wp.array) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and values of the Hessians of all active pairs of `ContactSet`."""
    number = int(elements.count.numpy()[0])
    if not number:
        return np.zeros(0, int), np.zeros(0, int), np.zeros(0)
    out = device_arrays.allocate((COLUMNS, PAIR_NODES, number), wp.types.vector(3, elements.linear), x.device)
    threads, every = (
        device_arrays.takers(COLUMNS * number, x.device),
        wp.array(np.arange(number), dtype=int, device=x.device),
    )
    kernel = columns_kernel(elements.found.kind, elements.density, elements.real, elements.linear)
    inputs = [elements.pairs, elements.found.sides, law, x, elements.factor, every, elements.count, threads]
    wp.launch(kernel, threads, inputs, [out], device=x.device)
    values = device_arrays.download(out).astype(float).transpose(2, 0, 1, 3).reshape(number, COLUMNS, COLUMNS)
    nodes = elements.factor.nodes.numpy()[:number]
    dofs = (3 * nodes[:, :, None] + np.arange(3)).reshape(number, COLUMNS)
    columns, rows = (np.broadcast_to(v, values.shape) for v in (dofs[:, :, None], dofs[:, None, :]))
    return rows.ravel(), columns.ravel(), values.ravel()
