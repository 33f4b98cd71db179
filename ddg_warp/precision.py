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


def float32_error(group, s: float) -> float:
    """Estimate of the relative error that a float32 factorisation makes in the direction of the worst rod of a group.

    The rounding unit times the ratio of the stiffest to the softest mode: stretching of an edge against inertia over the step
    of s [s] and the lowest bending mode. For a curved steel rod of r/L = 2e-3 (64 nodes, 1/240 s) it gives 0.1, where 9 % were
    measured.
    """
    kind, host = group.kind, group.host
    softest = host.mass.sum(0) / host.count / s**2
    for term, place in zip(kind.terms, kind.places(), strict=True):
        measure, stiffness = (group.parameter(place[0] + i)[:, : group.rods] for i in range(2))
        if term.measure.span == 1:
            stiffest = (stiffness / measure).max(0)
        else:
            softest = softest + (stiffness * measure).min(0) * (np.pi / host.length) ** 4
    eps = float(np.finfo(np.float32).eps) / 2.0
    return float(np.max(eps * np.broadcast_to(stiffest, host.length.shape) / softest))
