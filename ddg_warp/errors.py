"""Errors that a user of ddg_warp can meet; every message names the object, its index and the remedy."""


class SceneError(ValueError):
    """A scene cannot be built as described."""


class SolverError(RuntimeError):
    """A step or an equilibrium could not be solved.

    Attributes:
        state: the last good state.
        outcome: name of the outcome, such as `line_search_failed`.
        rods: indices of the rods concerned.
    """

    def __init__(self, message: str, *, state=None, outcome: str = "", rods=()):
        super().__init__(message)
        self.state = state
        self.outcome = outcome
        self.rods = tuple(rods)
