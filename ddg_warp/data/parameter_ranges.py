"""Parameter ranges and samples: independent, Latin hypercube, Sobol or grid.

A sample depends only on the seed and its index (in a Latin hypercube, on the number of samples, too), not on the order of ranges or
of execution. Samples are reproducible bit for bit on any machine.
"""

from __future__ import annotations

import itertools
import math
import numbers
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ddg_warp import argument_checks
from ddg_warp.errors import SceneError

DESIGNS = ("random", "latin_hypercube", "sobol", "grid")
GROWING = ("random", "sobol")  # designs in which a larger number of samples keeps the first ones
MOST = 10_000_000  # samples of a sweep
KINDS = {int: "a whole number", float: "a number", bool: "True or False", str: "a text"}
"""Types of parameters, and their names in errors."""


@dataclass(frozen=True)
class Uniform:
    """Range of numbers with uniform probability; on a grid equally spaced, both ends included.

    Raises:
        SceneError: The ends are not finite, not in order, or too far apart.
    """

    low: float
    high: float

    def __post_init__(self):
        _check_ends(self)
        if not math.isfinite(self.high - self.low):
            raise SceneError(f"Uniform({self.low}, {self.high}): the ends are too far apart; give a smaller range")

    def at(self, share: float) -> float:
        """Return the `share`-quantile."""
        return self.low + share * (self.high - self.low)


@dataclass(frozen=True)
class LogUniform:
    """Range of positive numbers with log-uniform probability; on a grid a geometric series.

    Raises:
        SceneError: The ends are not positive and finite, not in order, or too far apart.
    """

    low: float
    high: float

    def __post_init__(self):
        argument_checks.positive("LogUniform: low", self.low)
        _check_ends(self)
        if self.high > self.low * 1e300:
            raise SceneError(f"LogUniform({self.low}, {self.high}): the ends are too far apart; give a smaller range")

    def at(self, share: float) -> float:
        """Return the `share`-quantile."""
        return min(self.high, self.low * (self.high / self.low) ** share)


@dataclass(frozen=True)
class Choice:
    """One of several values with equal probability, such as `Choice([10, 20, 40])` or `Choice(range(5, 50))`.

    Raises:
        SceneError: There is no value, values have no order, or one cannot be stored in files.
    """

    values: Sequence

    def __post_init__(self):
        ordered = np.iterable(self.values) and not isinstance(self.values, str | bytes | Mapping | set | frozenset)
        values = list(self.values) if ordered else []
        if not values:
            raise SceneError(f"Choice({self.values!r}): give a list of values, one at least")
        object.__setattr__(self, "values", [storable(f"Choice: value {k}", each) for k, each in enumerate(values)])

    def at(self, share: float):
        """Return the `share`-quantile, in the order of values."""
        return self.values[min(int(share * len(self.values)), len(self.values) - 1)]


Range = Uniform | LogUniform | Choice


def draw(ranges: Mapping[str, object], samples: int, design: str = "random", seed: int = 0) -> list[dict]:
    """Draw values of all parameters for every sample.

    Args:
        ranges: Range of each parameter by name; anything else is a value of all samples.
        samples: Number of samples; with design "grid" the number along each range, of which the product is taken. A `Choice` gives
            all values to a grid.
        design: "random", "latin_hypercube", "sobol" or "grid".
        seed: Seed of the samples; unused on a grid.

    Raises:
        SceneError: Ranges are no mapping of names, there are no samples or more than `MOST`, or there is no such design.
    """
    samples = argument_checks.count("samples", samples)
    argument_checks.count("seed", seed, 0)
    argument_checks.choice("design", design, DESIGNS)
    check_names(ranges)
    shared = {
        name: storable(f"ranges: {name}", value) for name, value in ranges.items() if not isinstance(value, Range)
    }
    names = sorted(ranges.keys() - shared.keys())
    levels = [_levels(ranges[name], samples) for name in names] if design == "grid" and samples <= MOST else []
    number = math.prod(map(len, levels)) if levels else samples
    if number > MOST:
        raise SceneError(
            f"samples = {samples}: these are {number} samples, at most {MOST}; give fewer, or fewer ranges"
        )
    if design == "grid":
        return [shared | dict(zip(names, values, strict=True)) for values in itertools.product(*levels)]
    shares = _fractions(len(names), samples, design, seed)
    return [shared | {name: ranges[name].at(u) for name, u in zip(names, row, strict=True)} for row in shares]


def seed_of(seed: int, index: int) -> int:
    """Return a 32-bit seed for random numbers within a sample, independent of the draw of the sample.

    Raises:
        SceneError: The arguments are not nonnegative integers.
    """
    seed, index = argument_checks.count("seed_of: seed", seed, 0), argument_checks.count("seed_of: index", index, 0)
    return int(np.random.SeedSequence([seed, index], spawn_key=(1,)).generate_state(1)[0])


def parsed(text: str, kind: type | None = None) -> Range:
    """Return a range from the command line: `1:2`, `1e-3:1e-1:log`, or values `10,20,40`.

    Args:
        text: The range.
        kind: Type of the parameter, if known; values of a `str` are texts.

    Raises:
        SceneError: The text is no range, or the ends are no numbers.
    """
    if not isinstance(text, str):
        raise SceneError(f"range {text!r}: give a text, LOW:HIGH, or LOW:HIGH:log, or values A,B,C")
    if kind is str:
        return Choice([value.strip() for value in text.split(",")])
    if ":" in text:
        low, high, *kind = text.split(":")
        if kind not in ([], ["log"]):
            raise SceneError(f"range {text!r}: it is LOW:HIGH, or LOW:HIGH:log, or values A,B,C")
        ends = (_value(low), _value(high))
        return LogUniform(*ends) if kind else Uniform(*ends)
    return Choice([_value(value) for value in text.split(",")])


def plain_value(value):
    """Return a value without NumPy types, for files and function arguments."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def storable(label: str, value):
    """Return a value without NumPy that JSON can store: a number, text, truth value, None, or lists and dicts of values.

    Raises:
        SceneError: The value is none of these; names `label`.
    """
    value = plain_value(value)
    if value is None or isinstance(value, str | int) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if isinstance(value, list | tuple):
        return type(value)(storable(f"{label}[{k}]", each) for k, each in enumerate(value))
    if isinstance(value, Mapping) and all(isinstance(name, str) for name in value):
        return {name: storable(f"{label}[{name!r}]", each) for name, each in value.items()}
    raise SceneError(
        f"{label} is {value!r:.60}; give a finite number, a text, True, False, None, or lists and dicts of them"
    )


def check_names(ranges) -> None:
    """Refuse ranges that are no mapping of names.

    Raises:
        SceneError: names the argument.
    """
    if not isinstance(ranges, Mapping):
        raise SceneError(f"ranges = {ranges!r:.60}; give a dict of ranges by the names of parameters")
    for name in ranges:
        if not (isinstance(name, str) and name.isidentifier()):
            raise SceneError(f"ranges: {name!r} is no name of a parameter; give a text such as 'load'")


def check_kind(name: str, range_, kind: type) -> None:
    """Refuse a range, or a common value, with values of another type than the parameter.

    Args:
        name: Name of the parameter.
        range_: Its range or value.
        kind: Its type; checked if in `KINDS`.

    Raises:
        SceneError: names parameter and value.
    """
    if not isinstance(kind, type) or kind not in KINDS:
        return
    if isinstance(range_, Uniform | LogUniform):
        if kind is int:
            raise SceneError(
                f"ranges: {name} is a whole number; give Choice(range(LOW, HIGH + 1)), or a list of values"
            )
        if kind is not float:
            raise SceneError(f"ranges: {name} is {KINDS[kind]}; give a list of values, Choice([...])")
        return
    fitting = {int: numbers.Integral, float: numbers.Real}.get(kind, kind)
    for value in range_.values if isinstance(range_, Choice) else [plain_value(range_)]:
        if not isinstance(value, fitting) or (isinstance(value, bool) and kind is not bool):
            raise SceneError(f"ranges: {name} is {KINDS[kind]}, and {value!r} is none; correct the values of {name}")


def _fractions(columns: int, samples: int, design: str, seed: int) -> list[list[float]]:
    """Return points of the unit cube, (samples, columns)."""
    if not columns:
        return [[] for _ in range(samples)]
    if design == "random":
        return [np.random.default_rng([seed, index]).random(columns).tolist() for index in range(samples)]
    from scipy.stats import qmc

    sampler = {"latin_hypercube": qmc.LatinHypercube, "sobol": qmc.Sobol}[design](
        columns, rng=np.random.default_rng(seed)
    )
    if design == "sobol":  # balanced for powers of two; more points extend the sequence
        return sampler.random_base2(math.ceil(math.log2(samples)))[:samples].tolist()
    return sampler.random(samples).tolist()


def _levels(values: Range, count: int) -> list:
    """Return the values of a range on a grid."""
    if isinstance(values, Choice):
        return list(values.values)
    return [values.at(share) for share in (np.linspace(0.0, 1.0, count).tolist() if count > 1 else [0.5])]


def _check_ends(range_) -> None:
    """Refuse ends that are no finite numbers or not in order, and convert them from NumPy."""
    kind = type(range_).__name__
    low, high = (argument_checks.number(f"{kind}: {name}", getattr(range_, name)) for name in ("low", "high"))
    if low > high:
        raise SceneError(f"{kind}({low}, {high}): the low end comes first")
    for name in ("low", "high"):
        object.__setattr__(range_, name, plain_value(getattr(range_, name)))


def _value(text: str):
    """Return an integer, a number, a truth value, or the text itself."""
    for kind in (int, float, {"true": True, "false": False}.__getitem__):
        try:
            return kind(text.strip())
        except (ValueError, KeyError):
            pass
    return text.strip()
