"""Every object against every question: each cell works, or is refused by a sentence that names object and remedy.

Every fourth cell is run in one of the variants of worlds and precision; all of them in all variants are slow.
`table.py` prints the table.
"""

import pytest
from objects import OBJECTS
from questions import Variant
from table import QUESTIONS, REFUSED, answer, cells, expected

# A precision needs kernels of its own of whatever a cell touches: a rod stands for the others in mixed precision.
MIXED = ("rod",)
# Every damped term has kernels of its own, too: these are what strain-rate damping is asked of.
DAMPED = ("rod", "rods joined rigidly", "shell, hinge")
# Has kernels of its own beside those of "rods alone and joined", whose every cell it is to answer alike.
BY_ANGLE = "rods by the turning angle"
# What asks for most kernels, or takes most time.
LONG = ("implicit midpoint", "turned clamp", "load", "record")


def _fast(name: str, question: str, worlds: int, precision: str) -> bool:
    """Every fourth cell, of long questions every eighth, each in one variant; of strain-rate damping three.

    All objects but one and all questions are there; long ones with one world, the others with one or several.
    """
    place = list(OBJECTS).index(name) + list(QUESTIONS).index(question)
    variant = (1, 3)[place // 4 % 2], "mixed" if name in MIXED else "float64"
    if question == "strain rate damping":
        return name in DAMPED and (worlds, precision) == (1, "float64")
    here = place % 8 == 0 if question in LONG else place % 4 == 2
    return name != BY_ANGLE and here and variant == (worlds, precision)


@pytest.mark.parametrize(
    ("name", "question", "worlds", "precision"),
    [pytest.param(*cell, marks=() if _fast(*cell) else pytest.mark.slow) for cell in cells()],
)
def test_cell(device, name, question, worlds, precision):
    variant = Variant(device, precision, worlds)
    refused, words = answer(name, question, variant), expected(name, question, variant)
    assert bool(refused) == bool(words), refused or f"it works now, and was refused by a sentence with {words}"
    assert all(word in refused for word in words), refused


def test_refusals_are_of_objects_and_questions_that_exist():
    assert set(REFUSED) <= set(QUESTIONS)
    assert all(set(refused) <= set(OBJECTS) for refused in REFUSED.values())
