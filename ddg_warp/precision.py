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


FLOAT32_LIMIT = 0.02  # relative error of a direction that Newton still corrects quickly


def float32_error(kind, mass: np.ndarray, length: np.ndarray, parameters: list[np.ndarray], s: float) -> float:
    """Estimate of the relative error that a float32 solution makes in the direction of the worst of rods of one kind.

    The rounding unit times the ratio of the stiffest to the softest mode: stretching of an edge against inertia over the step
    of s [s] and the lowest bending mode. For a curved steel rod of r/L = 2e-3 (64 nodes, 1/240 s) it gives 0.1, where 9 % were
    measured.

    Args:
        kind: `ChainKind` of the rods.
        mass: mean of their nodes (R,) [kg]; length: (R,) [m].
        parameters: rows of all terms, each broadcastable to (n, R).
    """
    softest = mass / s**2
    for term, place in zip(kind.terms, kind.places(), strict=True):
        measure, stiffness = parameters[place[0] : place[0] + 2]
        if term.measure.span == 1:
            stiffest = (stiffness / measure).max(0)
        else:
            softest = softest + (stiffness * measure).min(0) * (np.pi / length) ** 4
    eps = float(np.finfo(np.float32).eps) / 2.0
    return float(np.max(eps * np.broadcast_to(stiffest, length.shape) / softest))
