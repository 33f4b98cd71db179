"""Contact statistics over the steps of an integrator; see `kernels.collision.contact.statistics`."""

import math

import warp as wp

from ddg_warp.kernels.collision.contact.statistics import LAST, PARTS, SUM, take_kernel
from ddg_warp.solve.collision.contact_potential import ContactPotential


class ContactStatistics:
    """Counts of active pairs and crossings, smallest gap and friction work, over all steps. Reads nothing back in a step.

    Attributes:
        counts: of each world (3, worlds), see `kernels.collision.contact.statistics`; work: friction work (worlds,) [J].
        crossed: (1,) interpenetrating pairs refused; least: (1,) smallest gap [m].
    """

    def __init__(self, terms: ContactPotential):
        self.terms, self.device = terms, terms.device
        self._worlds = terms.search.worlds
        self.counts = wp.zeros((3, self._worlds), dtype=wp.int64, device=self.device)
        self.work = wp.zeros(self._worlds, dtype=wp.float64, device=self.device)
        self.crossed = wp.zeros(1, dtype=wp.int64, device=self.device)
        self.least = wp.full(1, math.inf, dtype=terms.real, device=self.device)
        self._before = [wp.zeros_like(array) for array in self.arrays]
        self._take = take_kernel(terms.real)

    @property
    def arrays(self) -> list[wp.array]:
        """Arrays of the statistics."""
        return [self.counts, self.work]

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [self._take]

    def begin(self) -> None:
        """Save the statistics before a step that may have to be redone."""
        for kept, array in zip(self._before, self.arrays, strict=True):
            wp.copy(kept, array)

    def forget(self) -> None:
        """Restore the statistics before the last step."""
        for kept, array in zip(self._before, self.arrays, strict=True):
            wp.copy(array, kept)

    def go_on(self, previous: "ContactStatistics") -> None:
        """Continue the statistics of a previous object."""
        for target, source in zip(self._all, previous._all, strict=True):
            wp.copy(target, source)

    @property
    def _all(self) -> list[wp.array]:
        return [self.crossed, self.least, self.terms.search.counters.searches, *self.arrays]

    def __call__(self, flags: wp.array) -> None:
        """Add the terms as evaluated last, in worlds whose flags say that a substep is done."""
        inputs = [self.terms.active_pairs, self.terms.dissipated, flags]
        wp.launch(self._take, self._worlds, inputs, [self.counts, self.work], device=self.device)

    def statistics(self) -> dict:
        """Return the statistics of all worlds by name.

        Counts of searches, refused interpenetrations, present candidates, and "contacts": active pairs after the last step and in
        the mean. Smallest gap [m], infinite beyond the activation distance. With friction, "friction_work" [J].
        """
        counts, least, search = self.counts.numpy(), self.least.numpy()[0], self.terms.search
        mean = (counts[SUM] / counts[PARTS].clip(1)).sum()
        result = {
            "searches": int(search.counters.searches.numpy()[0]),
            "refused_crossings": int(self.crossed.numpy()[0]),
            "smallest_gap": float(least) if least < least.dtype.type(search.search_distance) else math.inf,
            "candidates": sum(int(pairs.count.numpy()[0]) for pairs in search.lists),
            "contacts": {"mean": float(mean), "last": int(counts[LAST].sum())},
        }
        return result | ({"friction_work": float(self.work.numpy().sum())} if self.terms.frictions else {})
