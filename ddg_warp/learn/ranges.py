"""Ranges of parameters, and samples from them: independent, by Latin hypercubes, by Sobol's sequence or on a grid.

A sample depends on the seed and its index alone (in a Latin hypercube, on their number, too), whatever the order of the ranges
and of the work, so that samples are the same bit by bit wherever and whenever they are drawn.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ddg_warp import arguments
from ddg_warp.errors import SceneError

DESIGNS = ("random", "latin_hypercube", "sobol", "grid")
GROWING = ("random", "sobol")  # designs whose first samples stay when there are to be more


@dataclass(frozen=True)
class Uniform:
    """Numbers between two, all equally likely; on a grid equally spaced, both ends included.

    Raises:
        SceneError: They are not finite, or not in order.
    """

    low: float
    high: float

    def __post_init__(self):
        _check_ends(self, self.low, self.high)

    def at(self, share: float) -> float:
        """The number below which a share of them lies."""
        return self.low + share * (self.high - self.low)


@dataclass(frozen=True)
class LogUniform:
    """Positive numbers between two, whose logarithms are equally likely; on a grid in a geometric series.

    Raises:
        SceneError: They are not positive and finite, or not in order.
    """

    low: float
    high: float

    def __post_init__(self):
        arguments.positive(f"{type(self).__name__}: low", self.low)
        _check_ends(self, self.low, self.high)

    def at(self, share: float) -> float:
        """The number below which a share of them lies."""
        return min(self.high, self.low * (self.high / self.low) ** share)


@dataclass(frozen=True)
class Choice:
    """One of several values, all equally likely, such as `Choice([10, 20, 40])` or `Choice(range(5, 50))`.

    Raises:
        SceneError: There is none.
    """

    values: Sequence

    def __post_init__(self):
        if isinstance(self.values, str) or not np.iterable(self.values) or not list(self.values):
            raise SceneError(f"Choice({self.values!r}): give a list of values, one at least")
        object.__setattr__(self, "values", [plain_value(value) for value in self.values])

    def at(self, share: float):
        """The value below which a share of them lies, in their order."""
        return self.values[min(int(share * len(self.values)), len(self.values) - 1)]


Range = Uniform | LogUniform | Choice


def draw(ranges: Mapping[str, object], samples: int, design: str = "random", seed: int = 0) -> list[dict]:
    """Values of all parameters, sample after sample.

    Args:
        ranges: Range of each parameter by name; anything else is a value that all samples share.
        samples: How many; with design "grid" how many along each range, of which the product is taken. A `Choice` gives all its values
            to a grid.
        design: "random", "latin_hypercube", "sobol" or "grid".
        seed: What they are drawn with; a grid has no use for it.

    Raises:
        SceneError: There are no samples, or there is no such design.
    """
    arguments.count("samples", samples)
    arguments.count("seed", seed, 0)
    arguments.choice("design", design, DESIGNS)
    shared = {name: plain_value(value) for name, value in ranges.items() if not isinstance(value, Range)}
    names = sorted(ranges.keys() - shared.keys())
    if design == "grid":
        levels = [_levels(ranges[name], samples) for name in names]
        return [shared | dict(zip(names, values, strict=True)) for values in itertools.product(*levels)]
    shares = _shares(len(names), samples, design, seed)
    return [shared | {name: ranges[name].at(u) for name, u in zip(names, row, strict=True)} for row in shares]


def seed_of(seed: int, index: int) -> int:
    """A seed of 32 bits for the random numbers inside of a sample, independent of those that the sample itself was drawn with."""
    return int(np.random.SeedSequence([seed, index], spawn_key=(1,)).generate_state(1)[0])


def parsed(text: str) -> Range:
    """A range from the command line: `1:2`, `1e-3:1e-1:log`, or values `10,20,40`.

    Raises:
        SceneError: The ends of a range are no numbers.
    """
    if ":" in text:
        low, high, *kind = text.split(":")
        if kind not in ([], ["log"]):
            raise SceneError(f"range {text!r}: it is LOW:HIGH, or LOW:HIGH:log, or values A,B,C")
        ends = (_value(low), _value(high))
        return LogUniform(*ends) if kind else Uniform(*ends)
    return Choice([_value(value) for value in text.split(",")])


def plain_value(value):
    """A value without NumPy, as it is kept in files and given to functions."""
    return value.tolist() if isinstance(value, np.generic | np.ndarray) else value


def _shares(columns: int, samples: int, design: str, seed: int) -> list[list[float]]:
    """Points of the unit cube, (samples, columns)."""
    if not columns:
        return [[] for _ in range(samples)]
    if design == "random":
        return [np.random.default_rng([seed, index]).random(columns).tolist() for index in range(samples)]
    from scipy.stats import qmc

    sampler = {"latin_hypercube": qmc.LatinHypercube, "sobol": qmc.Sobol}[design](
        columns, rng=np.random.default_rng(seed)
    )
    if design == "sobol":  # a power of two of them is balanced; the first of more points are the same
        return sampler.random_base2(math.ceil(math.log2(samples)))[:samples].tolist()
    return sampler.random(samples).tolist()


def _levels(values: Range, count: int) -> list:
    """The values of a range on a grid."""
    if isinstance(values, Choice):
        return list(values.values)
    return [values.at(share) for share in (np.linspace(0.0, 1.0, count).tolist() if count > 1 else [0.5])]


def _check_ends(range_, low, high) -> None:
    what = type(range_).__name__
    if not arguments.number(f"{what}: low", low) <= arguments.number(f"{what}: high", high):
        raise SceneError(f"{what}({low}, {high}): the low end comes first")


def _value(text: str):
    """A whole number, a number, a truth value, or the text itself."""
    for kind in (int, float, {"true": True, "false": False}.__getitem__):
        try:
            return kind(text.strip())
        except (ValueError, KeyError):
            pass
    return text.strip()
