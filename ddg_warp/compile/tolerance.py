"""How large a residual may be: an error of the inner forces, compared with the loads of what a dof belongs to.

Every rod, shell and meridian is a *body* with the sum W of its own outer forces, as if nothing else were there. A residual is what
inner forces fail to carry. In a rod or meridian, |sum of r| <= rtol W over every part, single nodes included, bounds the error of the
axial force by rtol W. In a shell inner forces are per length: over a part with share a of its area, |sum of r| <= rtol W sqrt(a), but
large parts, whose residuals move the whole and add up from step to step, are held to a tenth of W. Both are independent of refinement
and of what else is in the net: a smooth residual, which displaces most, is caught by its sum over the whole, a rough one, which stiff
edges carry, node by node. Moments are compared over the length L of the body (of a shell, the root of its area). Parts are the nodes,
eight of them, eight of these, and so on, along a rod, or along a curve that fills a shell. A whole Newton step along an exact direction
leaves a remainder of second order, whose sums need no look: of rods on their own, and of joined ones where elimination is exact.

A body with less load than the mean of those it is connected with is given that mean, since it may carry theirs.
"""

from dataclasses import dataclass

import numpy as np

FAN = 8  # parts that a larger part is made of
SMOOTH = 0.1  # what residuals of large parts of a shell may add up to, over rtol W


@dataclass
class Level:
    """Parts of one size.

    Attributes:
        starts: where the children of each part start among `items` of the level below (at first, of the blocks).
        weight: what its residuals may add up to [N, N m], over the load of its body [N]; body: which that is.
    """

    starts: np.ndarray
    items: np.ndarray
    weight: np.ndarray
    body: np.ndarray


class Bodies:
    """What the blocks of a net belong to.

    Attributes:
        count: number of bodies: rods, shells, meridians.
        owner: body of each block (N,), the first where they are joined; arm: what moments are divided by, 1 at nodes [m].
        levels: parts, from small to large.
        shortest: length of the shortest rod, or root of the area of the smallest shell [m].
    """

    def __init__(self, host):
        self.host, self.count = host, len(host.rods) + len(host.shells) + len(host.meridians)
        blocks, body, share, arm, family = [], [], [], [], []

        def add(index, where, part, length=1.0, sums=True):
            blocks.append(where)
            body.append(np.full(len(where), index))
            share.append(np.broadcast_to(part, len(where)))
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
            turning = shell.edges >= 0  # the sign of these residuals depends on the edge: sums of them mean nothing
            sides = np.bincount(shell.surface.triangle_edges.ravel(), np.repeat(areas / 3.0, 3), len(shell.edges))
            add(index, shell.edges[turning], sides[turning] / areas.sum(), float(np.sqrt(areas.sum())), sums=False)
        for index, meridian in enumerate(host.meridians, len(lines) + len(host.shells)):
            add(index, meridian.nodes, 1.0)
        blocks, body, share, arm, family = (
            np.concatenate([np.zeros(0, type_), *values])
            for values, type_ in ((blocks, int), (body, int), (share, float), (arm, float), (family, int))
        )
        sizes = [length for *_, length in lines] + [np.sqrt(_areas(shell.surface).sum()) for shell in host.shells]
        sizes += [np.ptp(meridian.points, axis=0).max() for meridian in host.meridians]
        self.shortest = float(min(sizes))
        is_shell = (body >= len(lines)) & (body < len(lines) + len(host.shells))
        self._blocks, self._body = blocks, body
        self._line = np.concatenate([np.zeros(0, int), *(nodes for nodes, *_ in lines)])
        self._line_body = np.repeat(np.arange(len(lines)), [len(nodes) for nodes, *_ in lines])
        self._weight = _weight(is_shell, share) * arm
        self.owner, self.arm = np.zeros(host.blocks, int), np.ones(host.blocks)
        self.owner[blocks[::-1]], self.arm[blocks[::-1]] = body[::-1], arm[::-1]
        self._spins(lines)
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        graph = coo_array((np.ones(len(blocks)), (blocks, host.blocks + body)), shape=(host.blocks + self.count,) * 2)
        self._component = connected_components(graph, directed=False)[1][host.blocks :]
        inside = family >= 0
        self.levels = _levels(
            blocks[inside], family[inside], body[inside], share[inside], arm[inside], is_shell[inside]
        )

    def _spins(self, lines: list) -> None:
        """Rotations of joints, which belong to the rods that meet there."""
        first = self.host.nodes + self.host.angles
        for part in self.host.sets if self.host.spins else ():
            spin = part.slots[(part.slots >= first).argmax(0), np.arange(len(part))]
            joints = spin >= first
            bodies = self.owner[part.slots[0][joints]]
            lengths = np.array([length for *_, length in lines])[bodies]
            self._blocks = np.append(self._blocks, spin[joints])
            self._body, self._weight = np.append(self._body, bodies), np.append(self._weight, lengths)
            self.owner[spin[joints]], self.arm[spin[joints]] = bodies, lengths

    def loads(self, force: np.ndarray, least: np.ndarray | float = 0.0) -> np.ndarray:
        """What residuals of bodies are compared with (count,) [N]: W, or the mean of those that are connected where that is more.

        Args:
            force: sizes of the outer forces on blocks (N,) [N, N m].
            least: of each body, what W is not below [N].
        """
        own = np.maximum(np.bincount(self.owner, force / self.arm, self.count), least)
        total = np.bincount(self._component, own) / np.maximum(1, np.bincount(self._component))
        return np.maximum(own, np.where(total > 0.0, total, own.mean())[self._component])

    @property
    def components(self) -> np.ndarray:
        """Number of what every body is connected with (count,)."""
        return self._component

    def limit_entries(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Blocks, bodies and weights of which `limits` takes the largest product of weight and load."""
        return self._blocks, self._body, self._weight

    def support(self, force: np.ndarray) -> np.ndarray:
        """The largest support force of every body (count,) [N], from the forces on held nodes (N, 3), zero elsewhere."""
        result = support_forces(force[self._line], self._line_body, self.count)
        sheets = np.isin(self.owner, np.unique(self._line_body), invert=True)
        np.maximum.at(result, self.owner[sheets], np.abs(force[sheets]).max(1))
        return result

    def limits(self, loads: np.ndarray) -> np.ndarray:
        """Residual at rtol = 1 of every block (N,) [N, N m], of bodies with such loads (count,)."""
        result = np.zeros(self.host.blocks)
        np.maximum.at(result, self._blocks, loads[self._body] * self._weight)
        result[self.host.of_obstacles] = 1.0  # of no body, and held
        return result


def outer_forces(host, gravity) -> np.ndarray:
    """Sizes of the outer forces on every block of a net (N,) [N, N m], those that change at their full amplitude."""
    dead = host.constant_loads()
    dead[: host.nodes] += host.mass[: host.nodes] * np.asarray(gravity, float)
    return np.abs(dead).sum(1) + changing_forces(host)


def changing_forces(host) -> np.ndarray:
    """Of these, the sizes of loads that change, at their full amplitude, or follow, and of a magnetic field."""
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
    """Sizes of what a field at rest does to edges (E,) [N]: a couple per length is like a force at the end of the rod."""
    lengths = {rod.rod: rod.piece.length[rod.row] for rod in host.rods}
    length = np.array([lengths[rod] for rod in part.owner[0]])
    field, gradient = np.split(np.abs(part.data[-part.term.measure.field :]), [3])
    moment = part.parameters["measure"] * np.abs(part.parameters["magnetisation"])
    return moment * (field.sum(0) / length + gradient.sum(0))


def largest_excess(levels: list[Level], loads: np.ndarray, rtol: float, residual: np.ndarray, floor: np.ndarray):
    """Whether the sums of residuals (N, 3) over all parts are small, and by how much the worst exceeds rounding.

    Args:
        loads: of the bodies (count,) [N].
        floor: what rounding leaves of the residual of each block (N,), which adds up like independent numbers.
    """
    small, excess, square = True, -np.inf, floor**2
    for level in levels:
        residual, square = (np.add.reduceat(v[level.items], level.starts[:-1], axis=0) for v in (residual, square))
        size, limit = np.abs(residual).max(1), rtol * loads[level.body] * level.weight
        small &= bool((size <= limit).all())
        excess = max(excess, float((size - np.maximum(limit, np.sqrt(square))).max()))
    return small, excess


def support_forces(force: np.ndarray, body: np.ndarray, count: int) -> np.ndarray:
    """The largest force that neighbouring held nodes carry together, of every body (count,) [N].

    The two nodes of a clamp carry its moment as a pair of forces that grows as edges shrink; over the length it is a force, too.

    Args:
        force: on the nodes along rods, one after the other (n, d) [N], zero at free nodes.
        body: of these nodes (n,).
    """
    held = np.flatnonzero(force.any(1))
    result = np.zeros(count)
    if held.size:
        first = (np.diff(held, prepend=-2) != 1) | (np.diff(body[held], prepend=-1) != 0)
        together = np.abs(np.add.reduceat(force[held], np.flatnonzero(first), axis=0)).max(1)
        np.maximum.at(result, body[held][first], together)
        np.maximum.at(result, body[held], np.abs(force[held]).max(1) / np.bincount(body)[body[held]])
    return result


def _weight(is_shell: np.ndarray, share: np.ndarray) -> np.ndarray:
    """What residuals of parts may add up to, over rtol W, of parts of a shell by their share of its area."""
    return np.where(is_shell, np.minimum(np.sqrt(share), SMOOTH), 1.0)


def _areas(surface) -> np.ndarray:
    a, b, c = surface.points[surface.triangles].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _along_curve(points: np.ndarray) -> np.ndarray:
    """Order of points along Morton's curve, on which neighbours in the order are neighbours in space."""
    cells = (1023 * (points - points.min(0)) / max(1e-300, np.ptp(points, axis=0).max())).astype(np.int64)
    key = np.zeros(len(points), np.int64)
    for bit in range(10):
        for d in range(3):
            key |= ((cells[:, d] >> bit) & 1) << (3 * bit + d)
    return np.argsort(key, kind="stable")


def _levels(blocks, family, body, share, arm, is_shell) -> list[Level]:
    """Parts of families of blocks, until each family is one."""
    levels, items = [], blocks
    while len(family) and (not levels or (np.bincount(family) > 1).any()):
        first = np.flatnonzero(np.diff(family, prepend=-1))
        place = np.arange(len(family)) - np.repeat(first, np.diff(np.append(first, len(family))))
        starts = np.flatnonzero(place % FAN == 0)
        share = np.add.reduceat(share, starts)
        family, body, arm, is_shell = family[starts], body[starts], arm[starts], is_shell[starts]
        weight = _weight(is_shell, share) * arm
        levels.append(Level(np.append(starts, len(items)), items, weight, body))
        items = np.arange(len(starts))
    return levels
