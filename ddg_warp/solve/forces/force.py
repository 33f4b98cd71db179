"""Forces of a step on the nodes of a rod group or of the coupled system that are neither of elements nor of contact."""

from typing import ClassVar


class Force:
    """Force of a step on a `RodGroup` or on the `CoupledModel`.

    Attributes:
        name: name in parameters and reports.
        parameters: rows of coefficients of edges, by name; `signed` may be negative, `positive` must not be zero.
        follows: True if the force depends on the iterate, see `Loads.apply`, while a solve takes that of its predictor.
    """

    name: str
    parameters: ClassVar[dict[str, int]] = {}
    signed: tuple[str, ...] = ()
    positive: tuple[str, ...] = ()
    follows = False

    @property
    def kernels(self) -> list:
        """Kernels to load before a capture."""
        raise NotImplementedError

    def upload(self, t0: float, t1: float) -> None:
        """Upload host data of a step between t0 and t1."""

    def sample(self, before, t0: float, t1: float) -> None:
        """Upload host data that depend on the state `before` of a step between t0 and t1."""

    def begin(self) -> None:
        """Launch the kernels before the first solve of a step; capturable."""

    def freeze(self, before, newton) -> None:
        """Write the force of a solve from the state `before` to the solver `newton`, whose iterate is the predictor.

        A constant force enters its loads, a force that is linear in the solve its inertia; see `kernels.core.inertia`.
        """
        raise NotImplementedError
