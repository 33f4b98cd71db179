"""Precisions: the scalar type of state, energy and gradient (`real`) and of the linear solve (`linear`)."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError


@dataclass(frozen=True)
class Precision:
    """Scalar types of a model; `eps` is the rounding unit of `real`."""

    name: str
    real: type
    linear: type

    @property
    def eps(self) -> float:
        return float(np.finfo(wp.dtype_to_numpy(self.real)).eps)


PRECISIONS = {
    "float64": Precision("float64", wp.float64, wp.float64),
    "mixed": Precision("mixed", wp.float64, wp.float32),
    "float32": Precision("float32", wp.float32, wp.float32),
}


def choose(name: str | None, device) -> Precision:
    """By default "mixed" on CUDA and "float64" on the CPU.

    Raises:
        SceneError: there is no such precision.
    """
    if name is None:
        name = "mixed" if device.is_cuda else "float64"
    if name not in PRECISIONS:
        raise SceneError(f"precision {name!r}: it is one of {', '.join(PRECISIONS)}")
    return PRECISIONS[name]
