"""Samples over ranges: within them, and the same bit by bit however they are drawn."""

import numpy as np
import pytest

from ddg_warp.data.parameter_ranges import DESIGNS, GROWING, Choice, LogUniform, Uniform, draw, parsed, seed_of
from ddg_warp.errors import SceneError

RANGES = {"b": Uniform(-1.0, 3.0), "a": LogUniform(1e-3, 1e2), "n": Choice(range(5, 8)), "c": 4.0}


@pytest.mark.parametrize("design", DESIGNS)
def test_samples_lie_in_their_ranges(design):
    samples = draw(RANGES, 3 if design == "grid" else 64, design, seed=2)
    assert all(-1.0 <= sample["b"] <= 3.0 and 1e-3 <= sample["a"] <= 1e2 and sample["c"] == 4.0 for sample in samples)
    assert {sample["n"] for sample in samples} == {5, 6, 7}
    # Of a range of five decades, two lie below 0.1; of draws spread evenly, two fifths.
    below = np.mean([sample["a"] < 0.1 for sample in samples])
    assert below == pytest.approx(1 / 3 if design == "grid" else 0.4, abs=0.15)
    assert all(type(value) in (int, float) for sample in samples for value in sample.values())


@pytest.mark.parametrize("design", DESIGNS)
def test_the_order_of_ranges_means_nothing(design):
    assert draw(dict(reversed(RANGES.items())), 4, design, 7) == draw(RANGES, 4, design, 7)


@pytest.mark.parametrize("design", GROWING)
def test_more_samples_begin_with_the_same_ones(design):
    assert draw(RANGES, 100, design, 3)[:10] == draw(RANGES, 10, design, 3)
    assert draw(RANGES, 10, design, 3) != draw(RANGES, 10, design, 4)


def test_each_tenth_of_a_range_has_its_sample_of_a_latin_hypercube():
    samples = draw({"x": Uniform(0.0, 1.0), "y": Uniform(0.0, 1.0)}, 10, "latin_hypercube")
    for name in "xy":
        assert sorted(int(10 * sample[name]) for sample in samples) == list(range(10))


def test_a_grid_is_the_product_of_its_levels_ends_included():
    samples = draw({"x": Uniform(0.0, 1.0), "y": LogUniform(1e-2, 1.0), "k": Choice(["s", "t"])}, 3, "grid")
    assert len(samples) == 18
    assert sorted({sample["x"] for sample in samples}) == [0.0, 0.5, 1.0]
    assert sorted({sample["y"] for sample in samples}) == pytest.approx([0.01, 0.1, 1.0], rel=1e-12)
    assert draw({"x": Uniform(0.0, 1.0)}, 1, "grid") == [{"x": 0.5}]


def test_shared_values_alone_are_samples_too():
    assert draw({"n": 3, "v": np.float64(2.0)}, 2) == [{"n": 3, "v": 2.0}] * 2


def test_seeds_of_samples_differ_and_stay():
    seeds = [seed_of(1, index) for index in range(1000)]
    assert len(set(seeds)) == 1000
    assert max(seeds) < 2**32
    assert seeds == [seed_of(1, index) for index in range(1000)]
    assert seed_of(2, 0) != seeds[0]


def test_ranges_of_the_command_line():
    assert parsed("1:2") == Uniform(1, 2)
    assert parsed("1e-3:1:log") == LogUniform(1e-3, 1)
    assert parsed("10, 20").values == [10, 20]
    assert parsed("0.5,soft,true").values == [0.5, "soft", True]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Uniform(2.0, 1.0), "low end"),
        (lambda: Uniform(0.0, np.inf), "high"),
        (lambda: LogUniform(0.0, 1.0), "positive"),
        (lambda: Choice([]), "one at least"),
        (lambda: Choice("abc"), "list of values"),
        (lambda: draw(RANGES, 0), "samples"),
        (lambda: draw(RANGES, 4, "magic"), "design"),
        (lambda: draw(RANGES, 4, seed=-1), "seed"),
        (lambda: parsed("1:2:cubic"), "LOW:HIGH:log"),
        (lambda: parsed("a:b"), "low"),
    ],
)
def test_mistakes_are_named(make, said):
    with pytest.raises(SceneError, match=said):
        make()


def test_values_of_a_choice_come_from_any_sequence_in_order():
    for values in (range(3), np.arange(3), (k for k in range(3)), (np.int64(0), 1, 2)):
        choice = Choice(values)
        assert choice.values == [0, 1, 2]
        assert all(type(value) is int for value in choice.values)


def test_values_of_a_text_stay_texts():
    assert parsed("1,2", str).values == ["1", "2"]
    assert parsed("1:2", str).values == ["1:2"]
