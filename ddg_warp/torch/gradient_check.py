"""Gradient checks of steps and equilibria by every input, against central differences: `ddg-warp gradients`.

Each input is moved along one random direction in all of its entries, in two worlds at once. The loss is a random sum of positions,
velocities and angles after two steps from a state in motion. In equilibrium it sums positions and angles; with friction, positions
after two load steps from rest. Inputs of a `Simulator` are checked through its public calls, mass damping and step length through
the backward pass of steps. Density stands for all masses and rotary inertia, and is compared with scenes of another density.
"""

from collections.abc import Iterator

import torch

from ddg_warp.errors import SceneError, SolverError
from ddg_warp.torch.gradient_check_cases import Case, Input
from ddg_warp.torch.gradient_check_scenes import OBJECTS

RIGHT, NONE, REFUSED, WRONG, SILENT = "right", "none", "refused", "WRONG", "SILENT ZERO"  # results
ANALYSES = ("implicit_euler", "implicit_midpoint", "statics")
TOLERANCE = 1e-5  # relative error of a gradient
RESOLVED = 1e-4  # floor of the relative change of the loss in an error
CHANGE = 1e-4  # relative change of the loss over the increment of a difference


def difference(input_: Input, about: float, scale: float, factor: float = 1.0) -> tuple[float, float]:
    """Return a derivative by fourth-order differences, and the difference of two second-order estimates.

    Args:
        about: expected derivative, which sets the increment.
        scale: size of the loss.
        factor: multiple of the usual increment.
    """
    h = factor * min(1e-3 * input_.size, CHANGE * scale / max(abs(about), 1e-12 * scale / input_.size))
    with torch.no_grad():
        losses = {x: float(input_.loss(x * h)) for x in (2.0, 1.0, -1.0, -2.0)}
    near, far = ((losses[x] - losses[-x]) / (2.0 * x * h) for x in (1.0, 2.0))
    return (4.0 * near - far) / 3.0, abs(near - far)


def compare(input_: Input, derivative: float, scale: float) -> float:
    """Return the relative error of a derivative against differences; if large, against the most consistent of several."""

    def error(reference: float) -> float:
        return abs(derivative - reference) / max(abs(reference), RESOLVED * scale / input_.size)

    reference, spread = difference(input_, derivative, scale)
    if error(reference) <= TOLERANCE:
        return error(reference)
    variants = [difference(input_, derivative, scale, share) for share in (10.0, 0.1, 0.01)]
    return error(min([(reference, spread), *variants], key=lambda each: each[1])[0])


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
    for each in case.inputs():
        try:
            derivative = each.found()
        except (SceneError, SolverError) as error:
            yield row | _refused(each.name, error)
            continue
        error = compare(each, derivative, scale)
        result = (RIGHT if derivative else NONE) if error <= TOLERANCE else (WRONG if derivative else SILENT)
        reason = "the result does not depend on it" if result == NONE else ""
        yield row | {"input": each.name, "result": result, "error": error, "reason": reason}


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
