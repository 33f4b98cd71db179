"""Gradient checks of steps and equilibria by every input, against central differences: `ddg-warp gradients`.

Each input is moved along one random direction in all of its entries, in two worlds at once. The loss is a random sum of positions,
velocities and angles after two steps from a state in motion. In equilibrium it sums positions and angles; with friction, positions
after two load steps from rest. Inputs of a `Simulator` are checked through its public calls, mass damping and step length through
the backward pass of steps. Density stands for all masses and rotary inertia, and is compared with scenes of another density.
"""

from collections.abc import Iterator

import numpy as np
import torch

from ddg_warp.errors import SceneError, SolverError
from ddg_warp.torch.gradient_check_cases import REAL, Case, Input
from ddg_warp.torch.gradient_check_scenes import OBJECTS

RIGHT, NONE, REFUSED, WRONG, SILENT = "right", "none", "refused", "WRONG", "SILENT ZERO"  # results
ANALYSES = ("implicit_euler", "implicit_midpoint", "statics")
TOLERANCE = 1e-5  # relative error of a gradient
RESOLVED = 1e-4  # floor of the relative change of the loss in an error
CHANGE = 1e-4  # relative change of the loss over the increment of a difference


def derivatives(case: Case, inputs: list[Input]) -> list[float | Exception]:
    """Return the derivative by every input, or the error that refuses it.

    Equilibria refuse inputs of the first state, which stay out of the batch of all others.
    """
    batch = [each for each in inputs if each.change and not (case.statics and each.start)]
    try:
        result = dict(zip([each.name for each in batch], case.derivatives(batch), strict=True))
    except (SceneError, SolverError):
        result = {}
    return [result[each.name] if each.name in result else _derivative(case, each) for each in inputs]


def _derivative(case: Case, input_: Input) -> float | Exception:
    """Return the derivative by one input, or the error that refuses it."""
    try:
        return case.derivatives([input_])[0] if input_.change else input_.gradient()
    except (SceneError, SolverError) as error:
        return error


def losses(case: Case, inputs: list[Input], moved: np.ndarray) -> np.ndarray:
    """Return the losses with each input moved alone, input i by `moved[i]`."""
    result, batch = np.zeros(len(inputs)), [i for i, each in enumerate(inputs) if each.loss is None]
    with torch.no_grad():
        if batch:
            shifts = torch.as_tensor(moved[batch], dtype=REAL, device=case.place)
            result[batch] = case.losses([inputs[i] for i in batch], shifts).cpu()
        for i, each in enumerate(inputs):
            if each.loss is not None:
                result[i] = each.loss(moved[i])
    return result


def differences(case: Case, inputs: list[Input], about: np.ndarray, scale: float, factor: float = 1.0) -> np.ndarray:
    """Return derivatives by fourth-order differences, and the differences of two second-order estimates (2, inputs).

    Args:
        about: expected derivatives, which set the increments.
        scale: size of the loss.
        factor: multiple of the usual increment.
    """
    size = np.array([each.size for each in inputs])
    h = factor * np.minimum(1e-3 * size, CHANGE * scale / np.maximum(np.abs(about), 1e-12 * scale / size))
    sides = {x: losses(case, inputs, x * h) for x in (2.0, 1.0, -1.0, -2.0)}
    near, far = ((sides[x] - sides[-x]) / (2.0 * x * h) for x in (1.0, 2.0))
    return np.stack([(4.0 * near - far) / 3.0, np.abs(near - far)])


def compare(case: Case, inputs: list[Input], gradient: np.ndarray, scale: float) -> np.ndarray:
    """Return relative errors of derivatives against differences; large ones against the most consistent of several."""
    floor = RESOLVED * scale / np.array([each.size for each in inputs])

    def errors(references: np.ndarray, rows) -> np.ndarray:
        return np.abs(gradient[rows] - references) / np.maximum(np.abs(references), floor[rows])

    first = differences(case, inputs, gradient, scale)
    result = errors(first[0], slice(None))
    large = np.flatnonzero(~(result <= TOLERANCE))
    if len(large):
        again = [inputs[i] for i in large]
        variants = [differences(case, again, gradient[large], scale, share) for share in (10.0, 0.1, 0.01)]
        references, spreads = np.stack([first[:, large], *variants], axis=1)
        best = np.where(np.isnan(spreads), np.inf, spreads).argmin(0)
        result[large] = errors(references[best, np.arange(len(large))], large)
    return result


def table(objects=tuple(OBJECTS), analyses=ANALYSES, device: str = "cpu") -> Iterator[dict]:
    """Yield rows of object, analysis, input, result (as named above), error and reason."""
    for name in objects:
        for analysis in analyses:
            yield from _rows(name, analysis, device)


def _rows(name: str, analysis: str, device: str) -> Iterator[dict]:
    row = {"object": name, "analysis": analysis}
    try:
        case = Case(name, analysis, device)
        with torch.no_grad():
            scale = abs(float(case.loss(case.end(case.simulator))))
    except (SceneError, SolverError) as error:
        yield row | _refused("everything", error)
        return
    inputs = list(case.inputs())
    gradient = derivatives(case, inputs)
    good = [i for i, each in enumerate(gradient) if not isinstance(each, Exception)]
    errors = compare(case, [inputs[i] for i in good], np.array([gradient[i] for i in good]), scale)
    errors = dict(zip(good, errors.tolist(), strict=True))
    for i, (each, derivative) in enumerate(zip(inputs, gradient, strict=True)):
        if i not in errors:
            yield row | _refused(each.name, derivative)
            continue
        right = errors[i] <= TOLERANCE
        result = (RIGHT if derivative else NONE) if right else (WRONG if derivative else SILENT)
        reason = "the result does not depend on it" if result == NONE else ""
        yield row | {"input": each.name, "result": result, "error": errors[i], "reason": reason}


def _refused(name: str, error: Exception) -> dict:
    return {"input": name, "result": REFUSED, "error": "", "reason": str(error)}


def gathered(rows: list[dict]) -> list[dict]:
    """Merge rows of one object and analysis with equal results into one, with the largest error."""
    merged: dict[tuple, dict] = {}
    for row in rows:
        key = row["object"], row["analysis"], row["result"], row["reason"]
        if key in merged:
            row_of_key = merged[key]
            row_of_key["inputs"] += f", {row['input']}"
            row_of_key["error"] = max(row_of_key["error"], row["error"])
        else:
            names = ("object", "analysis", "result", "error", "reason")
            merged[key] = {name: row[name] for name in names} | {"inputs": row["input"]}
    return list(merged.values())
