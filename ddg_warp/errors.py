"""Errors and warnings of ddg_warp; every message names the object, its index and the remedy."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ddg_warp.model.state import State


class SceneError(ValueError):
    """Invalid scene or argument."""


class SceneWarning(UserWarning):
    """Valid scene that is likely a mistake."""


class GradientWarning(UserWarning):
    """Missing gradient of worlds; see `ddg_warp.torch.Simulator`."""


class DataError(ValueError):
    """Failed writing or reading of data; the message names the file or folder, the fault and the remedy."""


class MissingPackageError(DataError, ModuleNotFoundError):
    """Missing package of an extra; the message has the command that installs it.

    Args:
        need: subject and verb of the message, such as "the viewer needs".
        error: of the import; extra: of pyproject.toml.
    """

    def __init__(self, need: str, error: ModuleNotFoundError, extra: str):
        command = f"`pip install 'ddg-warp[{extra}]'`, in a clone `pip install -e '.[{extra}]'`"
        super().__init__(f"{need} the package {error.name}: {command}")
        self.name = error.name


class SolverError(RuntimeError):
    """Failed step or equilibrium solve.

    Attributes:
        state: last good state.
        outcome: name of the outcome, such as `line_search_failed`.
        rods: indices of the rods concerned.
        gaining: True if an equilibrium search still decreased the energy when its iterations ended.
    """

    def __init__(
        self,
        message: str,
        *,
        state: "State | None" = None,
        outcome: str = "",
        rods: Iterable[int] = (),
        gaining: bool = False,
    ):
        super().__init__(message)
        self.state = state
        self.outcome = outcome
        self.rods = tuple(rods)
        self.gaining = gaining
