"""What pairs come to in each world; see `kernels.contact.totals`."""

import warp as wp

from ddg_warp import arrays
from ddg_warp.kernels.contact.totals import ROWS, total_kernels, written_struct
from ddg_warp.solve.net.system import Sums


class Totals:
    """Sums over what lists of contact and of friction have written; `fit` follows whenever they have got more room.

    Attributes:
        energy: (worlds,) [J], infinite while pairs do not fit; touching: (worlds,) pairs that push each other.
        dissipated: (worlds,) [J], what friction takes from its start to the last evaluation, the sum of its forces times slip.
    """

    def __init__(self, contacts: list, frictions: list, worlds: int, real, device):
        self._contacts, self._frictions, self._device = contacts, frictions, device
        self._real, self._worlds = real, worlds
        self.energy, self.dissipated = (wp.zeros(worlds, dtype=real, device=device) for _ in range(2))
        self.touching = wp.zeros(worlds, dtype=int, device=device)
        things = max(part.found.first.count for part in contacts)
        self._of_things = wp.zeros((ROWS * worlds, things), dtype=real, device=device)
        self._of_worlds = wp.zeros((ROWS, worlds), dtype=real, device=device)
        self._sum = Sums(ROWS * worlds, things, real, device)
        self._add, self._tell = total_kernels(real, arrays.serial(device))
        self.kernels = [self._add, self._tell, *self._sum.kernels]
        self.fit()

    def fit(self) -> None:
        """Take the arrays that the lists have now."""
        self._lists = [self._written(part) for part in (*self._contacts, *self._frictions)]  # keep their arrays alive
        self._written_by = wp.array(self._lists, dtype=written_struct(self._real), device=self._device)

    def __call__(self, overflow: wp.array) -> None:
        """Add up what was evaluated last."""
        inputs = [self._written_by, self._worlds]
        arrays.sweep(self._add, self._of_things.shape[1], inputs, [self._of_things], self._device, worlds=self._worlds)
        self._sum(self._of_things, self._of_worlds.flatten())
        outputs = [self.energy, self.touching, self.dissipated]
        wp.launch(self._tell, self._worlds, [self._of_worlds, overflow], outputs, device=self._device)

    def _written(self, part):
        own = written_struct(self._real)()
        own.count, own.starts, own.partners = part.count, part.starts, part.partners
        own.energy, own.used, own.things = part.energy, part.factor.used, part.found.first.count
        if part in self._frictions:
            own.work = part.work
        return own
