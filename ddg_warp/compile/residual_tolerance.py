"""Residual tolerance: bound the error of internal forces relative to the load of the body.

Every rod, shell, meridian and rigid body is a *body* with the load scale W, the sum of its external forces alone. Clusters are single
nodes, eight nodes, eight such clusters, and so on: along a rod, or along a space-filling curve of a shell.

- Rods and meridians: |sum of r| <= rtol W over every cluster bounds the error of the axial force by rtol W.
- Shells: internal forces are per length. Over a cluster with the fraction a of the area, |sum of r| <= rtol W sqrt(a). Large clusters
  are limited to a tenth of W, since their residuals move the whole shell and accumulate over steps.

Both bounds are independent of refinement and of other bodies. Smooth residuals, which displace most, are caught by their sum over the
body; rough ones, which stiff edges carry, by single nodes. Moments are divided by the length L of the body (shells: root of the area).
A full Newton step along an exact direction leaves a second-order remainder, so subset sums are not tested. This holds for uncoupled
rods, and for joined rods where elimination is exact.

The load scale of a body is at least the mean over connected bodies, since it may carry their loads.
"""

from dataclasses import dataclass

import numpy as np

FAN = 8  # clusters that form a larger cluster
SMOOTH = 0.1  # limit of residual sums over large clusters of a shell, over rtol W


@dataclass
class Level:
    """Clusters of one size.

    Attributes:
        starts: offsets of the children of each cluster in `items`, indices of the level below (at first, of dof blocks).
        weight: limit of the residual sum [N, N m] over the load scale of the body [N]; body: index of the body.
    """

    starts: np.ndarray
    items: np.ndarray
    weight: np.ndarray
    body: np.ndarray


class ToleranceBodies:
    """Bodies of the coupled system, by which residuals are normalised.

    Attributes:
        count: number of bodies: rods, shells, meridians, rigid bodies.
        owner: body of each dof block (N,), the first where several are joined; arm: divisor of moments, 1 at nodes [m].
        levels: clusters, from small to large.
        shortest: length of the shortest rod, or root of the area of the smallest shell [m].
    """

    def __init__(self, host):
        rigid, structures = host.rigid_bodies, len(host.rods) + len(host.shells) + len(host.meridians)
        self.host, self.count = host, structures + (len(rigid) if rigid else 0)
        blocks, body, fraction, arm, family = [], [], [], [], []

        def add(index, where, weights, length=1.0, sums=True):
            blocks.append(where)
            body.append(np.full(len(where), index))
            fraction.append(np.broadcast_to(weights, len(where)))
            arm.append(np.full(len(where), length))
            family.append(np.full(len(where), len(family) if sums else -1))

        lines = [(rod.all_nodes, rod.all_edges, float(rod.piece.length[rod.row])) for rod in host.rods]
        for index, (nodes, edges, length) in enumerate(lines):
            add(index, nodes, 1.0)
            add(index, edges, 1.0, length)
        for index, shell in enumerate(host.shells, len(lines)):
            areas = _areas(shell.surface)
            order = _along_curve(shell.surface.points)
            corners = np.bincount(shell.surface.triangles.ravel(), np.repeat(areas / 3.0, 3), len(shell.nodes))
            add(index, shell.nodes[order], corners[order] / areas.sum())
            turning = shell.edges >= 0  # residual signs depend on the edge orientation: sums are meaningless
            sides = np.bincount(shell.surface.triangle_edges.ravel(), np.repeat(areas / 3.0, 3), len(shell.edges))
            add(index, shell.edges[turning], sides[turning] / areas.sum(), float(np.sqrt(areas.sum())), sums=False)
        for index, meridian in enumerate(host.meridians, len(lines) + len(host.shells)):
            add(index, meridian.nodes, 1.0)
        lengths_of_bodies = rigid.lengths(host.mass) if rigid else np.zeros(0)
        for index, length in enumerate(lengths_of_bodies):
            add(structures + index, rigid.origins[[index]], 1.0)
            add(structures + index, rigid.spins[[index]], 1.0, length)
        blocks, body, fraction, arm, family = (
            np.concatenate([np.zeros(0, type_), *values])
            for values, type_ in ((blocks, int), (body, int), (fraction, float), (arm, float), (family, int))
        )
        sizes = [length for *_, length in lines] + [np.sqrt(_areas(shell.surface).sum()) for shell in host.shells]
        sizes += [np.ptp(meridian.points, axis=0).max() for meridian in host.meridians]
        self.shortest = float(min(sizes or lengths_of_bodies))
        is_shell = (body >= len(lines)) & (body < len(lines) + len(host.shells))
        self._blocks, self._body = blocks, body
        self._line = np.concatenate([np.zeros(0, int), *(nodes for nodes, *_ in lines)])
        self._line_body = np.repeat(np.arange(len(lines)), [len(nodes) for nodes, *_ in lines])
        self._weight = _weight(is_shell, fraction) * arm
        self.owner, self.arm = np.zeros(host.blocks, int), np.ones(host.blocks)
        self.owner[blocks[::-1]], self.arm[blocks[::-1]] = body[::-1], arm[::-1]
        if rigid:
            self.owner[rigid.centers] = structures + np.arange(len(rigid))
        self._spins(lines)
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        linked, links = blocks, body
        if rigid:
            linked, links = np.append(blocks, rigid.carried), np.append(body, structures + rigid.owner)
        graph = coo_array((np.ones(len(linked)), (linked, host.blocks + links)), shape=(host.blocks + self.count,) * 2)
        self._component = connected_components(graph, directed=False)[1][host.blocks :]
        inside = family >= 0
        self.levels = _levels(
            blocks[inside], family[inside], body[inside], fraction[inside], arm[inside], is_shell[inside]
        )

    @property
    def _other_spins(self) -> np.ndarray:
        """Rotation blocks of rigid bodies and of the world."""
        rigid = self.host.rigid_bodies
        return np.append(rigid.spins, rigid.world) if rigid else np.zeros(0, int)

    def _spins(self, lines: list) -> None:
        """Assign the rotations of rigid joints to the rods of the joint."""
        first = self.host.nodes + self.host.angles
        for part in self.host.sets if self.host.spins else ():
            spin = part.slots[(part.slots >= first).argmax(0), np.arange(len(part))]
            joints = (spin >= first) & ~np.isin(spin, self._other_spins)
            bodies = self.owner[part.slots[0][joints]]
            lengths = np.array([length for *_, length in lines])[bodies]
            self._blocks = np.append(self._blocks, spin[joints])
            self._body, self._weight = np.append(self._body, bodies), np.append(self._weight, lengths)
            self.owner[spin[joints]], self.arm[spin[joints]] = bodies, lengths

    def loads(self, force: np.ndarray, least: np.ndarray | float = 0.0) -> np.ndarray:
        """Return the load scale of bodies (count,) [N]: W, at least the mean over connected bodies.

        Args:
            force: absolute external forces on dof blocks (N,) [N, N m].
            least: lower bound of W of each body [N].
        """
        body_loads = np.maximum(np.bincount(self.owner, force / self.arm, self.count), least)
        total = np.bincount(self._component, body_loads) / np.maximum(1, np.bincount(self._component))
        return np.maximum(body_loads, np.where(total > 0.0, total, body_loads.mean())[self._component])

    @property
    def components(self) -> np.ndarray:
        """Index of the connected component of every body (count,)."""
        return self._component

    def limit_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (dof blocks, bodies, weights); `limits` is the largest product of weight and load scale of a block."""
        return self._blocks, self._body, self._weight

    def support(self, force: np.ndarray) -> np.ndarray:
        """Return the largest support force of every body (count,) [N], from forces on fixed nodes (N, 3), zero elsewhere."""
        result = support_forces(force[self._line], self._line_body, self.count)
        sheets = np.isin(self.owner, np.unique(self._line_body), invert=True)
        np.maximum.at(result, self.owner[sheets], np.abs(force[sheets]).max(1))
        return result

    def limits(self, loads: np.ndarray) -> np.ndarray:
        """Return the residual limit at rtol = 1 of every dof block (N,) [N, N m], for load scales of bodies (count,)."""
        result = np.zeros(self.host.blocks)
        np.maximum.at(result, self._blocks, loads[self._body] * self._weight)
        result[self.host.of_obstacles] = 1.0  # of no body, and fixed
        if self.host.rigid_bodies:
            result[self.host.rigid_bodies.world] = 1.0
        return result


def outer_forces(host, gravity) -> np.ndarray:
    """Return absolute external forces on every dof block (N,) [N, N m], with loads in time at full amplitude."""
    dead = host.constant_loads()
    dead[: host.nodes] += host.mass[: host.nodes] * np.asarray(gravity, float)
    return np.abs(dead).sum(1) + changing_forces(host)


def changing_forces(host) -> np.ndarray:
    """Return absolute forces of loads in time (full amplitude), follower loads and magnetic fields (N,) [N, N m]."""
    force = np.zeros(host.blocks)
    for load in host.timed:
        np.add.at(force, load.places, np.abs(load.force).sum(-1))
    for load in host.followers:
        np.add.at(force, load.places, load.sizes(host.rest[load.places]))
    for part in host.sets:
        if part.term.measure.field:
            np.add.at(force, part.slots[0], _magnetic_forces(host, part))
    return force


def _magnetic_forces(host, part) -> np.ndarray:
    """Return equivalent magnetic forces on edges at rest (E,) [N]; a couple is divided by the rod length."""
    lengths = {rod.rod: rod.piece.length[rod.row] for rod in host.rods}
    length = np.array([lengths[rod] for rod in part.owner[0]])
    field, gradient = np.split(np.abs(part.data[-part.term.measure.field :]), [3])
    moment = part.parameters["measure"] * np.abs(part.parameters["magnetisation"])
    return moment * (field.sum(0) / length + gradient.sum(0))


def largest_excess(
    levels: list[Level], loads: np.ndarray, rtol: float, residual: np.ndarray, rounding_floor: np.ndarray
):
    """Return (True if all cluster sums of residuals (N, 3) are small, largest excess over limit and rounding).

    Args:
        loads: load scales of the bodies (count,) [N].
        rounding_floor: rounding floor of each dof block (N,), summed like independent random numbers.
    """
    small, excess, square = True, -np.inf, rounding_floor**2
    for level in levels:
        residual, square = (np.add.reduceat(v[level.items], level.starts[:-1], axis=0) for v in (residual, square))
        size, limit = np.abs(residual).max(1), rtol * loads[level.body] * level.weight
        small &= bool((size <= limit).all())
        excess = max(excess, float((size - np.maximum(limit, np.sqrt(square))).max()))
    return small, excess


def support_forces(force: np.ndarray, body: np.ndarray, count: int) -> np.ndarray:
    """Return the largest force that neighbouring fixed nodes carry together, per body (count,) [N].

    The two nodes of a clamp carry its moment as a force couple that grows as edges shrink; divided by the rod length it counts, too.

    Args:
        force: forces on the nodes of rods in order (n, d) [N], zero at free nodes.
        body: body of each node (n,).
    """
    fixed = np.flatnonzero(force.any(1))
    result = np.zeros(count)
    if fixed.size:
        first = (np.diff(fixed, prepend=-2) != 1) | (np.diff(body[fixed], prepend=-1) != 0)
        together = np.abs(np.add.reduceat(force[fixed], np.flatnonzero(first), axis=0)).max(1)
        np.maximum.at(result, body[fixed][first], together)
        np.maximum.at(result, body[fixed], np.abs(force[fixed]).max(1) / np.bincount(body)[body[fixed]])
    return result


def _weight(is_shell: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Return the limit of cluster residual sums over rtol W, for shells by the area fraction of the cluster."""
    return np.where(is_shell, np.minimum(np.sqrt(fraction), SMOOTH), 1.0)


def _areas(surface) -> np.ndarray:
    a, b, c = surface.points[surface.triangles].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _along_curve(points: np.ndarray) -> np.ndarray:
    """Return the order of points along a Morton curve, which keeps neighbours close."""
    cells = (1023 * (points - points.min(0)) / max(1e-300, np.ptp(points, axis=0).max())).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(10):
        for d in range(3):
            key |= ((cells[:, d] >> bit) & 1) << (3 * bit + d)
    return np.argsort(key, kind="stable")


def _levels(blocks, family, body, fraction, arm, is_shell) -> list[Level]:
    """Return clusters of families of dof blocks, until each family is one cluster."""
    levels, items = [], blocks
    while len(family) and (not levels or (np.bincount(family) > 1).any()):
        first = np.flatnonzero(np.diff(family, prepend=-1))
        position = np.arange(len(family)) - np.repeat(first, np.diff(np.append(first, len(family))))
        starts = np.flatnonzero(position % FAN == 0)
        fraction = np.add.reduceat(fraction, starts)
        family, body, arm, is_shell = family[starts], body[starts], arm[starts], is_shell[starts]
        weight = _weight(is_shell, fraction) * arm
        levels.append(Level(np.append(starts, len(items)), items, weight, body))
        items = np.arange(len(starts))
    return levels
