"""User-defined laws: derivative check, parameters of a term, contact laws from laws of the gap."""

from collections.abc import Callable
from functools import cache

import numpy as np
import warp as wp

from ddg_warp.errors import SceneError
from ddg_warp.kernels.densities import Density
from ddg_warp.kernels.densities.contact import gap_law
from ddg_warp.kernels.terms import ALL, LAWS

BASES, SIZES = (0.0, 1.0), (1e-2, 0.3, 5.0)  # centres and offsets of trial strains
STEPS = (1e-4, 1e-5)  # Steps of differences, over the size of a strain; one must agree.
TOLERANCE = 1e-3  # Tolerance over the largest derivative.
GAPS = (0.05, 0.3, 0.7, 0.95)  # trial gaps of contact laws, over the activation distance
ENDS = 1e-6  # Largest energy and force at the activation distance, over the values at half of it.
TRIED = (1.0, 0.3, 0.0, -0.3)  # Values for parameters without value or default.


def check_law(where: str, law, strains: int, trials: list[np.ndarray] | None = None) -> None:
    """Refuse a law with wrong derivatives; laws of the package have tests of their own.

    Args:
        where: object named in the message.
        law: the `Law`; strains: number of its strains.
        trials: trial strains (strains,); by default of order one.

    Raises:
        SceneError: names the first derivative that differs, both values and the strain.
    """
    density = law.density
    if getattr(density.laws, "__module__", "").startswith("ddg_warp."):
        return
    values = _values(law, strains)
    for order, parent in (("slope", "energy"), ("curvature", "slope")):
        for strain in trials or _strains(strains):
            if mismatch := _difference(density, order, strain, values):
                named_values = dict(zip(_names(law, strains), values.tolist(), strict=False))
                raise SceneError(
                    f"{where}: {order} of the law {density.name!r} is {mismatch[0]:.6g} at the strain {strain.tolist()}, and the "
                    f"derivative of its {parent} {mismatch[1]:.6g}, by parameters {named_values}; correct the {order} or the {parent} "
                    "(`ddg-warp check` compares all derivatives)"
                )


def check_laws(where: str, laws, names) -> None:
    """Refuse laws of terms outside `names`, and laws with wrong derivatives.

    Raises:
        SceneError: names the term.
    """
    for name, law in laws.items():
        if name not in names:
            raise SceneError(f"{where}: it has no term {name!r} to give a law; it has {', '.join(names)}")
        n = len(ALL[name].measure.strains)
        if law.density.strains not in (None, n):
            raise SceneError(f"{where}, {name}: the law {law.density.name!r} is not of {n} strains, as the term is")
        check_law(f"{where}, {name}", law, n)


def bind_law(where: str, term, law, defaults: dict, on_elements: Callable, shape: str) -> dict[str, np.ndarray]:
    """Return the parameters of a term by name.

    Args:
        where: object named in messages.
        law: user's `Law` of the term, or None.
        defaults: values by family from material and rest shape; families that the law does not take are ignored.
        on_elements: (family, value) -> values of the law at elements, which override the defaults.
        shape: shape that values broadcast to, in words.

    Raises:
        SceneError: a value of the wrong shape, missing, or invalid.
    """
    families = {parameter.family for parameter in term.parameters}
    values = {family: value for family, value in defaults.items() if family in families}
    for family, value in law.values.items() if law else ():
        try:
            values[family] = (
                [on_elements(family, v) for v in value]
                if isinstance(value, list | tuple)
                else on_elements(family, value)
            )
        except (TypeError, ValueError):
            raise SceneError(f"{where}: {family} = {value!r}; give numbers that broadcast to {shape}") from None
    try:
        values = term.bind(**values)
    except TypeError as error:
        raise SceneError(f"{where}: law {term.density.name!r}: {error}; give it with Law(density, ...)") from None
    for parameter in term.parameters if law else ():
        rule, holds = parameter.valid
        if not np.all(np.isfinite(values[parameter.name]) & holds(values[parameter.name])):
            raise SceneError(f"{where}: {parameter.name} = {values[parameter.name]}; it is finite and {rule}")
    return values


def contact_law(contact, stiffness: np.ndarray, ranges: np.ndarray, explicit: bool) -> tuple[Density, float]:
    """Return the contact law of the distance, and the fraction of the thickness that motion preserves.

    The fraction is one for laws with infinite energy at zero gap, else zero.

    Args:
        contact: `Contact` with the name of a law of the package, or a user's `Law` of the gap.
        stiffness: of pairs of groups [N/m]; ranges: activation distances of pairs of groups [m].
        explicit: whether the scene gives a stiffness.

    Raises:
        SceneError: a user's law of the wrong form, with wrong derivatives, attractive, not convex, or nonzero at the range.
    """
    if isinstance(contact.law, str):
        return LAWS[contact.law], float(contact.law == "barrier")
    law, density = contact.law, contact.law.density
    where, parameters = f"contact: law {density.name!r}", density.parameters(1)
    names = [parameter.name for parameter in parameters]
    if density.strains not in (None, 1) or density.lagged:
        raise SceneError(f"{where} is no law of one strain, the gap [m]; give one that takes it alone")
    for name in law.values:
        if name in ("stiffness", "range"):
            raise SceneError(f"{where} has a {name} of its own; give contact({name}=...)")
        if name not in names:
            raise SceneError(f"{where}: {name} does not fit; it takes {', '.join(names)}")
    if explicit and "stiffness" not in names:
        raise SceneError(f"{where} takes no stiffness; leave it out, or give the law a parameter of this name")
    min_separation_fraction = 0.0
    for activation in {float(ranges.min()), float(ranges.max())}:
        values = {**law.values, "stiffness": float(stiffness.max()), "range": activation}
        constants = tuple(_constant(where, parameter, values) for parameter in parameters)
        bound = type(law)(density, **dict(zip(names, constants, strict=True)))
        gaps = [np.array([activation * gap]) for gap in GAPS]
        check_law(where, bound, 1, gaps)
        energy, slope, curvature = (
            _evaluated(
                density, order, np.array([*gaps, [0.5 * activation], [activation], [0.0]]), np.array(constants)
            ).reshape(-1)
            for order in range(3)
        )
        for fault, wrong in (("pulls", slope[:4] > 0.0), ("is not convex", curvature[:4] < 0.0)):
            for k in np.flatnonzero(wrong | np.isnan(slope[:4]))[:1]:
                raise SceneError(
                    f"{where} {fault} at a gap of {gaps[k][0]:.3g} m; psi' is to be negative and psi'' positive"
                )
        for quantity, samples in (("energy", energy), ("force", slope)):
            if abs(samples[5]) > ENDS * abs(samples[4]):
                raise SceneError(
                    f"{where} has the {quantity} {abs(samples[5]):.3g} at the range, {activation:.3g} m, beyond which contact does "
                    "not act; let both end there, or give contact(range=...)"
                )
        min_separation_fraction = max(min_separation_fraction, float(np.isposinf(energy[6])))
    fixed = (0.0 if name in ("stiffness", "range") else value for name, value in zip(names, constants, strict=True))
    return gap_law(density, tuple(fixed)), min_separation_fraction


def _constant(where: str, parameter, values: dict) -> float:
    """Return the value of a parameter of a contact law, one number."""
    value = values.get(parameter.name, parameter.default)
    if value is None:
        raise SceneError(f"{where}: {parameter.name} is missing; give it with Law(density, ...)")
    if np.ndim(value):
        raise SceneError(f"{where}: {parameter.name} = {value!r}; of contact it is one number")
    rule, holds = parameter.valid
    if not (np.isfinite(value) and holds(float(value))):
        raise SceneError(f"{where}: {parameter.name} = {value}; it is finite and {rule}")
    return float(value)


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
