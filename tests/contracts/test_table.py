"""Every object against every question: each cell works, or is refused with an object and a remedy.

Every eighth cell runs in one variant of worlds and precision; all of them in all variants are slow.
`table.py` prints the table.
"""

import pytest
from objects import OBJECTS
from questions import Variant
from table import QUESTIONS, REFUSED, answer, cells, expected

# Each precision compiles separate kernels: a rod represents the others in mixed precision.
MIXED = ("rod",)
# Each damped term compiles separate kernels, too: objects of the question on strain-rate damping.
DAMPED = ("rod", "rods joined rigidly", "shell, hinge")
# Compiles further kernels, and equals `rods alone and joined` in every cell.
BY_ANGLE = "rods by the turning angle"
# Questions with most kernels, or the longest run time.
LONG = ("implicit midpoint", "turned clamp", "load", "record")


def _runs_daily(name: str, question: str, worlds: int, precision: str) -> bool:
    """Return True for every eighth cell (long questions: every 16th) in one variant, and three of strain-rate damping.

    All objects but one and all questions occur; long ones with one world, the others with one or several.
    """
    diagonal = list(OBJECTS).index(name) + list(QUESTIONS).index(question)
    variant = (1, 3)[diagonal // 8 % 2], "mixed" if name in MIXED else "float64"
    if question == "strain rate damping":
        return name in DAMPED and (worlds, precision) == (1, "float64")
    selected = diagonal % 16 == 0 if question in LONG else diagonal % 8 == 2
    return name != BY_ANGLE and selected and variant == (worlds, precision)


@pytest.mark.parametrize(
    ("name", "question", "worlds", "precision"),
    [pytest.param(*cell, marks=() if _runs_daily(*cell) else pytest.mark.slow) for cell in cells()],
)
def test_cell_works_or_is_refused(device, name, question, worlds, precision):
    variant = Variant(device, precision, worlds)
    refused, words = answer(name, question, variant), expected(name, question, variant)
    assert bool(refused) == bool(words), refused or f"it works now, and was refused by a sentence with {words}"
    assert all(word in refused for word in words), refused


def test_refusals_name_existing_objects_and_questions():
    assert set(REFUSED) <= set(QUESTIONS)
    assert all(set(refused) <= set(OBJECTS) for refused in REFUSED.values())
