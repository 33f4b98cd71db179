"""Controls on a device: loads that a step is given world by world, and the load scales that they make."""

import numpy as np
import warp as wp

from ddg_warp.compile import tolerance
from ddg_warp.kernels import controls as kernels
from ddg_warp.model import group
from ddg_warp.solve.loads import Loads

LOADS = ("forces", "moments", "gravity")


class Given:
    """The loads that a step is given, of all worlds in the user's order; zero where it is given none.

    Attributes:
        forces, moments: (worlds, points) [N] and (worlds, edges) [N m]; gravity: over the scene's (worlds,) [m/s^2].
        any: whether the step at hand has any.
    """

    def __init__(self, model):
        real, device, worlds = model.types.real, model.wp_device, model.worlds
        vector, self.any = wp.types.vector(3, real), False
        self._usual = np.asarray(model.scene.gravity, float)
        self.forces = wp.zeros((worlds, model.points_count), dtype=vector, device=device)
        self.moments = wp.zeros((worlds, max(1, model.order.edges_count)), dtype=real, device=device)
        self.gravity = wp.zeros(worlds, dtype=vector, device=device)
        self._filled: set[str] = set()

    def upload(self, found: dict[str, np.ndarray]) -> None:
        """Take those among what `Controls.checked` found."""
        self.any = any(name in found for name in LOADS)
        for name in LOADS:
            array = getattr(self, name)
            if name in found:
                values = found[name] - self._usual if name == "gravity" else found[name]
                array.assign(np.ascontiguousarray(np.broadcast_to(values, (len(array), *values.shape[1:]))))
                self._filled.add(name)
            elif name in self._filled:
                array.zero_()
                self._filled.remove(name)


class ControlledLoads(Loads):
    """As `Loads`, on all places and in every world for itself, with those that steps are given.

    Args:
        given: these.
        scale: takes the sizes of the loads on all places (worlds, places) to what residuals are compared with; see `ChainScale`.
    """

    def __init__(self, model, part, midpoint: bool, given: Given, scale):
        super().__init__(model, part, midpoint)
        host, real, device = part.host, model.types.real, model.wp_device
        self.given, self._scale, nodes = given, scale, host.nodes

        def put(values, dtype=real):
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        arm, changing = scale.places(host)
        constant = put(host.constant_loads(), self._vector)
        self._shared = wp.clone(constant) if host.timed else constant
        self._sizes = wp.zeros((model.worlds, len(self.places)), dtype=real, device=device)
        place, row = loaded_rows(model, part)
        order = np.argsort(place, kind="stable")
        starts = np.searchsorted(place[order], np.arange(host.size + 1))
        self._inputs = [self._shared, constant, put(changing), part.node_mass, part.world_columns, put(arm), nodes]
        self._inputs += [put(starts.astype(np.int32), int), put(row[order].astype(np.int32), int)]
        self._inputs += [given.forces, given.moments, given.gravity]
        self._inputs += [put([np.asarray(model.scene.gravity, float)], self._vector)]
        self._load = kernels.load_kernel(real)

    @property
    def _copies(self) -> int:
        return self.part.worlds

    def _touched(self, following: np.ndarray) -> np.ndarray:
        return np.arange(self.part.host.size)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*super().kernels, self._load, *self._scale.kernels]

    def _upload_dead(self, amplitudes: list[float]) -> None:
        if len(amplitudes) > 1:
            self._shared.assign((self._dead @ amplitudes).reshape(-1, 3))

    def give(self) -> None:
        """Add what the step at hand is given, and find what residuals are compared with; launches alone, so that it can be captured."""
        values = self._values.reshape(self._sizes.shape)
        device = self.model.wp_device
        wp.launch(self._load, self._sizes.shape, self._inputs, [values, self._sizes], device=device)
        self._scale.update(self._sizes if self.given.any else None)


class _Scale:
    """Load scales of a part, those of the scene's loads or what the sizes of loads at hand make of them."""

    def __init__(self, model, worlds: int, owner: np.ndarray, bodies: int):
        self.model, self.bodies, self._worlds = model, bodies, worlds
        order = np.argsort(owner, kind="stable")
        self._items = self.indices(order)
        self._starts = self.indices(np.searchsorted(owner[order], np.arange(bodies + 1)))
        self.load = wp.zeros(worlds * bodies, dtype=model.types.real, device=model.wp_device)
        self._sum = kernels.sum_kernel(model.types.real)
        self.kernels, self._kept = [self._sum], []

    def indices(self, values: np.ndarray) -> wp.array:
        return wp.array(values.astype(np.int32), dtype=int, device=self.model.wp_device)

    def keep(self, *arrays: wp.array) -> None:
        """Scales to come back to."""
        self._kept = [(array, wp.clone(array)) for array in arrays]

    def update(self, sizes: wp.array | None) -> None:
        """Take the sizes of the loads on all places, or what was kept."""
        if sizes is None:
            for array, kept in self._kept:
                wp.copy(array, kept)
            return
        self.launch(
            self._sum, (self._worlds, self.bodies), [sizes, self._starts, self._items, self.bodies], [self.load]
        )
        self.share()

    def share(self) -> None:
        """Make the scales of the sums over bodies."""

    def launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)


class ChainScale(_Scale):
    """Of rods on their own; `load` is what residuals of each are compared with [N]."""

    def __init__(self, model, part):
        super().__init__(model, part.worlds, np.arange(part.host.size) % part.rods, part.rods)
        wp.copy(self.load, part.outer)
        self.keep(self.load)

    @staticmethod
    def places(host) -> tuple[np.ndarray, np.ndarray]:
        """What moments are divided by, and sizes of loads that change, of all places."""
        turns = host.size > host.nodes
        arm = np.ones(host.size)
        if turns:
            arm[host.nodes :] = np.tile(host.length, host.shape[0])
        return arm, group.changing_forces(host)


class NetScale(_Scale):
    """Of a net: what residuals of its blocks and parts may be; see `compile.tolerance`.

    Args:
        solver: the `NetNewton` whose `allowed` and `outer` are written.
    """

    def __init__(self, model, part, solver):
        bodies = part.host.bodies
        super().__init__(model, part.worlds, bodies.owner, bodies.count)
        real, self._scale = model.types.real, solver.outer
        self._share, self._limit = kernels.share_kernel(real), kernels.limit_kernel(real)
        self.kernels += [self._share, self._limit]
        order = np.argsort(bodies.components, kind="stable")
        count = int(bodies.components.max()) + 1
        starts = np.searchsorted(bodies.components[order], np.arange(count + 1))
        self._components = [self.indices(starts), self.indices(order), count, bodies.count, self.load]
        block, body, weight = bodies.limit_entries()
        order = np.argsort(block, kind="stable")
        starts = np.searchsorted(block[order], np.arange(part.blocks + 1))
        limits = solver.allowed.blocks.reshape((part.worlds, part.blocks))
        self._limits = [self._list(starts, body[order], weight[order], limits)]
        for level, limit in zip(bodies.levels, solver.allowed.limits, strict=True):
            self._limits.append(self._list(np.arange(len(level.body) + 1), level.body, level.weight, limit))
        self.keep(self._scale, *(limit for *_, limit in self._limits))

    def _list(self, starts, body, weight, limit: wp.array) -> tuple:
        weight = wp.array(weight, dtype=self.model.types.real, device=self.model.wp_device)
        return self.indices(starts), self.indices(body), weight, limit

    @staticmethod
    def places(host) -> tuple[np.ndarray, np.ndarray]:
        """As of `ChainScale`."""
        return host.bodies.arm, tolerance.changing_forces(host) / host.bodies.arm

    def share(self) -> None:
        """Limits of blocks and parts, from the loads of bodies and the mean of what they are connected with."""
        self.launch(self._share, self._worlds, self._components, [self._scale])
        for starts, body, weight, limit in self._limits:
            self.launch(self._limit, limit.shape, [self.load, self.bodies, starts, body, weight], [limit])


def loaded_rows(model, part) -> tuple[np.ndarray, np.ndarray]:
    """Places of a part, and the rows of the user's points that belong to nodes among them, or of his edges to angles."""
    order, host = model.order, part.host
    if part is model.net:
        rows, blocks = order.net_rows
        edges = [order.edge_starts[rod.rod] + np.arange(len(rod.edges)) for rod in host.rods]
        return np.concatenate([blocks, *(rod.edges for rod in host.rods)]), np.concatenate([rows, *edges])
    k, column, rows = order.places(part)
    places = k * part.rods + column
    if part.kind.twist:
        k, column, edges = order.edge_places(part)
        places, rows = np.append(places, host.nodes + k * part.rods + column), np.append(rows, edges)
    return places, rows
