"""Every argument of a public call has an observable effect, or is refused; the table is in `effects`.

All rows take 25 s of one core.
"""

import importlib.util
import inspect
from collections import defaultdict
from functools import cache

import effects_of_bodies  # noqa: F401  (adds its calls)
import effects_of_movies  # noqa: F401
import effects_of_solvers  # noqa: F401
import numpy as np
import pytest
from effects import CALLS, Change, observed

import ddg_warp as ddg

if importlib.util.find_spec("mujoco"):
    import effects_of_coupling  # noqa: F401

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
UNLISTED = {"copy"}  # same arguments as `Scene`


def change_of(call: str, argument: str) -> Change:
    """Return the change of an argument of a call."""
    row = CALLS[call].rows[argument]
    return row if isinstance(row, Change) else Change(row)


@cache
def base_observation(call: str):
    """Return the observation of a call with base arguments."""
    return observed(CALLS[call], CALLS[call].base)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("call", "argument"), ROWS, ids=str)
def test_argument_has_an_effect(call, argument):
    change, made = change_of(call, argument), CALLS[call]
    before = made.base | change.beside | ({} if change.before is None else {argument: change.before})
    with np.errstate(all="ignore"):
        is_base = not change.beside and change.before is None
        first = base_observation(call) if is_base else observed(made, before)
        second = observed(made, before | {argument: change.value})
    assert first != second
    assert (second[0] == "refused") == change.refused, second[1] if second[0] == "refused" else "it is not refused"


def test_every_argument_has_a_row():
    """Every argument and option of each call in the table is listed."""
    wanted, listed = defaultdict(set), defaultdict(set)
    for call in CALLS.values():
        wanted[call.of] |= set(call.arguments)
        listed[call.of] |= set(call.rows)
    missing = {
        function.__qualname__: sorted(wanted[function] - listed[function])
        for function in wanted
        if wanted[function] - listed[function]
    }
    unknown = {
        function.__qualname__: sorted(listed[function] - wanted[function])
        for function in listed
        if listed[function] - wanted[function]
    }
    assert not missing
    assert not unknown


def test_every_public_call_is_in_the_table():
    """Every public class is listed, too: sections, materials, motions, obstacles, drag, analyses."""
    pytest.importorskip("torch")  # for `ddg.Simulator`
    listed = {call.of for call in CALLS.values()}
    methods = {
        name: function
        for name, function in inspect.getmembers(ddg.Scene, inspect.isfunction)
        if not name.startswith("_")
    }
    kinds = {name: getattr(ddg, name) for name in ddg.__all__ if inspect.isclass(getattr(ddg, name))}
    untested = {
        "AnimatedMesh",
        "Check",
        "FrameMotion",
        "Model",
        "Recorder",
        "SceneError",
        "SceneWarning",
        "Simulator",
        "SolverError",
        "State",
        "Viewer",
    }  # made by no user, or tested elsewhere
    assert not [name for name, function in methods.items() if function not in listed and name not in UNLISTED]
    assert not [name for name, function in kinds.items() if function not in listed and name not in untested]
