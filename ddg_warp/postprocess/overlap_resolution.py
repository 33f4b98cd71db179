"""Overlap resolution: project a state with overlaps to a minimum gap."""

import numpy as np
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.capture_lock import launches
from ddg_warp.errors import SceneError, SolverError
from ddg_warp.kernels.collision.contact.query import closest_kernel
from ddg_warp.model import rod_shell_coupling
from ddg_warp.solve.equilibrium.carried_dofs import CarriedDofs

ROUNDS = 1000
PART = 0.1  # default gap over the smallest activation distance
BEYOND = 1.02  # gap that pairs are moved to over the required one, for few rounds


@launches
def resolve_overlaps(model, state, gap: float | None = None):
    """Return a copy of a state, with nodes moved until no two surfaces are closer than a gap.

    Each round moves close pairs apart along the line between their closest points, by least squares. Fixed dofs stay, and rigid bodies
    move as such. Crossing rods pass by each other then; entangled ones stay entangled. Velocities stay, frames are transported.
    Lengths may change: check the returned distance.

    Args:
        gap: smallest surface distance [m]; by default a tenth of the smallest activation distance.

    Returns:
        The state, and the largest displacement of a node [m]; zero if no pair was too close.

    Raises:
        SceneError: the scene has no contact, or the gap exceeds the activation distance.
        SolverError: pairs cannot be separated; the message names the closest.
    """
    touch = model.touch
    if touch is None:
        raise SceneError("resolve_overlaps: this scene has no contact; add scene.contact()")
    coupled, host = model.coupled, model.coupled.host
    least = (
        PART * float(host.contact_parameters.range.min())
        if gap is None
        else argument_checks.positive("resolve_overlaps: gap", gap, "m")
    )
    if least > touch.search.search_distance:
        raise SceneError(
            f"resolve_overlaps: gap is {least:.6g} m; it may not exceed the search distance, {touch.search.search_distance:.6g} m"
        )
    new = state.copy()
    start = new.coupled.q.numpy().reshape(-1, 3).astype(float)
    x, free = start.copy(), np.tile(~host.fixed.astype(bool), (model.worlds, 1)).astype(float)
    bodies = _Bodies(host, model.worlds, free) if host.rigid_bodies else None
    for _ in range(ROUNDS):
        new.coupled.q.assign(x)
        touch.find(new.coupled.q)
        steps, weights, closest = np.zeros_like(x), np.zeros(len(x)), np.inf
        for pairs in touch.search.lists:
            closest = min(closest, _separate(pairs, new.coupled.q, free, least, steps, weights, bodies))
        if closest >= least:
            break
        steps /= np.maximum(1.0, weights)[:, None]
        x = bodies.moved(x, steps, new.coupled) if bodies else x + steps
    else:
        gap, pair = touch.closest(new.coupled.q)
        raise SolverError(
            f"resolve_overlaps: {pair} are still {gap:.3g} m apart, less than {least:.3g} m, after {ROUNDS} rounds; "
            "separate them, free "
            "one of their supports, or give them a smaller radius",
            outcome="no_room",
        )
    moved = float(np.linalg.norm(x - start, axis=1).reshape(model.worlds, -1)[:, : host.nodes].max(initial=0.0))
    if moved > 0.0:
        if bodies:
            new.coupled.q.assign(bodies.carried.rotated(x, new.coupled, state.coupled).reshape(-1, 3))
        model.carry_frames(new)
        if bodies:
            coupled.bodies.carry(new.coupled)
        rod_shell_coupling.follow(coupled, new.coupled, angles=True, rates=False)
        model.update_strains(new)
    return new, moved


class _Bodies:
    """Rigid bodies of all worlds, which pairs move by the nodes that they carry.

    Args:
        free: free dofs of blocks, 1 or 0 (W N, 3).
    """

    def __init__(self, host, worlds: int, free: np.ndarray):
        rigid, shift, self._free = host.rigid_bodies, host.blocks * np.arange(worlds)[:, None], free
        self.carried = CarriedDofs(host, worlds)
        self._blocks = np.stack([(shift + blocks).ravel() for blocks in (rigid.origins, rigid.spins)])
        self._length = np.tile(rigid.lengths(host.mass), worlds)
        self._owner = np.full(worlds * host.blocks, -1)
        self._owner[(shift + rigid.carried).ravel()] = (len(rigid) * np.arange(worlds)[:, None] + rigid.owner).ravel()

    def rates(self, x: np.ndarray, nodes: np.ndarray, weights: np.ndarray, n: np.ndarray) -> tuple:
        """Return by body of a pair: the pair, the two blocks, and rates of the gap by translation and by rotation times a length.

        Args:
            x: positions (W N, 3) [m]. nodes, weights: of pairs (n, 4). n: directions (n, 3).
        """
        pair, local = np.nonzero((self._owner[nodes] >= 0) & (weights != 0.0))
        body, node = self._owner[nodes[pair, local]], nodes[pair, local]
        keys, index = np.unique(pair * len(self._length) + body, return_inverse=True)
        pair_of, body_of = np.divmod(keys, len(self._length))
        rates = np.zeros((2, len(keys), 3))
        push = weights[pair, local, None] * n[pair]
        arms = (x[node] - x[self._blocks[0, body]]) / self._length[body, None]
        np.add.at(rates[0], index, push)
        np.add.at(rates[1], index, np.cross(arms, push))
        blocks = self._blocks[:, body_of]
        return pair_of, blocks, rates * self._free[blocks], self._length[body_of]

    def moved(self, x: np.ndarray, steps: np.ndarray, state) -> np.ndarray:
        """Return positions after `steps` (W N, 3) with translations and rotation vectors of bodies, which the state takes over."""
        step = x + steps
        step[self._blocks[1]] = steps[self._blocks[1]]
        self.carried.turn(state, step.ravel())
        result = self.carried.place(x.ravel(), step.ravel()).reshape(-1, 3)
        result[self._blocks[1]] = 0.0
        return result


def _separate(
    pairs,
    x: wp.array,
    free: np.ndarray,
    least: float,
    steps: np.ndarray,
    weight_sums: np.ndarray,
    bodies: _Bodies | None,
) -> float:
    """Add separating displacements of a pair list to `steps` and weights to `weight_sums`; return the smallest gap."""
    count = int(pairs.count.numpy()[0])
    if not count:
        return np.inf
    real = x.dtype._wp_scalar_type_
    kinds = x.dtype, wp.vec4i, wp.types.vector(4, real), real
    closest = [wp.zeros(count, dtype=kind, device=x.device) for kind in kinds]
    wp.launch(closest_kernel(pairs.kind, real), count, [pairs.pairs, pairs.sides, x], closest, device=x.device)
    distance, nodes, weights, thickness = (array.numpy() for array in closest)
    length = np.linalg.norm(distance, axis=1)
    gap = length - thickness
    near = np.flatnonzero(gap < least)
    if len(near):
        weights, nodes = weights[near], nodes[near]
        n = _directions(distance[near], length[near], x.numpy()[nodes], pairs.kind.endless)
        movable = free[nodes] * n[:, None]  # (pairs, nodes, 3), direction on free dofs
        mobility = (weights**2 * (movable * n[:, None]).sum(2)).sum(1)
        if bodies:
            pair, blocks, rates, length = bodies.rates(x.numpy().astype(float), nodes, weights, n)
            np.add.at(mobility, pair, (rates**2).sum((0, 2)))
        size = np.where(mobility > 0.0, (BEYOND * least - gap[near]) / np.where(mobility > 0.0, mobility, 1.0), 0.0)
        np.add.at(steps, nodes, (size[:, None] * weights)[..., None] * movable)
        np.add.at(weight_sums, nodes, np.abs(weights) * (mobility > 0.0)[:, None])
        if bodies:
            rates[1] /= length[:, None]
            np.add.at(steps, blocks, size[pair, None] * rates)
            np.add.at(weight_sums, blocks, np.ones(blocks.shape))
    return float(gap.min())


def _directions(distance: np.ndarray, length: np.ndarray, corners: np.ndarray, endless: bool) -> np.ndarray:
    """Return unit vectors (n, 3) of separation.

    Directions are along `distance`, across both sides if closest points coincide, or normals of half-spaces (`endless`).
    """
    if endless:
        distance = np.cross(corners[:, 2] - corners[:, 1], corners[:, 3] - corners[:, 1])
        return distance / np.linalg.norm(distance, axis=1)[:, None]
    sides = corners[:, 1] - corners[:, 0], corners[:, 3] - corners[:, 2]
    size = np.maximum(np.linalg.norm(sides[0], axis=1), np.linalg.norm(sides[1], axis=1))
    across = np.cross(*sides)
    flat = np.linalg.norm(across, axis=1) <= 1e-9 * size**2  # parallel: any direction across
    some = np.eye(3)[np.abs(sides[0]).argmin(1)]
    across = np.where(flat[:, None], np.cross(np.where(sides[0].any(1)[:, None], sides[0], sides[1]), some), across)
    meet = length <= 1e-9 * size
    distance = np.where(meet[:, None], across, distance)
    return distance / np.linalg.norm(distance, axis=1)[:, None]
