"""Sums over pairs in each world; see `kernels.collision.contact.world_sums`."""

import warp as wp

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact.world_sums import ROWS, total_kernels, written_struct
from ddg_warp.solve.linear.sparse_system import Sums


class WorldSums:
    """Sums over the results of contact and friction sets; call `fit` after the sets have grown.

    Attributes:
        `energy`: (worlds,) [J], infinite after a capacity overflow.
        `active_pairs`: (worlds,) number of active pairs.
        `dissipated`: (worlds,) [J] friction work from the start to the last evaluation, the sum of forces times slip.
    """

    def __init__(self, contacts: list, frictions: list, search, real):
        worlds, self._device = search.worlds, search.device
        self._contacts, self._frictions = contacts, frictions
        self._real, self._worlds, self._search_distance = real, worlds, search.search_distance
        device = self._device
        self.energy, self.dissipated = (wp.zeros(worlds, dtype=real, device=device) for _ in range(2))
        self.active_pairs = wp.zeros(worlds, dtype=int, device=device)
        primitives = max(contact.found.first.count for contact in contacts)
        self._of_primitives = wp.zeros((ROWS * worlds, primitives), dtype=real, device=device)
        self._of_worlds = wp.zeros((ROWS, worlds), dtype=real, device=device)
        self._sum = Sums(ROWS * worlds, primitives, real, device)
        self._add, self._tell = total_kernels(real, device_arrays.serial(device))
        self.kernels = [self._add, self._tell, *self._sum.kernels]
        self.fit()

    def fit(self) -> None:
        """Take the present arrays of the sets."""
        # keeps the arrays alive
        self._lists = [self._written(pair_set) for pair_set in (*self._contacts, *self._frictions)]
        self._written_by = wp.array(self._lists, dtype=written_struct(self._real), device=self._device)

    def __call__(self, overflow: wp.array, least: wp.array, gap: wp.array) -> None:
        """Sum the last evaluation over each world; write the smallest gaps to `gap`, and reset `least`."""
        inputs = [self._written_by, self._worlds]
        device_arrays.sweep(
            self._add, self._of_primitives.shape[1], inputs, [self._of_primitives], self._device, worlds=self._worlds
        )
        self._sum(self._of_primitives, self._of_worlds.flatten())
        inputs, outputs = [self._of_worlds, overflow, self._search_distance], [self.energy, self.active_pairs]
        outputs += [self.dissipated, least, gap]
        wp.launch(self._tell, self._worlds, inputs, outputs, device=self._device)

    def _written(self, pair_set):
        struct = written_struct(self._real)()
        struct.count, struct.starts, struct.partners = pair_set.count, pair_set.starts, pair_set.partners
        struct.energy, struct.used, struct.primitives = (
            pair_set.energy,
            pair_set.factor.used,
            pair_set.found.first.count,
        )
        if pair_set in self._frictions:
            struct.work = pair_set.work
        return struct
