"""Contact statistics over the steps of an integrator; see `kernels.collision.contact.statistics`."""

import warp as wp

from ddg_warp.kernels.collision.contact.statistics import LAST, PARTS, SUM, take_kernel
from ddg_warp.solve.collision.contact_potential import ContactPotential


class ContactStatistics:
    """Counts of active pairs, and friction work, over all steps. Reads nothing back and can be captured.

    Attributes:
        counts: of each world (3, worlds), see `kernels.collision.contact.statistics`; work: friction work (worlds,) [J].
    """

    def __init__(self, terms: ContactPotential):
        self.terms, self.device = terms, terms.device
        self._worlds = terms.search.worlds
        self.counts = wp.zeros((3, self._worlds), dtype=wp.int64, device=self.device)
        self.work = wp.zeros(self._worlds, dtype=wp.float64, device=self.device)
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

    def __call__(self, flags: wp.array) -> None:
        """Add the terms as evaluated last, in worlds whose flags say that a substep is done."""
        inputs = [self.terms.touching, self.terms.dissipated, flags]
        wp.launch(self._take, self._worlds, inputs, [self.counts, self.work], device=self.device)

    def statistics(self) -> dict:
        """Return sums over worlds by name: "contacts", pairs after the last step and in the mean; with friction "friction_work" [J]."""
        counts = self.counts.numpy()
        mean = (counts[SUM] / counts[PARTS].clip(1)).sum()
        result = {"contacts": {"mean": float(mean), "last": int(counts[LAST].sum())}}
        return result | ({"friction_work": float(self.work.numpy().sum())} if self.terms.frictions else {})
