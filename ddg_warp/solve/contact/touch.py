"""Contact of a net: what may touch, the search for what is near, and its energy."""

import numpy as np
import warp as wp

from ddg_warp.kernels.contact.look import look_kernel
from ddg_warp.scene.obstacles import BALL, CAPSULE, MESH, PLANE
from ddg_warp.solve.contact.broad_phase import BroadPhase
from ddg_warp.solve.contact.pair_terms import PairTerms
from ddg_warp.solve.contact.shapes import Shapes

MARGIN = 1.0  # of a typical radius, by which searches go beyond the reach
SLIDING = 0.999  # of its bound, friction of what does not stick


class Touch:
    """Contact of a `DeviceNet` with blocks x (W N,), where it is searched for at first, by the numbers that the net has on the device.

    Args:
        silent: nodes that are told of no forces.
        margin: of searches, by default that of steps; exact: as of `PairTerms`.

    Attributes:
        shapes, search, terms: what may touch, candidates, and the energy of those that are near.
        keep: part of the thickness that motion never goes into.
    """

    def __init__(
        self,
        net,
        linear,
        x: wp.array,
        silent: np.ndarray | None = None,
        margin: float | None = None,
        exact: bool = False,
    ):
        self.net, given = net, net.host.touching
        self.law, self.keep = given.law, given.keep
        self.shapes = shapes_of(net.host)
        margin = margin or MARGIN * max(given.size, given.reach)
        radius = net.touching["radius"]
        self.search = BroadPhase(self.shapes, x, net.worlds, reach=given.reach, margin=margin, radius=radius)
        self.terms = PairTerms(
            self.search,
            given.density,
            stiffness=given.stiffness,
            range=given.range,
            groups=given.group,
            friction=given.friction,
            inertia=given.inertia,
            ways=given.ways,
            friction_law=self.law.friction_law,
            velocity=self.law.velocity,
            linear=linear,
            silent=silent,
            shared=net.touching,
            exact=exact,
        )

    def at(self, x: wp.array, rate: wp.array | None = None) -> None:
        """Energies and forces at blocks x, with room for all pairs. Not in a capture.

        Args:
            x: blocks (W N,).
            rate: by which inertia counts in the stiffness (worlds,) [1/s], that of the state; none by default.

        Raises:
            SolverError: names a node whose position is not finite.
        """
        self.find(x)
        self.terms.fit()
        self.terms.brace(rate)
        self.terms.evaluate(x)

    def rub(self, x: wp.array, v: wp.array) -> None:
        """After `at`, friction at blocks x as of surfaces that move by v. Not in a capture."""
        start = wp.array(x.numpy() - v.numpy(), dtype=x.dtype, device=x.device)  # slips of a second, whose rate is one
        self.terms.lag(x)
        self.terms.evaluate(x, wp.full(self.net.worlds, 1.0, dtype=self.net.real, device=x.device), start)

    def friction(self, x: wp.array, v: wp.array, rate: wp.array | None = None) -> np.ndarray:
        """Forces of friction on blocks (W N, 3) [N] that are at x and move by v, on markers those that turn what spins.

        Not in a capture; raises as `at`.
        """
        self.at(x, rate)
        pushed = self.terms.forces.numpy().astype(float)
        self.rub(x, v)
        return self.terms.forces.numpy() - pushed + self.terms.spins.forces(x, self.terms.frictions)

    def slides(self) -> bool:
        """After `friction`, whether it is all there somewhere, as it is of what does not stick."""
        for part in self.terms.frictions:
            used, forces = part.forces()
            if (np.linalg.norm(forces, axis=1) > SLIDING * part.lagged.bound.numpy()[used]).any():
                return True
        return False

    def find(self, x: wp.array) -> None:
        """Candidates at blocks x, all of them; `at` has to follow before energies are asked for. Not in a capture; raises as `at`."""
        self.search.rebuild(x)
        self.search.search(x)
        self.search.fit(x)

    def pairs(self, x: wp.array, v: wp.array | None = None) -> dict[str, np.ndarray]:
        """Candidates at blocks x, after `at`; with friction as of surfaces that move by v, if given.

        Returns:
            world: (n,); sizes, things: numbers of nodes of both (see `Shapes.things`), and what number they have in a world (n, 2).
            gap: (n,) [m]; point: between the closest points (n, 3) [m]; force, friction: on the first of both (n, 3) [N].
        """
        rubs = [None] * len(self.terms.lists)
        if v is not None and self.terms.frictions:
            self.rub(x, v)
            rubs = self.terms.frictions
        found = [self._pairs(*each, x) for each in zip(self.search.lists, self.terms.lists, rubs, strict=True)]
        return {name: np.concatenate([own[name] for own in found]) for name in found[0]}

    def _pairs(self, pairs, terms, rubs, x: wp.array) -> dict[str, np.ndarray]:
        count = int(pairs.count.numpy()[0])
        gap = wp.zeros(count, dtype=self.net.real, device=x.device)
        point = wp.zeros(count, dtype=x.dtype, device=x.device)
        if count:
            kernel = look_kernel(pairs.kind, self.net.real)
            wp.launch(kernel, count, [pairs.pairs, pairs.sides, x], [gap, point], device=x.device)
        i, j = pairs.pairs.numpy()[:count].reshape(-1, 2).T
        force, friction = (_of_first(part, pairs) for part in (terms, rubs))
        return {
            "world": i // pairs.first.count,
            "sizes": np.broadcast_to([pairs.first.size, pairs.second.size], (count, 2)),
            "things": np.column_stack([i % pairs.first.count, j % pairs.second.count]),
            "gap": gap.numpy(),
            "point": point.numpy().reshape(-1, 3),
            "force": force,
            "friction": friction,
        }

    def closest(self, x: wp.array) -> tuple[float, str]:
        """Smallest gap of all candidates [m], and which pair has it; infinite where nothing is near."""
        gap, pair, _ = self.closest_nodes(x)
        return gap, pair

    def closest_nodes(self, x: wp.array) -> tuple[float, str, tuple]:
        """Return the smallest gap of all candidates [m], the pair that has it, and the nodes of both; see `closest`."""
        self.at(x)
        found = self.pairs(x)
        if not len(found["gap"]):
            return np.inf, "", ()
        k = int(np.argmin(np.where(np.isfinite(found["gap"]), found["gap"], np.inf)))
        things = [tuple(map(int, of)) for of in zip(found["sizes"][k], found["things"][k], strict=True)]
        one, other = (self.shapes.describe(*thing) for thing in things)
        world = f" in world {found['world'][k]}" if self.net.worlds > 1 else ""
        nodes = tuple(self.shapes.things(size)[0][index] for size, index in things)
        return float(found["gap"][k]), f"{one} and {other}{world}", nodes


def _of_first(part, pairs) -> np.ndarray:
    """Forces of `PairElements` on the first things of candidates (count, 3) [N], none where `part` is None."""
    count = int(pairs.count.numpy()[0])
    forces, own = np.zeros((count, 3)), 0 if part is None else int(part.count.numpy()[0])
    if own:
        used, found = part.forces()
        every, those = (
            of.pairs.numpy()[:number].astype(np.int64) @ [pairs.second.all, 1]
            for of, number in ((pairs, count), (part, own))
        )  # sorted, both
        forces[np.searchsorted(every, those[used])] = found
    return forces


def shapes_of(host) -> Shapes:
    """What may touch among the blocks of a net."""
    given, shapes = host.touching, Shapes(host.rest)
    for body in given.bodies:
        given_too = {"name": body.label, "still": body.still}
        if body.kind == PLANE:
            number = shapes.plane(body.nodes, name=body.label)
        elif body.kind == MESH:
            number = shapes.shell(body.cells, 2.0 * body.radius, **given_too)
        elif body.kind == BALL:
            number = shapes.ball(int(body.nodes[0]), body.radius, **given_too)
        else:
            apart = 0.0 if body.kind == CAPSULE else given.law.apart
            angles = body.angles if body.angles.size else None
            number = shapes.rod(body.nodes, body.radius, closed=body.closed, apart=apart, angles=angles, **given_too)
        if body.markers.size:
            shapes.spin(number, np.append(body.nodes[0], body.markers))
    for g, h in given.ignored:
        for one in np.flatnonzero(given.group == g):
            for other in np.flatnonzero(given.group == h):
                shapes.ignore(int(one), int(other))
    return shapes
