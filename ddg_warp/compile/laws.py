"""Derivative check of user-defined laws: slope against energy, curvature against slope."""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError

BASES, SIZES = (0.0, 1.0), (1e-2, 0.3, 5.0)  # centres and offsets of trial strains
STEPS = (1e-4, 1e-5)  # Steps of differences, over the size of a strain; one must agree.
TOLERANCE = 1e-3  # Tolerance over the largest derivative.
TRIED = (1.0, 0.3, 0.0, -0.3)  # Values for parameters without value or default.


def check_law(where: str, law, strains: int) -> None:
    """Refuse a law with wrong derivatives; laws of the package have tests of their own.

    Args:
        where: object named in the message.
        law: the `Law`; strains: number of its strains.

    Raises:
        SceneError: names the first derivative that differs, both values and the strain.
    """
    density = law.density
    if getattr(density.laws, "__module__", "").startswith("ddg_warp."):
        return
    values = _values(law, strains)
    for order, parent in (("slope", "energy"), ("curvature", "slope")):
        for strain in _strains(strains):
            if mismatch := _difference(density, order, strain, values):
                named_values = dict(zip(_names(law, strains), values.tolist(), strict=False))
                raise SceneError(
                    f"{where}: {order} of the law {density.name!r} is {mismatch[0]:.6g} at the strain {strain.tolist()}, and the "
                    f"derivative of its {parent} {mismatch[1]:.6g}, by parameters {named_values}; correct the {order} or the {parent} "
                    "(`ddg-warp check` compares all derivatives)"
                )


def _names(law, strains: int) -> list[str]:
    return [parameter.name for parameter in law.density.parameters(strains)]


def _values(law, strains: int) -> np.ndarray:
    """Return parameters p of a law: given, default or trial values. A lagged law also gets a last step."""
    result, used = [], {}
    for parameter in law.density.parameters(strains):
        nth = used[parameter.family] = used.get(parameter.family, -1) + 1
        setting = law.values.get(parameter.family, parameter.default)
        setting = setting[min(nth, len(setting) - 1)] if isinstance(setting, list | tuple) and setting else setting
        tried = TRIED if setting is None else (float(np.ravel(setting)[0]),)
        result.append(next((value for value in tried if parameter.valid[1](value)), tried[0]))
    return np.array(result + ([0.1] * strains + [10.0]) * law.density.lagged)


def _strains(count: int) -> list[np.ndarray]:
    """Return strains (count,) with distinct, nonzero components."""
    along = np.linspace(0.7, -1.0, count) if count > 1 else np.ones(1)
    return [base + size * along for base in BASES for size in SIZES]


def _difference(density, quantity: str, strain: np.ndarray, values: np.ndarray) -> tuple[float, float] | None:
    """Return (derivative of the law, central difference) if they differ for every step size, else None."""
    n, size = len(strain), np.abs(strain).max()
    worst = None
    for step in STEPS:
        around = strain + step * size * np.concatenate([np.eye(n), -np.eye(n), np.zeros((1, n))])
        parents, derivatives = (_evaluated(density, part, around, values) for part in _PARTS[quantity])
        if not (np.isfinite(parents).all() and np.isfinite(derivatives).all()):
            return None  # outside the domain of the law
        differences = (parents[:n] - parents[n:-1]) / (2.0 * step * size)
        derivatives = derivatives[-1]
        if derivatives.ndim < differences.ndim:  # a diagonal
            differences = np.diagonal(differences)
        rounding = 64.0 * np.finfo(float).eps * np.abs(parents).max() / (step * size)
        error = np.abs(derivatives - differences)
        if error.max() <= TOLERANCE * max(np.abs(differences).max(), np.abs(derivatives).max()) + rounding:
            return None
        worst_entry = np.unravel_index(int(np.argmax(error)), error.shape)
        worst = worst or (float(derivatives[worst_entry]), float(differences[worst_entry]))
    return worst


_PARTS = {"slope": (0, 1), "curvature": (1, 2)}  # energy, slope and curvature of a law, by number


def _evaluated(density, part: int, strains: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return energies (m,), slopes (m, n) or curvatures (m, n[, n]) of a law at strains (m, n), in float64."""
    count = strains.shape[1]
    function = density.laws(wp.float64, count)[part]
    E, P = wp.types.vector(count, wp.float64), wp.types.vector(len(values), wp.float64)
    try:  # as Python, where it can be
        return np.array([np.array(function(E(*strain), P(*values)), float) for strain in strains])
    except (ArithmeticError, AttributeError, RuntimeError, TypeError, ValueError):
        kind = (wp.float64, E, wp.types.matrix((count, count), wp.float64) if density.coupled else E)[part]
        result = wp.zeros(len(strains), dtype=kind, device="cpu")
        inputs = wp.array(strains, dtype=E, device="cpu"), P(*values)
        wp.launch(_kernel(function, E, P, kind), len(strains), [*inputs, result], device="cpu")
        return result.numpy()


@cache
def _kernel(function, E, P, kind):
    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(strains: wp.array(dtype=E), values: P, result: wp.array(dtype=kind)):
        i = wp.tid()
        result[i] = function(strains[i], values)

    return evaluate
