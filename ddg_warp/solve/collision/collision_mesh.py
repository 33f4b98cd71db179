"""Collision mesh of one world: edges of rods as capsules, triangles of shells, balls and half-spaces, and excluded pairs."""

import numpy as np

from ddg_warp.errors import SceneError
from ddg_warp.kernels.collision.friction.surface_rotation import MARKERS

BALLS, PLANES = 0, -1  # sizes of primitives that are balls and half-spaces, which else are numbers of nodes
FLAT = 1e-12  # area over squared longest edge below which a triangle is degenerate


class CollisionMesh:
    """Collision mesh: rods, shells, balls and half-spaces over the nodes of one world, numbered as added.

    Objects that are `still` (obstacles, fixed or moved from outside) form no pair with each other, nor with themselves.

    Args:
        points: positions (n, 3) at which no primitive may be without length or area [m].

    Attributes:
        names, radii: of all objects [m]; obstacle: numbers of the obstacles.
        ignored_pairs: pairs of objects without contact, the smaller number first.
        spinning: first node and markers of objects with rotating surfaces, by number.
        roots_ignored: pairs of classes of roots and objects without contact.
    """

    def __init__(self, points: np.ndarray):
        self.points = np.asarray(points, float)
        if self.points.ndim != 2 or self.points.shape[1] != 3 or not np.isfinite(self.points).all():
            raise SceneError("points of a contact search have to be finite, of shape (n, 3)")
        self.names: list[str] = []
        self.radii: list[float] = []
        self.obstacle: set[int] = set()
        self._parts: dict[int, list] = {1: [], 2: [], 3: [], BALLS: [], PLANES: []}
        self._angles: dict[int, np.ndarray] = {}
        self.ignored_pairs: set[tuple[int, int]] = set()
        self.spinning: dict[int, np.ndarray] = {}
        self._rotations: dict[int, int] = {}
        self.roots_ignored: set[tuple[int, int]] = set()
        self._roots: dict[int, tuple[int, float]] = {}

    def rod(
        self,
        nodes,
        radius: float,
        *,
        closed: bool = False,
        exclusion_length: float | None = None,
        name: str | None = None,
        still: bool = False,
        angles=None,
    ) -> int:
        """Add a rod along nodes (m,), a row of capsules, and return the number of the object.

        Args:
            radius: of the capsules [m].
            closed: True if an edge connects the last node with the first.
            exclusion_length: collision exclusion distance [m]: edges with a smaller arc length in between form no pair, nor do
                neighbours. By default pi radius, the arc between opposite sides of the tightest possible bend.
            still: True for an obstacle.
            angles: blocks with the twist angles of edges as first component; none by default.

        Raises:
            SceneError: names the rod, the edge or node, and the remedy.
        """
        name = name or f"rod {len(self.names)}"
        nodes = self._checked(nodes, 1, name)
        if len(nodes) < 2 + closed:
            raise SceneError(f"{name} has {len(nodes)} nodes; it needs at least {2 + closed}")
        self._positive(radius, "radius", name)
        exclusion_length = np.pi * radius if exclusion_length is None else exclusion_length
        if not 0.0 <= exclusion_length < np.inf:
            raise SceneError(f"{name}: exclusion_length = {exclusion_length!r}; it is an arc length, zero or more [m]")
        edges = np.column_stack([nodes, np.roll(nodes, -1)])[: None if closed else -1]
        lengths = np.linalg.norm(self.points[edges[:, 1]] - self.points[edges[:, 0]], axis=1)
        self._refuse(lengths <= 0.0, "edge", "has zero length", name)
        ends = np.concatenate([[0.0], np.cumsum(lengths)])
        loop = np.full(len(edges), ends[-1] if closed else 0.0)
        span = np.column_stack([ends[:-1], ends[1:], loop, np.full(len(edges), float(exclusion_length))])
        if angles is not None:
            angles = self._angles[len(self.names)] = self._checked(angles, 1, name)
            if len(angles) != len(edges):
                raise SceneError(f"{name} has {len(angles)} angles; it has {len(edges)} edges")
        return self._add(name, radius, {1: nodes[:, None], 2: edges}, span, still)

    def shell(self, triangles, thickness: float, *, name: str | None = None, still: bool = False) -> int:
        """Add a shell of triangles (m, 3) with a thickness [m], half on either side, and return the number of the object.

        An obstacle may have zero thickness, since its partners have a radius. Primitives with a common node form no pair.

        Raises:
            SceneError: names the shell, the triangle, and the remedy.
        """
        name = name or f"shell {len(self.names)}"
        triangles = self._checked(triangles, 2, name)
        if thickness != 0.0 or not still:
            self._positive(thickness, "thickness", name)
        if triangles.shape[1:] != (3,) or not len(triangles):
            raise SceneError(f"{name} has triangles of shape {triangles.shape}; it is (m, 3), with at least one")
        a, b, c = np.moveaxis(self.points[triangles], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        longest = np.max([np.square(b - a).sum(1), np.square(c - b).sum(1), np.square(a - c).sum(1)], axis=0)
        self._refuse(area <= FLAT * longest, "triangle", "has no area", name)
        sides = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges = np.unique(sides, axis=0)
        span = np.broadcast_to([0.0, 0.0, 0.0, -1.0], (len(edges), 4))
        parts = {1: np.unique(triangles)[:, None], 2: edges, 3: triangles}
        return self._add(name, 0.5 * thickness, parts, span, still)

    def ball(self, node: int, radius: float, *, name: str | None = None, still: bool = False) -> int:
        """Add a ball around a node and return the number of the object.

        Raises:
            SceneError: names the ball and the remedy.
        """
        name = name or f"ball {len(self.names)}"
        nodes = self._checked([node], 1, name)[:, None]
        self._positive(radius, "radius", name)
        return self._add(name, radius, {1: nodes, BALLS: nodes}, np.zeros((0, 4)), still)

    def plane(self, nodes, *, name: str | None = None) -> int:
        """Add the half-space behind three nodes, counter-clockwise as seen from outside, and return the number of the object.

        A half-space is an obstacle. The second and the third node are 1 m from the first under any motion.

        Raises:
            SceneError: names the plane and the remedy.
        """
        name = name or f"plane {len(self.names)}"
        nodes = self._checked(nodes, 1, name)
        arms = (
            np.linalg.norm(self.points[nodes[1:]] - self.points[nodes[:1]], axis=1) if len(nodes) == 3 else np.zeros(2)
        )
        if np.abs(arms - 1.0).max() > 1e-6:
            raise SceneError(f"{name}: it takes three nodes, the second and the third 1 m from the first")
        return self._add(name, 0.0, {PLANES: nodes[None]}, np.zeros((0, 4)), still=True)

    def spin(self, number: int, nodes) -> None:
        """Let the surface of an obstacle rotate with nodes: a first one and markers (3,) about it; see
        `kernels.collision.friction.surface_rotation`.

        Raises:
            SceneError: it is no obstacle, or markers are not at right angles about the first node and equally far from it.
        """
        name, nodes = self.names[number], self._checked(nodes, 1, self.names[number])
        if number not in self.obstacle or len(nodes) != 1 + MARKERS:
            raise SceneError(f"{name} spins: only obstacles spin, given by {1 + MARKERS} nodes, not {len(nodes)}")
        arms = self.points[nodes[1:]] - self.points[nodes[0]]
        square = arms @ arms.T
        if not np.allclose(square, square[0, 0] * np.eye(MARKERS), atol=1e-9 * square[0, 0]) or square[0, 0] <= 0.0:
            raise SceneError(
                f"{name} spins: markers are at right angles about node {nodes[0]}, as far from it as each other"
            )
        self.spinning[number] = nodes

    def rotate(self, number: int, block: int) -> None:
        """Let friction rotate an object by a dof block, the rotation vector of a rigid body."""
        self._rotations[number] = block

    def ignore(self, first: int, second: int) -> None:
        """Exclude contact between two objects, or of an object with itself.

        Raises:
            SceneError: there is no such object.
        """
        for number in (first, second):
            if not 0 <= number < len(self.names):
                raise SceneError(
                    f"there is no object {number}; objects are 0 to {len(self.names) - 1}, in the order added"
                )
        self.ignored_pairs.add((min(first, second), max(first, second)))

    def root(self, number: int, kind: int, length: float) -> None:
        """Give edges and nodes of a rod within an arc length [m] from the first node a class of roots; see `ignore_root`."""
        self._roots[number] = kind, length

    def ignore_root(self, kind: int, number: int) -> None:
        """Exclude contact between the roots of a class and an object."""
        self.roots_ignored.add((kind, number))

    def roots(self, size: int) -> np.ndarray:
        """Return the class of the root that each primitive of a size belongs to (n,), -1 for none; empty without classes."""
        if not self._roots:
            return np.zeros(0, int)
        nodes, _, owner, span = self.primitives(size)
        kinds, lengths = np.full(len(self.names), -1), np.zeros(len(self.names))
        for number, (kind, length) in self._roots.items():
            kinds[number], lengths[number] = kind, length
        if size == 2:
            starts = span[:, 0]
        elif size == 1:
            starts = self._arc_lengths(owner * len(self.points) + nodes[:, 0])
        else:
            return np.full(len(owner), -1)
        return np.where(starts < lengths[owner], kinds[owner], -1)

    def _arc_lengths(self, keys: np.ndarray) -> np.ndarray:
        """Return the arc lengths [m] of nodes of edges, by keys: object times all nodes + node; infinite for nodes of no edge."""
        ends, _, owners, span = self.primitives(2)
        # second ends first: of a node of two edges the start of the second edge counts
        every = (owners * len(self.points) + ends.T)[::-1].ravel()
        order = np.argsort(every, kind="stable")
        index = np.searchsorted(every[order], keys, side="right") - 1
        match = (index >= 0) & (every[order][index] == keys)
        return np.where(match, span[:, 1::-1].T.ravel()[order][index], np.inf)

    @property
    def body_rotations(self) -> np.ndarray:
        """Rotation blocks of objects that are surfaces of rigid bodies, -1 for others (objects,)."""
        return np.array([self._rotations.get(number, -1) for number in range(len(self.names))])

    @property
    def ignored(self) -> np.ndarray:
        """Keys of pairs of objects (smaller number times all objects + larger), and of classes of roots and objects, sorted."""
        count = len(self.names)
        pairs = [a * count + b for a, b in self.ignored_pairs]
        return np.array(sorted(pairs + [(count + kind) * count + b for kind, b in self.roots_ignored]), np.int64)

    @property
    def sizes(self) -> list[int]:
        """Sizes of the primitives that pairs need: edges, points and triangles if there are triangles, `BALLS`, `PLANES`, if any."""
        primitives = self._parts
        return [
            *[1] * bool(primitives[3] or primitives[PLANES]),
            *[2] * bool(primitives[2]),
            *[3] * bool(primitives[3]),
            *[BALLS] * bool(primitives[BALLS]),
            *[PLANES] * bool(primitives[PLANES]),
        ]

    @property
    def balls_meet(self) -> bool:
        """True if two balls may form a pair, of which one is no obstacle."""
        numbers = {number for *_, number, _ in self._parts[BALLS]}
        return len(numbers) > 1 and not numbers <= self.obstacle

    def primitives(self, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return nodes, radius, object (n,) and span (n, 4) of the primitives of a size: number of nodes, `BALLS` or `PLANES`."""
        parts = self._parts[size] or [(np.zeros((0, max(size, 1)), int), 0.0, 0, np.zeros((0, 4)))]
        number = np.repeat([part[2] for part in parts], [len(part[0]) for part in parts])
        radius = np.repeat([part[1] for part in parts], [len(part[0]) for part in parts])
        return np.concatenate([part[0] for part in parts]), radius, number, np.concatenate([part[3] for part in parts])

    def beside(self, size: int) -> np.ndarray:
        """Return both nodes of edges; for points on rods the previous and next node, for others the node itself (n, 2)."""
        nodes, _, owner, _ = self.primitives(size)
        if size == 2:
            return nodes
        ends, _, owners, _ = self.primitives(2)
        node_keys, result = owner * len(self.points) + nodes[:, 0], np.repeat(nodes, 2, axis=1)
        for side in range(2):
            keys = owners * len(self.points) + ends[:, 1 - side]
            order = np.argsort(keys)
            if not len(keys):
                break
            index = order[np.minimum(np.searchsorted(keys[order], node_keys), len(keys) - 1)]
            result[:, side] = np.where(keys[index] == node_keys, ends[index, side], nodes[:, 0])
        return result

    def angles(self, size: int) -> np.ndarray:
        """Return the angle blocks (n, 2) of edges, or of the edges before and after points on rods; -1 for none."""
        nodes, _, owner, _ = self.primitives(size)
        result = np.full((len(nodes), 2), -1)
        for number, angles in self._angles.items():
            rows = np.flatnonzero(owner == number)
            if size == 2:
                result[rows, 0] = angles
            elif size == 1:
                closed = len(rows) == len(angles)
                result[rows if closed else rows[1:], 0] = np.roll(angles, 1) if closed else angles
                result[rows if closed else rows[:-1], 1] = angles
        return result

    def describe(self, size: int, index: int) -> str:
        """Return the name of a primitive of a world for messages."""
        for nodes, _, number, _ in self._parts[size]:
            if index < len(nodes):
                if size <= 0:
                    return f"{self.names[number]} (node {nodes[index, 0]})"
                kind = ("point", "edge", "triangle")[size - 1]
                return f"{kind} {index} of {self.names[number]} (nodes {', '.join(map(str, nodes[index]))})"
            index -= len(nodes)
        raise IndexError(index)

    def _add(self, name: str, radius: float, parts: dict, span: np.ndarray, still: bool) -> int:
        number = len(self.names)
        if still:
            self.obstacle.add(number)
        self.names.append(name)
        self.radii.append(radius)
        for size, nodes in parts.items():
            self._parts[size].append((nodes, radius, number, span if size == 2 else np.zeros((0, 4))))
        return number

    def _checked(self, nodes, axes: int, name: str) -> np.ndarray:
        nodes = np.asarray(nodes)
        if nodes.ndim != axes or nodes.dtype.kind not in "iu":
            raise SceneError(
                f"{name}: nodes are whole numbers in {axes} dimension(s), not {nodes.dtype} of shape {nodes.shape}"
            )
        wrong = (nodes < 0) | (nodes >= len(self.points))
        if wrong.any():
            raise SceneError(f"{name} has node {nodes[wrong][0]}; nodes are 0 to {len(self.points) - 1}")
        return nodes

    def _positive(self, value: float, label: str, name: str) -> None:
        if not 0.0 < value < np.inf:
            raise SceneError(f"{name}: {label} = {value!r}; it is positive and finite [m]")

    def _refuse(self, wrong: np.ndarray, label: str, fault: str, name: str) -> None:
        if wrong.any():
            raise SceneError(f"{label} {np.flatnonzero(wrong)[0]} of {name} {fault}; merge its nodes or leave it out")
