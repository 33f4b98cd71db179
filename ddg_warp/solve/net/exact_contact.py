"""Contact and friction at the solution of a step, in linear systems with the exact Hessian; see `ExactSystem`."""

import warp as wp

from ddg_warp.solve.contact.touch import Touch
from ddg_warp.solve.net.contact_bands import ContactBands

MARGIN = 1e-3  # of the reach, by which searches go beyond it: what is searched for stays where it is


class ExactContact:
    """Contact of a `DeviceNet`. Candidates are found again, where friction was lagged and at the solution: steps keep none.

    Attributes:
        touch: search, pairs and their terms, friction as it was lagged.
        diagonal: blocks at nodes, for preconditioners.
    """

    def __init__(self, net):
        self.net, given = net, net.host.touching
        held = net.host.of_obstacles  # whose rows of H do not count
        self.touch = Touch(net, wp.float64, net.rest().q, held, MARGIN * given.reach, exact=True)
        self.search, self.terms = self.touch.search, self.touch.terms
        self.diagonal = self.terms.diagonal
        self._q = self._bands = None

    def bind(self, system) -> None:
        """Serve an `ExactSystem`."""
        self._system = system
        self._bands = ContactBands(system.chains, self.touch.shapes) if system.chains else None

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self.search.kernels, *self.terms.kernels, *(self._bands.kernels if self._bands else [])]

    def find(
        self, lagged: wp.array, before: wp.array, q: wp.array, rate: wp.array, rates: tuple = (None, None)
    ) -> None:
        """Of a solution q with friction lagged at blocks `lagged`, in a step from `before` at rates 1/h (worlds,). Launches alone.

        `rates` are those by which inertia counts in the stiffness at q, none by default, and where friction was lagged.
        """
        search, terms = self.search, self.terms
        here, there = rates
        terms.brace(here)
        search.rebuild(lagged)
        if terms.frictions:
            search.search(lagged)
            terms.lag(lagged, rate=there)
        search.search(q)
        terms.evaluate(q, rate if terms.frictions else None, before)
        terms.meet()
        terms.prepare(q, self.net.every)
        self._q = q

    def assemble(self) -> None:
        """Its own part in the preconditioner."""
        if self._bands:
            self.terms.join()
            self._bands(self.terms, self._system.islands.arrays[0])

    def spread(self, p: wp.array) -> None:
        """What pairs bring to H p."""
        self.terms.place(p, self._q, self.net.every)

    def settle(self, p: wp.array, product: wp.array) -> None:
        """Add it, and write p . H p block by block."""
        system = self._system
        self.terms.settle(p, product, system.barred, system.islands.wanted, system.krylov_dots)

    def outgrown(self, q: wp.array) -> bool:
        """Whether pairs did not fit, for which there is room then. Reads from the device."""
        grown = self.search.fit(q)
        return self.terms.fit() or grown
