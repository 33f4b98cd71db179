"""Every argument of a public call has an effect that something shows, or is refused; the table is in `effects`.

All rows take 25 s of one core.
"""

import inspect
from collections import defaultdict
from functools import cache

import effects_of_solvers  # noqa: F401  (adds its calls)
import numpy as np
import pytest
from effects import CALLS, Change, observed

import ddg_warp as ddg

LONG = {
    ("Stop at limit points", "limit_points"),
    ("Continuation", "tolerance"),
    ("control", "max_cuts"),
}  # more than a second each
ROWS = [
    pytest.param(call, argument, marks=[pytest.mark.slow] * ((call, argument) in LONG))
    for call in CALLS
    for argument in CALLS[call].rows
]
UNLISTED = {"copy"}  # takes the attributes of a scene, as `Scene` does


def change_of(call: str, argument: str) -> Change:
    """The change of an argument of a call."""
    row = CALLS[call].rows[argument]
    return row if isinstance(row, Change) else Change(row)


@cache
def untouched(call: str):
    """What a call shows with the arguments of its base."""
    return observed(CALLS[call], CALLS[call].base)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("call", "argument"), ROWS, ids=str)
def test_effect(call, argument):
    change, made = change_of(call, argument), CALLS[call]
    before = made.base | change.beside | ({} if change.before is None else {argument: change.before})
    with np.errstate(all="ignore"):
        alone = not change.beside and change.before is None
        first = untouched(call) if alone else observed(made, before)
        second = observed(made, before | {argument: change.value})
    assert first != second
    assert (second[0] == "refused") == change.refused, second[1] if second[0] == "refused" else "it is not refused"


def test_every_argument_has_a_row():
    """Of each call that is in the table, every argument of its signature and of the options that it takes."""
    wanted, listed = defaultdict(set), defaultdict(set)
    for call in CALLS.values():
        wanted[call.of] |= set(call.arguments)
        listed[call.of] |= set(call.rows)
    missing = {of.__qualname__: sorted(wanted[of] - listed[of]) for of in wanted if wanted[of] - listed[of]}
    unknown = {of.__qualname__: sorted(listed[of] - wanted[of]) for of in listed if listed[of] - wanted[of]}
    assert not missing
    assert not unknown


def test_every_call_of_a_scene_is_in_the_table():
    """And every class that a user makes: sections, materials, motions, obstacles, drag, analyses."""
    found = {call.of for call in CALLS.values()}
    methods = {name: of for name, of in inspect.getmembers(ddg.Scene, inspect.isfunction) if not name.startswith("_")}
    kinds = {name: getattr(ddg, name) for name in ddg.__all__ if inspect.isclass(getattr(ddg, name))}
    others = {
        "Check",
        "Model",
        "Recorder",
        "SceneError",
        "SceneWarning",
        "SolverError",
        "State",
    }  # made by no user, or tested elsewhere
    assert not [name for name, of in methods.items() if of not in found and name not in UNLISTED]
    assert not [name for name, of in kinds.items() if of not in found and name not in others]
