"""Checks pass within the tolerance and never on NaN."""

import math

import pytest

from ddg_warp.run.check import Check


@pytest.mark.parametrize(
    ("measured", "reference", "tolerance", "relative", "passed"),
    [
        (1.0, 1.0, 0.0, False, True),
        (1.25, 1.0, 0.25, False, True),
        (0.7, 1.0, 0.25, False, False),
        (-5.0, -4.0, 0.25, True, True),
        (-5.0, -4.0, 0.24, True, False),
        (0.0, 0.0, 1.0, True, False),  # an error relative to zero is undefined
        (math.nan, 1.0, math.inf, False, False),
        (1.0, math.nan, math.inf, False, False),
        (math.inf, math.inf, 1.0, False, False),
        (1.0, 1.0, math.nan, False, False),
    ],
)
def test_passed(measured, reference, tolerance, relative, passed):
    assert Check("value", measured, reference, tolerance, relative=relative).passed is passed


def test_as_dict_has_what_the_summary_lists():
    entry = Check("tip [m]", 1.5, 1.0, 0.1, "a formula").as_dict()
    assert entry == {
        "name": "tip [m]",
        "measured": 1.5,
        "reference": 1.0,
        "error": 0.5,
        "tolerance": 0.1,
        "passed": False,
        "source": "a formula",
    }
