"""Contact of the coupled system: collision primitives, search for candidates, and contact energy."""

import numpy as np
import warp as wp

from ddg_warp.compile.collision_bodies import ROD
from ddg_warp.kernels.collision.contact.query import query_kernel
from ddg_warp.scene.obstacles import BALL, CAPSULE, MESH, PLANE
from ddg_warp.solve.collision.broad_phase import BroadPhase
from ddg_warp.solve.collision.collision_mesh import CollisionMesh
from ddg_warp.solve.collision.contact_potential import ContactPotential

MARGIN = 1.0  # margin of searches over a typical radius
SLIDING = 0.999  # friction of sliding contacts over mu N


class ContactModel:
    """Contact of a `CoupledModel`, searched first at blocks x (W N,), with the contact parameters on the device.

    Args:
        silent: nodes without forces.
        margin: margin of searches, by default the margin of steps; exact: see `ContactPotential`.

    Attributes:
        shapes: collision primitives. search: candidates. terms: energy of active pairs.
        min_separation_fraction: fraction of the thickness that motion preserves.
    """

    def __init__(
        self,
        coupled,
        linear,
        x: wp.array,
        silent: np.ndarray | None = None,
        margin: float | None = None,
        exact: bool = False,
    ):
        self.coupled, contact_parameters = coupled, coupled.host.contact_parameters
        self.law, self.min_separation_fraction = contact_parameters.law, contact_parameters.min_separation_fraction
        self.shapes = shapes_of(coupled.host)
        margin = margin or MARGIN * max(contact_parameters.size, contact_parameters.search_distance)
        radius = coupled.contact_parameters["radius"]
        self.search = BroadPhase(
            self.shapes,
            x,
            coupled.worlds,
            search_distance=contact_parameters.search_distance,
            margin=margin,
            radius=radius,
        )
        self.terms = ContactPotential(
            self.search,
            contact_parameters.density,
            stiffness=contact_parameters.stiffness,
            range=contact_parameters.range,
            groups=contact_parameters.group,
            friction=contact_parameters.friction,
            inertia=contact_parameters.inertia,
            ways=contact_parameters.ways,
            friction_law=self.law.friction_law,
            velocity=self.law.velocity,
            linear=linear,
            silent=silent,
            shared=coupled.contact_parameters,
            exact=exact,
        )

    def evaluate(self, x: wp.array, rate: wp.array | None = None) -> None:
        """Compute energies and forces at blocks x, with room for all pairs. Not in a capture.

        Args:
            x: blocks (W N,).
            rate: rate of the inertial stiffness (worlds,) [1/s], the one of the state; by default none.

        Raises:
            SolverError: names a node whose position is not finite.
        """
        self.find(x)
        self.terms.fit()
        self.terms.brace(rate)
        self.terms.evaluate(x)

    def evaluate_friction(self, x: wp.array, v: wp.array) -> None:
        """Compute friction at blocks x for velocities v, after `evaluate`. Not in a capture."""
        start = wp.array(x.numpy() - v.numpy(), dtype=x.dtype, device=x.device)  # slips of one second, with rate one
        self.terms.lag(x)
        self.terms.evaluate(x, wp.full(self.coupled.worlds, 1.0, dtype=self.coupled.real, device=x.device), start)

    def friction(self, x: wp.array, v: wp.array, rate: wp.array | None = None) -> np.ndarray:
        """Return friction on blocks (W N, 3) [N] at x with velocities v, including markers of spinning objects.

        Not in a capture; raises as `evaluate`.
        """
        self.evaluate(x, rate)
        pushed = self.terms.forces.numpy().astype(float)
        self.evaluate_friction(x, v)
        return self.terms.forces.numpy() - pushed + self.terms.spins.forces(x, self.terms.frictions)

    def slides(self) -> bool:
        """Return True if friction reaches the bound mu N at a pair, after `friction`."""
        for part in self.terms.frictions:
            used, forces = part.forces()
            if (np.linalg.norm(forces, axis=1) > SLIDING * part.lagged.bound.numpy()[used]).any():
                return True
        return False

    def find(self, x: wp.array) -> None:
        """Search all candidates at blocks x; `evaluate` must follow before energies. Not in a capture; raises as `evaluate`."""
        self.search.rebuild(x)
        self.search.search(x)
        self.search.fit(x)

    def pairs(self, x: wp.array, v: wp.array | None = None) -> dict[str, np.ndarray]:
        """Return candidates at blocks x, after `evaluate`, with friction for velocities v if given.

        Returns:
            world: (n,). sizes: node counts of both primitives (n, 2), see `CollisionMesh.primitives`. `primitives`: their indices in a
                world (n, 2).
            gap: (n,) [m]. point: midpoint of the closest points (n, 3) [m]. force, friction: on the first primitive (n, 3) [N].
        """
        friction_sets = [None] * len(self.terms.lists)
        if v is not None and self.terms.frictions:
            self.evaluate_friction(x, v)
            friction_sets = self.terms.frictions
        lists = [self._pairs(*each, x) for each in zip(self.search.lists, self.terms.lists, friction_sets, strict=True)]
        return {name: np.concatenate([values[name] for values in lists]) for name in lists[0]}

    def _pairs(self, pairs, terms, friction_sets, x: wp.array) -> dict[str, np.ndarray]:
        count = int(pairs.count.numpy()[0])
        gap = wp.zeros(count, dtype=self.coupled.real, device=x.device)
        point = wp.zeros(count, dtype=x.dtype, device=x.device)
        if count:
            kernel = query_kernel(pairs.kind, self.coupled.real)
            wp.launch(kernel, count, [pairs.pairs, pairs.sides, x], [gap, point], device=x.device)
        i, j = pairs.pairs.numpy()[:count].reshape(-1, 2).T
        force, friction = (_of_first(part, pairs) for part in (terms, friction_sets))
        return {
            "world": i // pairs.first.count,
            "sizes": np.broadcast_to([pairs.first.size, pairs.second.size], (count, 2)),
            "primitives": np.column_stack([i % pairs.first.count, j % pairs.second.count]),
            "gap": gap.numpy(),
            "point": point.numpy().reshape(-1, 3),
            "force": force,
            "friction": friction,
        }

    def closest(self, x: wp.array) -> tuple[float, str]:
        """Return the smallest gap of all candidates [m] and the name of the pair; infinite without candidates."""
        gap, pair, _ = self.closest_nodes(x)
        return gap, pair

    def closest_nodes(self, x: wp.array) -> tuple[float, str, tuple]:
        """Return the smallest gap of all candidates [m], its pair, and the nodes of both; see `closest`."""
        self.evaluate(x)
        candidates = self.pairs(x)
        if not len(candidates["gap"]):
            return np.inf, "", ()
        k = int(np.argmin(np.where(np.isfinite(candidates["gap"]), candidates["gap"], np.inf)))
        primitives = [
            tuple(map(int, numbers))
            for numbers in zip(candidates["sizes"][k], candidates["primitives"][k], strict=True)
        ]
        first, second = (self.shapes.describe(*primitive) for primitive in primitives)
        world = f" in world {candidates['world'][k]}" if self.coupled.worlds > 1 else ""
        nodes = tuple(self.shapes.primitives(size)[0][index] for size, index in primitives)
        return float(candidates["gap"][k]), f"{first} and {second}{world}", nodes


def _of_first(part, pairs) -> np.ndarray:
    """Return forces of `CollisionSet` on the first primitives of candidates (count, 3) [N], zero if `part` is None."""
    count = int(pairs.count.numpy()[0])
    forces, active = np.zeros((count, 3)), 0 if part is None else int(part.count.numpy()[0])
    if active:
        used, active_forces = part.forces()
        all_keys, active_keys = (
            elements.pairs.numpy()[:number].astype(np.int64) @ [pairs.second.all, 1]
            for elements, number in ((pairs, count), (part, active))
        )  # both sorted
        forces[np.searchsorted(all_keys, active_keys[used])] = active_forces
    return forces


def shapes_of(host) -> CollisionMesh:
    """Return the collision primitives of the coupled system."""
    contact_parameters, shapes = host.contact_parameters, CollisionMesh(host.rest)
    for body in contact_parameters.bodies:
        options = {"name": body.label, "still": body.still}
        if body.kind == PLANE:
            number = shapes.plane(body.nodes, name=body.label)
        elif body.kind == MESH:
            number = shapes.shell(body.cells, 2.0 * body.radius, **options)
        elif body.kind == BALL:
            number = shapes.ball(int(body.nodes[0]), body.radius, **options)
        else:
            exclusion = 0.0 if body.kind == CAPSULE else contact_parameters.law.exclusion_length
            angles = body.angles if body.angles.size else None
            number = shapes.rod(
                body.nodes, body.radius, closed=body.closed, exclusion_length=exclusion, angles=angles, **options
            )
        if body.rigid >= 0:
            shapes.rotate(number, int(host.rigid_bodies.spins[body.rigid]))
        if body.markers.size:
            shapes.spin(number, np.append(body.nodes[0], body.markers))
    for first, second in _attached(host):
        shapes.ignore(first, second)
    for g, h in contact_parameters.ignored:
        for first in np.flatnonzero(contact_parameters.group == g):
            for second in np.flatnonzero(contact_parameters.group == h):
                shapes.ignore(int(first), int(second))
    for kind, (g, (length, partners)) in enumerate(sorted(contact_parameters.roots.items())):
        for number in np.flatnonzero(contact_parameters.group == g):
            if contact_parameters.bodies[number].kind == ROD:
                shapes.root(int(number), kind, length)
        for number in np.flatnonzero(np.isin(contact_parameters.group, partners)):
            shapes.ignore_root(kind, int(number))
    return shapes


def _attached(host) -> list[tuple[int, int]]:
    """Return the pairs of collision bodies of one rigid body, of bodies that a joint connects, and of bodies with carried objects."""
    rigid = host.rigid_bodies
    if rigid is None:
        return []
    owner = np.full(host.blocks, -1)
    owner[rigid.carried] = rigid.owner
    linked = [{body} for body in range(len(rigid))]  # of each rigid body: bodies without contact with it
    for blocks in rigid.anchors:
        first, second = owner[blocks].tolist()
        for body, partner in ((first, second), (second, first)):
            if body >= 0:
                linked[body].add(partner)
    members = [[] for _ in range(len(rigid))]  # collision bodies of each rigid body, or with a node that it carries
    for number, body in enumerate(host.contact_parameters.bodies):
        for index in set(owner[body.nodes].tolist()) - {-1}:
            members[index].append(number)
    return [
        (number, member)
        for number, body in enumerate(host.contact_parameters.bodies)
        if body.rigid >= 0
        for index in linked[body.rigid] - {-1}
        for member in members[index]
    ]
