"""Precisions: the scalar type of state, energy and gradient (`real`) and of the linear solve (`linear`)."""

import warnings
from dataclasses import dataclass

import numpy as np
import warp as wp

from ddg_warp import arguments
from ddg_warp.errors import SolverError
from ddg_warp.kernels.turns import TURNED


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
    return PRECISIONS[arguments.choice("precision", name, PRECISIONS)]


FLOAT32_LIMIT = (
    0.02  # relative error of a direction that Newton still corrects quickly; beyond it a state in float32 is doubtful
)
STIFF = 5e4  # ratio of stiffnesses from which on rods always turn their edges, and take second derivatives
CARRIED = 1e-3  # error up to which a float32 matrix takes a stiffness; see `kernels.solve.tension`
FLOAT32_LOST = 0.1  # and beyond this one its motion is that of its rounding, not of the scene


def stiffnesses(kind, mass: np.ndarray, length: np.ndarray, parameters: dict, s: float) -> tuple[np.ndarray, ...]:
    """Of rods of one kind: of stretching an edge, of bending at a node, and of the softest mode, each (R,) [N/m].

    The last is inertia over the step of s [s] and the lowest bending mode; at rest, s = inf, that alone. A law that names no stiffness
    is taken for the worst: of stretching without a bound, of bending without any.

    Args:
        kind: `ChainKind` of the rods.
        mass: mean of their nodes (R,) [kg]; length: (R,) [m].
        parameters: of all terms, "term.parameter", each broadcastable to (n, R).
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
            bending = (16.0 * stiffness / measure**3).max(0)  # a node to and fro between its neighbours
    return np.broadcast_to(stretching, length.shape), np.broadcast_to(bending, length.shape), softest


def float32_error(stiffest, softest) -> np.ndarray:
    """Estimate of the relative error that a float32 solution makes in a direction.

    The rounding unit times the ratio of the stiffest to the softest mode [N/m]. For a curved steel rod of r/L = 2e-3 (64 nodes,
    1/240 s) it gives 0.1, where 9 % were measured.
    """
    with np.errstate(divide="ignore"):
        return 0.5 * float(np.finfo(np.float32).eps) * np.asarray(stiffest) / softest


def largest_carried(softest: np.ndarray) -> np.ndarray:
    """The stiffness that a float32 matrix carries beside the softest mode, within an error of CARRIED [N/m]."""
    return CARRIED / float32_error(1.0, 1.0) * softest


def straight_turns(errors: np.ndarray) -> np.ndarray:
    """Largest turn of an edge that a step takes straight [rad], of rods with such errors; 0: they always turn their edges.

    A straight step stretches an edge that it turns by an angle a by a^2 / 2, and leaves the force of that to the next iteration. Soft
    rods need no more iterations for it, and a straight step is cheaper. See `kernels.turns`.
    """
    return np.where(stiff(errors), 0.0, TURNED)


def stiff(errors: np.ndarray) -> np.ndarray:
    """Which rods with such errors are STIFF times as stiff along their edges as across, or more."""
    return errors > float32_error(STIFF, 1.0)


def rounding(model, s: float = np.inf) -> tuple[float, str]:
    """The largest such error in a model over a step of s [s], or at rest; and where it is."""
    worst = [(0.0, "")]
    for group in model.groups:
        errors = group.float32_errors(s)
        rod = int(group.host.rods[int(errors.argmax()) % group.rods])
        worst.append((float(errors.max()), f"rod {rod} ('{model.curves.names[rod]}')"))
    if model.net is not None:
        host = model.net.host
        errors = model.net.rod_errors(s)
        names = [f"rod {rod.rod} ('{model.curves.names[rod.rod]}')" for rod in host.rods] * (
            len(errors) // max(1, len(host.rods))
        )
        names += [f"shell {i} ('{shell.name}')" for i, shell in enumerate(model.scene.shells)]
        worst += zip(np.concatenate([errors, host.shell_errors(s)]).tolist(), names, strict=True)
    return max(worst)


def warn_of_rounding(model, analysis) -> None:
    """Warn where a state in float32 is doubtful over the steps of an analysis, or at rest if it has none."""
    s = getattr(analysis, "dt", np.inf) * (0.5 if getattr(analysis, "scheme", "") == "implicit_midpoint" else 1.0)
    error, where = rounding(model, s) if model.precision == "float32" else (0.0, "")
    if error > FLOAT32_LIMIT:
        warnings.warn(_message(error, where, s, "float32 is doubtful here"), stacklevel=6)


def lost_in_rounding(model, s: float = np.inf, state=None) -> bool:
    """Whether rounding decides what a model in float32 does over a step of s [s], or at rest; of one built to allow that.

    Raises:
        SolverError: it does, and the model was not built to allow that; names the worst rod or shell.
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
