"""A state at which nothing overlaps, from one at which something does."""

import numpy as np
import warp as wp

from ddg_warp import arguments
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.kernels.contact.look import closest_kernel
from ddg_warp.model import glue
from ddg_warp.threads import launches

ROUNDS = 1000
PART = 0.1  # of the smallest range of contact, the gap that is made by default
BEYOND = 1.02  # what is too close is moved to so many times that gap, so that few rounds do


@launches
def pushed_apart(model, state, gap: float | None = None):
    """A state like another, with nodes moved until no two surfaces are closer than a gap, and the farthest that a node moved.

    Pairs that are too close are moved apart along the line between their closest points by least squares, round by round; what is
    supported stays. Rods whose axes cross pass by each other then; what is entangled stays so. Velocities stay as they are, frames
    are carried along. Lengths change by as much as has to be: look at the distance that is returned.

    Args:
        gap: [m]; by default a tenth of the smallest range of contact.

    Returns:
        The state, and the distance [m]; zero where nothing was too close.

    Raises:
        SceneError: the scene has no contact, or the gap is not within its range.
        SolverError: what is too close cannot be moved apart; names the closest pair.
    """
    touch = model.touch
    if touch is None:
        raise SceneError("pushed_apart: this scene has no contact; add scene.contact()")
    net, host = model.net, model.net.host
    least = (
        PART * float(host.touching.range.min()) if gap is None else arguments.positive("pushed_apart: gap", gap, "m")
    )
    if least > touch.search.reach:
        raise SceneError(
            f"pushed_apart: gap is {least:.6g} m; contact is within {touch.search.reach:.6g} m, which it may not exceed"
        )
    new = state.copy()
    start = new.net.q.numpy().reshape(-1, 3).astype(float)
    x, free = start.copy(), np.tile(~host.fixed.astype(bool), (model.worlds, 1)).astype(float)
    for _ in range(ROUNDS):
        new.net.q.assign(x)
        touch.find(new.net.q)
        steps, shares, closest = np.zeros_like(x), np.zeros(len(x)), np.inf
        for pairs in touch.search.lists:
            closest = min(closest, _part(pairs, new.net.q, free, least, steps, shares))
        if closest >= least:
            break
        x = x + steps / np.maximum(1.0, shares)[:, None]
    else:
        gap, pair = touch.closest(new.net.q)
        raise SolverError(
            f"pushed_apart: {pair} are still {gap:.3g} m apart, less than {least:.3g} m, after {ROUNDS} rounds; move them apart, free "
            "what holds them, or give them a smaller radius",
            outcome="no_room",
        )
    moved = float(np.linalg.norm(x - start, axis=1).max(initial=0.0))
    if moved > 0.0:
        model.carry_frames(new)
        glue.follow(net, new.net, angles=True, rates=False)
        model.update_strains(new)
    return new, moved


def _part(pairs, x: wp.array, free: np.ndarray, least: float, steps: np.ndarray, shares: np.ndarray) -> float:
    """Add to `steps` of nodes what takes the pairs of a list apart, and to `shares` how much of it each has; their smallest gap."""
    count = int(pairs.count.numpy()[0])
    if not count:
        return np.inf
    real = x.dtype._wp_scalar_type_
    kinds = x.dtype, wp.vec4i, wp.types.vector(4, real), real
    found = [wp.zeros(count, dtype=kind, device=x.device) for kind in kinds]
    wp.launch(closest_kernel(pairs.kind, real), count, [pairs.pairs, pairs.sides, x], found, device=x.device)
    way, nodes, weights, thickness = (array.numpy() for array in found)
    length = np.linalg.norm(way, axis=1)
    gap = length - thickness
    near = np.flatnonzero(gap < least)
    if len(near):
        weights, nodes = weights[near], nodes[near]
        n = _directions(way[near], length[near], x.numpy()[nodes], pairs.kind.endless)
        may = free[nodes] * n[:, None]  # (pairs, nodes, 3), what of the direction each node is free to go
        give = (weights**2 * (may * n[:, None]).sum(2)).sum(1)
        size = np.where(give > 0.0, (BEYOND * least - gap[near]) / np.where(give > 0.0, give, 1.0), 0.0)
        np.add.at(steps, nodes, (size[:, None] * weights)[..., None] * may)
        np.add.at(shares, nodes, np.abs(weights) * (give > 0.0)[:, None])
    return float(gap.min())


def _directions(way: np.ndarray, length: np.ndarray, corners: np.ndarray, endless: bool) -> np.ndarray:
    """Unit vectors (n, 3) along ways; across both sides where closest points are the same. Of `endless` half-spaces their normals."""
    if endless:
        way = np.cross(corners[:, 2] - corners[:, 1], corners[:, 3] - corners[:, 1])
        return way / np.linalg.norm(way, axis=1)[:, None]
    sides = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 2]
    size = np.maximum(np.linalg.norm(sides[0], axis=1), np.linalg.norm(sides[1], axis=1))
    across = np.cross(*sides)
    flat = np.linalg.norm(across, axis=1) <= 1e-9 * size**2  # parallel: any direction across does
    some = np.eye(3)[np.abs(sides[0]).argmin(1)]
    across = np.where(flat[:, None], np.cross(np.where(sides[0].any(1)[:, None], sides[0], sides[1]), some), across)
    meet = length <= 1e-9 * size
    way = np.where(meet[:, None], across, way)
    return way / np.linalg.norm(way, axis=1)[:, None]
