"""Contact and friction at the solution of a step, for linear systems with the exact Hessian; see `ExactSystem`."""

import warp as wp

from ddg_warp.solve.collision.contact_model import ContactModel
from ddg_warp.solve.linear.contact_hessian import ContactHessian

MARGIN = 1e-3  # of the search distance: skin margin; the query is a single position


class ExactContact:
    """Contact of a `CoupledModel`, with candidates found again at the friction lag and at the solution: steps keep none.

    Args:
        on_obstacles: True to compute forces on obstacles, too; their rows of H do not count.

    Attributes:
        `touch`: search, pairs and their terms, friction lag.
        hessian: `ContactHessian` at the solution.
    """

    def __init__(self, coupled, on_obstacles: bool = False):
        self.coupled, contact = coupled, coupled.host.contact_parameters
        silent = None if on_obstacles else coupled.host.of_obstacles
        self.touch = ContactModel(
            coupled, wp.float64, coupled.rest().q, silent, MARGIN * contact.search_distance, exact=True
        )
        self.search, self.terms = self.touch.search, self.touch.terms
        self.hessian = ContactHessian(self.terms, self.touch.shapes)

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        return [*self.search.kernels, *self.terms.kernels, *self.hessian.kernels]

    def find(
        self, lagged: wp.array, before: wp.array, q: wp.array, rate: wp.array, rates: tuple = (None, None)
    ) -> None:
        """Evaluate contact at a solution q with friction lagged at blocks `lagged`, in a step from `before` at rates 1/h (worlds,).
        Launches alone.

        `rates`: inverse times of inertia in the contact stiffness at q (default: none) and at the friction lag.
        """
        search, terms = self.search, self.terms
        rate_at_q, rate_at_lag = rates
        terms.brace(rate_at_q)
        search.rebuild(lagged)
        if terms.frictions:
            search.search(lagged)
            terms.lag(lagged, rate=rate_at_lag)
        search.search(q)
        terms.evaluate(q, rate if terms.frictions else None, before)
        self.hessian.linearise(q, self.coupled.every)

    def has_overflow(self, q: wp.array) -> bool:
        """Return True if lists of pairs overflowed and have grown. Reads from the device."""
        grown = self.search.fit(q)
        return self.terms.fit() or grown
