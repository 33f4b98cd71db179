"""Laws that users write: whether the slope of a law is the derivative of its energy, and its curvature that of the slope."""

from functools import cache

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError

BASES, SIZES = (0.0, 1.0), (1e-2, 0.3, 5.0)  # strains at which laws are looked at: about these, by so much
STEPS = (1e-4, 1e-5)  # of differences, over the size of a strain; a law is refused that agrees with none
TOLERANCE = 1e-3  # of the largest derivative
TRIED = (1.0, 0.3, 0.0, -0.3)  # values of parameters that a law has neither been given nor has a default for


def check_law(where: str, law, strains: int) -> None:
    """Refuse a law whose derivatives are not those of its energy; laws of the package are tested by themselves.

    Args:
        where: named by the refusal.
        law: a `Law`; strains: of how many it is.

    Raises:
        SceneError: names the first derivative that differs, both values and the strain.
    """
    density = law.density
    if getattr(density.laws, "__module__", "").startswith("ddg_warp."):
        return
    values = _values(law, strains)
    for what, parent in (("slope", "energy"), ("curvature", "slope")):
        for strain in _strains(strains):
            if found := _difference(density, what, strain, values):
                given = dict(zip(_names(law, strains), values.tolist(), strict=False))
                raise SceneError(
                    f"{where}: {what} of the law {density.name!r} is {found[0]:.6g} at the strain {strain.tolist()}, and the "
                    f"derivative of its {parent} {found[1]:.6g}, by parameters {given}; correct the {what} or the {parent} "
                    "(`ddg-warp check` compares all derivatives)"
                )


def _names(law, strains: int) -> list[str]:
    return [parameter.name for parameter in law.density.parameters(strains)]


def _values(law, strains: int) -> np.ndarray:
    """Parameters p of a law, with those of the last step if it is lagged: as given, by default, or some that are valid."""
    result, used = [], {}
    for parameter in law.density.parameters(strains):
        at = used[parameter.family] = used.get(parameter.family, -1) + 1
        given = law.values.get(parameter.family, parameter.default)
        given = given[min(at, len(given) - 1)] if isinstance(given, list | tuple) and given else given
        tried = TRIED if given is None else (float(np.ravel(given)[0]),)
        result.append(next((value for value in tried if parameter.valid[1](value)), tried[0]))
    return np.array(result + ([0.1] * strains + [10.0]) * law.density.lagged)


def _strains(count: int) -> list[np.ndarray]:
    """Strains (count,) of which no two components are alike, none zero."""
    along = np.linspace(0.7, -1.0, count) if count > 1 else np.ones(1)
    return [base + size * along for base in BASES for size in SIZES]


def _difference(density, what: str, strain: np.ndarray, values: np.ndarray) -> tuple[float, float] | None:
    """The derivative that a law gives and that by differences, where they differ at a strain by any step; else None."""
    n, size = len(strain), np.abs(strain).max()
    worst = None
    for step in STEPS:
        around = strain + step * size * np.concatenate([np.eye(n), -np.eye(n), np.zeros((1, n))])
        parents, given = (_evaluated(density, part, around, values) for part in _PARTS[what])
        if not (np.isfinite(parents).all() and np.isfinite(given).all()):
            return None  # outside of what the law is about
        differences = (parents[:n] - parents[n:-1]) / (2.0 * step * size)
        given = given[-1]
        if given.ndim < differences.ndim:  # a diagonal
            differences = np.diagonal(differences)
        rounding = 64.0 * np.finfo(float).eps * np.abs(parents).max() / (step * size)
        error = np.abs(given - differences)
        if error.max() <= TOLERANCE * max(np.abs(differences).max(), np.abs(given).max()) + rounding:
            return None
        at = np.unravel_index(int(np.argmax(error)), error.shape)
        worst = worst or (float(given[at]), float(differences[at]))
    return worst


_PARTS = {"slope": (0, 1), "curvature": (1, 2)}  # energy, slope and curvature of a law, by number


def _evaluated(density, part: int, strains: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Energies (m,), slopes (m, n) or curvatures (m, n) or (m, n, n) of a law at strains (m, n), in float64."""
    count = strains.shape[1]
    function = density.laws(wp.float64, count)[part]
    E, P = wp.types.vector(count, wp.float64), wp.types.vector(len(values), wp.float64)
    try:  # as Python, where it can be
        return np.array([np.array(function(E(*strain), P(*values)), float) for strain in strains])
    except (ArithmeticError, AttributeError, RuntimeError, TypeError, ValueError):
        kind = (wp.float64, E, wp.types.matrix((count, count), wp.float64) if density.coupled else E)[part]
        result = wp.zeros(len(strains), dtype=kind, device="cpu")
        given = wp.array(strains, dtype=E, device="cpu"), P(*values)
        wp.launch(_kernel(function, E, P, kind), len(strains), [*given, result], device="cpu")
        return result.numpy()


@cache
def _kernel(function, E, P, kind):
    @wp.kernel(module="unique", enable_backward=False)
    def evaluate(strains: wp.array(dtype=E), values: P, result: wp.array(dtype=kind)):
        i = wp.tid()
        result[i] = function(strains[i], values)

    return evaluate
