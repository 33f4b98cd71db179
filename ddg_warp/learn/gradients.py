"""Gradients of steps and equilibria by every input, against central differences: `ddg-warp gradients`.

Each input is moved along one random direction in all of its entries, in two worlds at once; the loss is a random sum of positions,
velocities and angles after two steps from a state on the way, or of positions and angles in equilibrium, with friction of positions
after two load steps from rest. What a `Simulator` takes is asked of it, as its user does; damping by mass and the length of the steps
of its reverse. Density is all masses and rotary inertia, and held to scenes of another one.
"""

from collections.abc import Iterator

import torch

from ddg_warp.errors import SceneError, SolverError
from ddg_warp.learn.gradient_cases import Case, Input
from ddg_warp.learn.gradient_objects import OBJECTS

RIGHT, NONE, REFUSED, WRONG, SILENT = "right", "none", "refused", "WRONG", "SILENT ZERO"  # results
ANALYSES = ("implicit_euler", "implicit_midpoint", "statics")
TOLERANCE = 1e-5  # relative error of a gradient
SEEN = 1e-4  # of the loss: less than this by a change of an input as large as itself counts as this much
CHANGE = 1e-4  # of the loss, that a difference is taken over


def difference(own: Input, about: float, scale: float, share: float = 1.0) -> tuple[float, float]:
    """The derivative by an input, by differences of fourth order, and how far those of second order are apart.

    Args:
        about: what the derivative should be; scale: size of the loss; share: of the usual change of the input.
    """
    h = share * min(1e-3 * own.size, CHANGE * scale / max(abs(about), 1e-12 * scale / own.size))
    with torch.no_grad():
        at = {x: float(own.loss(x * h)) for x in (2.0, 1.0, -1.0, -2.0)}
    near, far = ((at[x] - at[-x]) / (2.0 * x * h) for x in (1.0, 2.0))
    return (4.0 * near - far) / 3.0, abs(near - far)


def compare(own: Input, found: float, scale: float) -> float:
    """Relative error of a derivative against differences; where these are off, against those that agree best among several."""

    def error(wanted: float) -> float:
        return abs(found - wanted) / max(abs(wanted), SEEN * scale / own.size)

    wanted, apart = difference(own, found, scale)
    if error(wanted) <= TOLERANCE:
        return error(wanted)
    others = [difference(own, found, scale, share) for share in (10.0, 0.1, 0.01)]
    return error(min([(wanted, apart), *others], key=lambda each: each[1])[0])


def table(objects=tuple(OBJECTS), analyses=ANALYSES, device: str = "cpu") -> Iterator[dict]:
    """Rows of object, analysis, input, result (as named above), error and reason."""
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
            found = each.found()
        except (SceneError, SolverError) as error:
            yield row | _refused(each.name, error)
            continue
        error = compare(each, found, scale)
        result = (RIGHT if found else NONE) if error <= TOLERANCE else (WRONG if found else SILENT)
        reason = "the result does not depend on it" if result == NONE else ""
        yield row | {"input": each.name, "result": result, "error": error, "reason": reason}


def _refused(name: str, error: Exception) -> dict:
    return {"input": name, "result": REFUSED, "error": "", "reason": str(error)}


def gathered(rows: list[dict]) -> list[dict]:
    """Rows of one object and analysis with the same result as one, which has their largest error."""
    found: dict[tuple, dict] = {}
    for row in rows:
        key = row["object"], row["analysis"], row["result"], row["reason"]
        if key in found:
            own = found[key]
            own["inputs"] += f", {row['input']}"
            own["error"] = max(own["error"], row["error"])
        else:
            names = ("object", "analysis", "result", "error", "reason")
            found[key] = {name: row[name] for name in names} | {"inputs": row["input"]}
    return list(found.values())
