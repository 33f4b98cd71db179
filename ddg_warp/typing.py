"""Types of arguments and results in annotations."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import warp as wp

Floats: TypeAlias = npt.NDArray[np.float64]
Integers: TypeAlias = npt.NDArray[np.int64]
Bools: TypeAlias = npt.NDArray[np.bool_]
Names: TypeAlias = npt.NDArray[np.str_]
Complexes: TypeAlias = Floats | npt.NDArray[np.complex128]
Array: TypeAlias = npt.NDArray[np.generic]  # of any type

Numbers: TypeAlias = npt.ArrayLike  # converted to an array of float64
Vector: TypeAlias = Sequence[float] | npt.NDArray[np.floating] | npt.NDArray[np.integer]  # (3,)
Selection: TypeAlias = int | slice | Sequence[int] | Sequence[bool] | npt.NDArray[np.integer] | Bools
FilePath: TypeAlias = str | PathLike[str]
Amplitude: TypeAlias = Callable[[float], float]  # of time, in statics of the load parameter
Option: TypeAlias = float | str | None  # further keyword argument, such as a tolerance

Device: TypeAlias = "str | wp.Device | None"  # None: CUDA if there is one
Precision: TypeAlias = Literal["float64", "mixed", "float32"]
Scheme: TypeAlias = Literal["implicit_euler", "implicit_midpoint"]
End: TypeAlias = Literal["first", "last"]
Axis: TypeAlias = Literal["x", "y", "z"]
