"""Precisions: the scalar type of state, energy and gradient (`real`) and of the linear solve (`linear`)."""

import warnings
from dataclasses import dataclass

import numpy as np
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.errors import SolverError
from ddg_warp.kernels.newton.edge_rotation import STRAIGHT_ROTATION


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
    """Return the precision of this name; by default "mixed" on CUDA and "float64" on the CPU.

    Raises:
        SceneError: unknown precision.
    """
    if name is None:
        name = "mixed" if device.is_cuda else "float64"
    return PRECISIONS[argument_checks.choice("precision", name, PRECISIONS)]


FLOAT32_LIMIT = 0.02  # relative error of a search direction that Newton still corrects quickly; beyond it float32 states are doubtful
STIFF = 5e4  # Stiffness ratio from which rods always use edge-rotation updates and full Hessians.
CARRIED = 1e-3  # Error up to which a float32 matrix includes a stiffness; see `kernels.linear.mixed_axial_force`.
FLOAT32_LOST = 0.1  # Relative error beyond which rounding decides the motion.


def stiffnesses(kind, mass: np.ndarray, length: np.ndarray, parameters: dict, s: float) -> tuple[np.ndarray, ...]:
    """Return the stiffnesses of edge stretch, of bending at a node and of the softest mode, each (R,) [N/m].

    The softest mode is inertia over a step of s [s] plus the lowest bending mode, without inertia at rest, s = inf. A law without a
    named stiffness counts as the worst case: infinite in stretch, zero in bending.

    Args:
        kind: `RodKind` of the rods.
        mass: mean nodal mass (R,) [kg]; length: (R,) [m].
        parameters: parameters of all terms, "term.parameter", each broadcastable to (n, R).
    """
    softest, bending = mass / s**2, np.zeros_like(length)
    for term in kind.terms:
        measure = parameters[f"{term.name}.measure"]
        stretches = term.measure.span == 1
        stiffness = parameters[f"{term.name}.{term.stiffness[0]}"] if term.stiffness else np.inf if stretches else 0.0
        if stretches:
            stretching = (stiffness / measure).max(0)
        else:
            softest = softest + (stiffness * measure).min(0) * (np.pi / length) ** 4
            bending = (16.0 * stiffness / measure**3).max(0)  # zigzag mode of a node between its neighbours
    return np.broadcast_to(stretching, length.shape), np.broadcast_to(bending, length.shape), softest


def float32_error(stiffest, softest) -> np.ndarray:
    """Return the estimated relative error of a search direction solved in float32.

    The estimate is half the rounding unit times the ratio of the stiffest to the softest mode [N/m].

    Measured: 9 % for a curved steel rod of r/L = 2e-3 (64 nodes, 1/240 s), for which the estimate is 0.1.
    """
    with np.errstate(divide="ignore"):
        return 0.5 * float(np.finfo(np.float32).eps) * np.asarray(stiffest) / softest


def largest_carried(softest: np.ndarray) -> np.ndarray:
    """Return the largest stiffness that a float32 matrix resolves with an error of CARRIED [N/m]."""
    return CARRIED / float32_error(1.0, 1.0) * softest


def straight_turns(errors: np.ndarray) -> np.ndarray:
    """Return the largest edge rotation of a straight update [rad], for rods with such errors.

    0 means that every update rotates edges. A straight update that rotates an edge by a stretches it by a^2 / 2, and leaves that
    force to the next iteration. Soft rods need no more iterations for it, and a straight update is cheaper. See
    `kernels.newton.edge_rotation`.
    """
    return np.where(stiff(errors), 0.0, STRAIGHT_ROTATION)


def stiff(errors: np.ndarray) -> np.ndarray:
    """Return the mask of stiff rods by float32 error: stretch at least STIFF times as stiff as bending."""
    return errors > float32_error(STIFF, 1.0)


def rounding(model, s: float = np.inf) -> tuple[float, str]:
    """Return the largest float32 error over a step of s [s], or at rest, and the rod or shell with it."""
    worst = [(0.0, "")]
    for group in model.groups:
        errors = group.float32_errors(s)
        rod = int(group.host.rods[int(errors.argmax()) % group.rods])
        worst.append((float(errors.max()), f"rod {rod} ('{model.curves.names[rod]}')"))
    if model.coupled is not None:
        host = model.coupled.host
        errors = model.coupled.rod_errors(s)
        names = [f"rod {rod.rod} ('{model.curves.names[rod.rod]}')" for rod in host.rods] * (
            len(errors) // max(1, len(host.rods))
        )
        names += [f"shell {i} ('{shell.name}')" for i, shell in enumerate(model.scene.shells)]
        worst += zip(np.concatenate([errors, host.shell_errors(s)]).tolist(), names, strict=True)
    return max(worst)


def warn_of_rounding(model, analysis) -> None:
    """Warn if a float32 state is doubtful over the steps of an analysis, or at rest without one."""
    s = getattr(analysis, "dt", np.inf) * (0.5 if getattr(analysis, "scheme", "") == "implicit_midpoint" else 1.0)
    error, where = rounding(model, s) if model.precision == "float32" else (0.0, "")
    if error > FLOAT32_LIMIT:
        warnings.warn(_message(error, where, s, "float32 is doubtful here"), stacklevel=6)


def lost_in_rounding(model, s: float = np.inf, state=None) -> bool:
    """Return True if rounding decides the motion of a float32 model over a step of s [s], or at rest.

    Raises:
        SolverError: rounding decides, and the model is not built with allow_rounding; names the worst rod or shell.
    """
    error, where = rounding(model, s) if model.precision == "float32" else (0.0, "")
    if error > FLOAT32_LOST and not model.allow_rounding:
        advice = "lost_in_rounding; build with allow_rounding=True to look at it nevertheless"
        raise SolverError(_message(error, where, s, advice), state=state, outcome="lost_in_rounding")
    return error > FLOAT32_LOST


def _message(error: float, where: str, s: float, end: str) -> str:
    steps = f"over {s:g} s" if np.isfinite(s) else "at rest"
    return (
        f"{where}: precision 'float32' leaves a relative error of {error:.2g} in its displacements {steps} (doubtful above "
        f"{FLOAT32_LIMIT}, decided by rounding above {FLOAT32_LOST}); take 'mixed' or 'float64': {end}"
    )
