"""Loads in time and follower loads on a device, added to constant loads."""

import numpy as np
import warp as wp
from scipy import sparse

from ddg_warp.kernels.forces.follower_loads import follower_kernel, spread_kernel
from ddg_warp.solve.forces.force import Force


class Loads(Force):
    """Loads in time and follower loads of a rod group or of the coupled system.

    Args:
        part: `RodGroup` or `CoupledModel`.
        midpoint: True if the scheme evaluates forces at the middle of a step.
    """

    name = "loads"

    def __init__(self, model, part, midpoint: bool):
        host, real, device = part.host, model.types.real, model.wp_device
        self.model, self.part, self.midpoint, self._vector = model, part, midpoint, wp.types.vector(3, real)
        following = np.concatenate([np.zeros(0, int), *(load.places.ravel() for load in host.followers)])
        self.places = self._touched(following)
        self._dead = self._matrix([host.constant, *host.timed])
        self._values = wp.zeros(self._copies * len(self.places), dtype=self._vector, device=device)
        self.total, self.follows = len(following), bool(host.followers)
        self._force = wp.zeros(max(1, part.worlds * self.total), dtype=self._vector, device=device)

        def put(values):
            return wp.array(np.ascontiguousarray(values, np.int32), dtype=int, device=device)

        first, self._followers = 0, []  # kernel, load, dof blocks, values, index of the first force
        for load in host.followers:
            values = wp.array(load.values, dtype=self._vector, device=device)
            kernel = follower_kernel(load.kernel, load.places.shape[1], part.dim, real)
            self._followers.append((kernel, load, put(host.index(load.places)), values, first))
            first += load.places.size
        target = np.searchsorted(self.places, following)
        items = np.argsort(target, kind="stable")
        starts, items = put(np.searchsorted(target[items], np.arange(len(self.places) + 1))), put(items)
        places, nodes = put(host.index(self.places)), int(np.searchsorted(self.places, host.nodes))
        stride = len(self.places) if self._copies > 1 else 0
        self._spread = [  # kernel, index of the output array, lists
            (
                spread_kernel(dim, real),
                i,
                [places[some], self._values[some.start :], stride, starts[some.start :], items],
            )
            for i, (dim, some) in enumerate(((part.dim, slice(0, nodes)), (1, slice(nodes, len(self.places)))))
            if some.start < some.stop
        ]

    @property
    def _copies(self) -> int:
        """Number of copies of dead loads: one for all worlds."""
        return 1

    def _touched(self, following: np.ndarray) -> np.ndarray:
        """Return the dof blocks of loads in time and follower loads."""
        return np.unique(np.concatenate([following, *(load.places for load in self.part.host.timed)]))

    def _matrix(self, loads: list) -> sparse.csr_array:
        """Return the matrix of loads at full amplitude on the components of the dof blocks (3 P, loads)."""
        rows, columns, values = [], [], []
        for i, load in enumerate(loads):
            present = np.isin(load.places, self.places)
            rows.append((3 * np.searchsorted(self.places, load.places[present])[:, None] + np.arange(3)).ravel())
            columns.append(np.full(len(rows[-1]), i))
            values.append(load.force[present].ravel())
        data, *where = (np.concatenate(parts) for parts in (values, rows, columns))
        return sparse.csr_array((data, where), shape=(3 * len(self.places), len(loads)))

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*{kernel for kernel, *_ in self._followers}, *(kernel for kernel, *_ in self._spread)]

    def upload(self, t0: float, t1: float) -> None:
        """Upload values at the evaluation time of the scheme."""
        time = 0.5 * (t0 + t1) if self.midpoint else t1
        self._upload_dead([1.0, *(load.at(time, 1.0) for load in self.part.host.timed)])
        for _, load, _, values, _ in self._followers:
            if load.amplitude is not None:
                values.assign(load.at(time, 1.0) * load.values)

    def _upload_dead(self, amplitudes: list[float]) -> None:
        """Upload dead loads by amplitudes: constant loads, then each load in time."""
        self._values.assign((self._dead @ amplitudes).reshape(-1, 3))

    def freeze(self, before, newton) -> None:
        """Write the loads at the predictor; see `Force`."""
        self.apply(*newton.node_loads)

    def apply(self, x: wp.array, force: wp.array, moment: wp.array) -> None:
        """Write the loads on nodes at positions x, and on angles."""
        part = self.part
        for kernel, load, places, values, first in self._followers:
            inputs = [x, places, values, part.world_columns, first, self.total]
            wp.launch(kernel, (len(load.places), part.worlds), inputs, [self._force], device=part.device)
        for kernel, i, lists in self._spread:
            inputs = [*lists, self._force, part.world_columns, self.total]
            wp.launch(kernel, (len(lists[0]), part.worlds), inputs, [(force, moment)[i]], device=part.device)


class StaticLoads(Loads):
    """Loads of an equilibrium at a load parameter, per world."""

    @property
    def _copies(self) -> int:
        return self.part.worlds

    def scale(self, dead: np.ndarray, load_factor: float) -> None:
        """Upload values at `load_factor`, with dead loads on all dof blocks (worlds, P, 3)."""
        self._values.assign(dead[:, self.places].reshape(-1, 3))
        for _, load, _, values, _ in self._followers:
            values.assign(load.at(load_factor, load_factor) * load.values)
