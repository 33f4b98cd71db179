"""Control loads on a device, per step and world, and the resulting load scales."""

import numpy as np
import warp as wp

from ddg_warp import device_arrays
from ddg_warp.compile import residual_tolerance
from ddg_warp.kernels.forces import control_loads as kernels
from ddg_warp.model import rod_group
from ddg_warp.solve.forces.loads import Loads

LOADS = ("forces", "moments", "gravity")


class Given:
    """Control loads of a step in all worlds, in the order of the user; zero by default.

    Attributes:
        forces, moments: (worlds, points) [N] and (worlds, edges) [N m].
        gravity: difference from the gravity of the scene (worlds,) [m/s^2].
        any: True if the current step has control loads.
    """

    def __init__(self, model):
        real, device, worlds = model.types.real, model.wp_device, model.worlds
        vector, self.any = wp.types.vector(3, real), False
        self._usual = np.asarray(model.scene.gravity, float)
        self.forces = wp.zeros((worlds, model.points_count), dtype=vector, device=device)
        self.moments = wp.zeros((worlds, max(1, model.order.edges_count)), dtype=real, device=device)
        self.gravity = wp.zeros(worlds, dtype=vector, device=device)
        self._filled: set[str] = set()
        self._writings: dict[str, device_arrays.Writing] = {}

    def upload(self, inputs: dict[str, np.ndarray]) -> None:
        """Upload the loads of `Controls.checked`."""
        self.any = any(name in inputs for name in LOADS)
        for name in LOADS:
            array = getattr(self, name)
            if name in inputs and inputs[name].size:
                values = inputs[name] - self._usual if name == "gravity" else inputs[name]
                if name not in self._writings:
                    self._writings[name] = device_arrays.Writing(array)
                self._writings[name](values)
                self._filled.add(name)
            elif name in self._filled:
                array.zero_()
                self._filled.remove(name)


class ControlledLoads(Loads):
    """Loads in time, follower loads and control loads on all dof blocks, per world.

    Args:
        control_loads: control loads of a step.
        scale: computes load scales from absolute loads on all dof blocks (worlds, blocks); see `RodScale`.
    """

    def __init__(self, model, part, midpoint: bool, control_loads: Given, scale):
        super().__init__(model, part, midpoint)
        host, real, device = part.host, model.types.real, model.wp_device
        self.given, self._scale, nodes = control_loads, scale, host.nodes

        def put(values, dtype=real):
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=device)

        arm, changing = scale.places(host)
        constant = put(host.constant_loads(), self._vector)
        self._shared = wp.clone(constant) if host.timed else constant
        self._sizes = wp.zeros((model.worlds, len(self.places)), dtype=real, device=device)
        block, row = loaded_rows(model, part)
        order = np.argsort(block, kind="stable")
        starts = np.searchsorted(block[order], np.arange(host.size + 1))
        self._inputs = [self._shared, constant, put(changing), part.node_mass, part.world_columns, put(arm), nodes]
        self._inputs += [put(starts.astype(np.int32), int), put(row[order].astype(np.int32), int)]
        self._inputs += [control_loads.forces, control_loads.moments, control_loads.gravity]
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

    def begin(self) -> None:
        """Add the control loads of the step and update the load scales; capturable."""
        values = self._values.reshape(self._sizes.shape)
        device = self.model.wp_device
        wp.launch(self._load, self._sizes.shape, self._inputs, [values, self._sizes], device=device)
        self._scale.update(self._sizes if self.given.any else None)


class _Scale:
    """Load scales of a stepper, from the loads of the scene or from the current loads."""

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
        """Store the scales of the loads of the scene."""
        self._kept = [(array, wp.clone(array)) for array in arrays]

    def update(self, sizes: wp.array | None) -> None:
        """Update the scales from absolute loads on all dof blocks, or restore the stored ones."""
        if sizes is None:
            for array, kept in self._kept:
                wp.copy(array, kept)
            return
        self.launch(
            self._sum, (self._worlds, self.bodies), [sizes, self._starts, self._items, self.bodies], [self.load]
        )
        self.share()

    def share(self) -> None:
        """Compute the scales from the sums over bodies."""

    def launch(self, kernel, dim, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs, outputs, device=self.model.wp_device)


class RodScale(_Scale):
    """Load scales of uncoupled rods; `load` is the load scale of each rod [N]."""

    def __init__(self, model, part):
        super().__init__(model, part.worlds, np.arange(part.host.size) % part.rods, part.rods)
        wp.copy(self.load, part.outer)
        self.keep(self.load)

    @staticmethod
    def places(host) -> tuple[np.ndarray, np.ndarray]:
        """Return divisors of moments and absolute loads in time of all dof blocks."""
        turns = host.size > host.nodes
        arm = np.ones(host.size)
        if turns:
            arm[host.nodes :] = np.tile(host.length, host.shape[0])
        return arm, rod_group.changing_forces(host)


class CoupledScale(_Scale):
    """Residual limits of dof blocks and clusters of the coupled system; see `compile.residual_tolerance`.

    Args:
        solver: the `CoupledNewton` whose tolerances and load scale are written.
    """

    def __init__(self, model, part, solver):
        bodies = part.host.bodies
        super().__init__(model, part.worlds, bodies.owner, bodies.count)
        real, self._scale = model.types.real, solver.loading.scale
        self._share, self._limit = kernels.scale_kernel(real), kernels.limit_kernel(real)
        self.kernels += [self._share, self._limit]
        order = np.argsort(bodies.components, kind="stable")
        count = int(bodies.components.max()) + 1
        starts = np.searchsorted(bodies.components[order], np.arange(count + 1))
        self._components = [self.indices(starts), self.indices(order), count, bodies.count, self.load]
        block, body, weight = bodies.limit_entries()
        order = np.argsort(block, kind="stable")
        starts = np.searchsorted(block[order], np.arange(part.blocks + 1))
        limits = solver.tolerances.blocks.reshape((part.worlds, part.blocks))
        self._limits = [self._list(starts, body[order], weight[order], limits)]
        for level, limit in zip(bodies.levels, solver.tolerances.limits, strict=True):
            self._limits.append(self._list(np.arange(len(level.body) + 1), level.body, level.weight, limit))
        self.keep(self._scale, *(limit for *_, limit in self._limits))

    def _list(self, starts, body, weight, limit: wp.array) -> tuple:
        weight = wp.array(weight, dtype=self.model.types.real, device=self.model.wp_device)
        return self.indices(starts), self.indices(body), weight, limit

    @staticmethod
    def places(host) -> tuple[np.ndarray, np.ndarray]:
        """Return divisors of moments and absolute loads in time of all dof blocks."""
        return host.bodies.arm, residual_tolerance.changing_forces(host) / host.bodies.arm

    def share(self) -> None:
        """Compute limits of dof blocks and clusters from body loads and means over connected bodies."""
        self.launch(self._share, self._worlds, self._components, [self._scale])
        for starts, body, weight, limit in self._limits:
            self.launch(self._limit, limit.shape, [self.load, self.bodies, starts, body, weight], [limit])


def loaded_rows(model, part) -> tuple[np.ndarray, np.ndarray]:
    """Return loadable dof blocks, and the user's row of each: points for nodes, edges for angles."""
    order, host = model.order, part.host
    if part is model.coupled:
        rows, blocks = order.coupled_rows
        edges = [order.edge_starts[rod.rod] + np.arange(len(rod.edges)) for rod in host.rods]
        return np.concatenate([blocks, *(rod.edges for rod in host.rods)]), np.concatenate([rows, *edges])
    k, column, rows = order.places(part)
    places = k * part.rods + column
    if part.kind.twist:
        k, column, edges = order.edge_places(part)
        places, rows = np.append(places, host.nodes + k * part.rods + column), np.append(rows, edges)
    return places, rows
