"""Errors that a user of ddg_warp can meet; every message names the object, its index and the remedy."""


class SceneError(ValueError):
    """A scene cannot be built as described."""


class SceneWarning(UserWarning):
    """A scene that can be built, but is likely not what was meant."""


class GradientWarning(UserWarning):
    """Worlds have no gradient; see `ddg_warp.torch.Simulator`."""


class DataError(ValueError):
    """Data cannot be written or read as asked; the message names the file or folder, what is wrong and the remedy."""


class SolverError(RuntimeError):
    """A step or an equilibrium could not be solved.

    Attributes:
        state: the last good state.
        outcome: name of the outcome, such as `line_search_failed`.
        rods: indices of the rods concerned.
        gaining: whether a search for an equilibrium still gained energy when its iterations ended.
    """

    def __init__(self, message: str, *, state=None, outcome: str = "", rods=(), gaining: bool = False):
        super().__init__(message)
        self.state = state
        self.outcome = outcome
        self.rods = tuple(rods)
        self.gaining = gaining


def check_options(options, positive: tuple[str, ...], counts: tuple[str, ...]) -> None:
    """Refuse an option of a frozen dataclass that is no positive number, or no whole number of at least one.

    Raises:
        SceneError: names the option.
    """
    from ddg_warp import arguments

    for name in positive:
        object.__setattr__(options, name, arguments.positive(name, getattr(options, name)))
    for name in counts:
        arguments.count(name, getattr(options, name), 1, 2**31 - 1)
