"""Skew supports: nodal frames of nodes on planes across no coordinate axis.

A symmetry plane fixes the displacement along its normal. If that is no coordinate axis, the node gets an orthonormal frame with the
fixed directions first, and `CoupledSystem.fixed` refers to components in this frame. Positions stay in space: host and device
    rotate forces and tangents into the nodal frames, and search directions back.
"""

import numpy as np

from ddg_warp.errors import SceneError

ALIGNED = 1e-12  # tolerance of a fixed direction from an axis that it counts as


def frames_of_planes(coupled, normals: dict[int, list]) -> None:
    """Fix nodes along the normals of symmetry planes, in addition to other constraints.

    Raises:
        SceneError: a node on such a plane also has a prescribed motion.
    """
    moves = set(coupled.moving[:, 0].tolist())
    for block, plane_normals in normals.items():
        if block in moves:
            raise SceneError(
                "the point at ({:g}, {:g}, {:g}) m is on a symmetry plane across {} and moved by a support; give the support other "
                "vertices".format(*coupled.rest[block], tuple(np.round(plane_normals[0], 6).tolist()))
            )
        fixed_directions = np.concatenate([np.eye(3)[coupled.fixed[block]], plane_normals])
        _, size, directions = np.linalg.svd(fixed_directions)
        rank = int((size > 1e-9).sum())
        along = directions[:rank].T @ directions[:rank]  # projector on the fixed directions
        axes = np.diag(along) > 0.5
        if np.abs(along - np.diag(axes)).max() <= ALIGNED:
            coupled.fixed[block] = axes
        else:
            coupled.fixed[block] = np.arange(3) < rank
            coupled.frames[block] = directions
