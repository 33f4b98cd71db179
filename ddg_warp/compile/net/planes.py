"""Nodes of a net on planes that are not across an axis of space: the frames their dofs are held and solved in.

A symmetry plane holds the displacement along its normal. Where that is no axis of space, the node gets an orthonormal frame with the
held directions first; `Net.fixed` then speaks of components in this frame. Positions stay in space everywhere: host and device turn
forces and tangents into the frames, and directions back.
"""

import numpy as np

from ddg_warp.errors import SceneError

ALIGNED = 1e-12  # how far a held direction may be off an axis that it is taken for


def frames_of_planes(net, normals: dict[int, list]) -> None:
    """Hold nodes along the normals of their planes, whatever else holds them.

    Raises:
        SceneError: a node on such a plane is also moved.
    """
    moves = set(net.moving[:, 0].tolist())
    for block, given in normals.items():
        if block in moves:
            raise SceneError(
                "the point at ({:g}, {:g}, {:g}) m is on a symmetry plane across {} and moved by a support; give the support other "
                "vertices".format(*net.rest[block], tuple(np.round(given[0], 6).tolist()))
            )
        held = np.concatenate([np.eye(3)[net.fixed[block]], given])
        _, size, directions = np.linalg.svd(held)
        rank = int((size > 1e-9).sum())
        along = directions[:rank].T @ directions[:rank]  # projector on what is held
        axes = np.diag(along) > 0.5
        if np.abs(along - np.diag(axes)).max() <= ALIGNED:
            net.fixed[block] = axes
        else:
            net.fixed[block] = np.arange(3) < rank
            net.frames[block] = directions
