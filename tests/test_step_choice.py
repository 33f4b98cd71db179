"""Step and rtol from a requested error: the search on known ends, and runs of rods and sheets against converged references."""

from functools import cache

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.geometry import meshes
from ddg_warp.run.simulate import simulate
from ddg_warp.run.step_choice import search
from ddg_warp.run.summary import summary

SOFT = ddg.Material(young=1e6, density=1000.0, poisson=0.5)
DT, DURATION = 0.01, 0.06
SCHEMES = {"implicit_euler": 1, "implicit_midpoint": 2}


def ends(order: int, factor: float, solve: float = 0.0):
    """Return ends of runs with the error factor 2^(-order halvings) + solve rtol."""
    return lambda halvings, rtol: np.array([[factor * 2.0 ** (-order * halvings) + solve * rtol, 0.0, 0.0]])


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("factor", [1e-5, 1e-3, 1e-1])
def test_search_takes_the_longest_step(order, factor):
    halvings, rtol, (steps_error, solves_error) = search(ends(order, factor, 1e-2), 1e-3, order)
    error = factor * 2.0 ** (-order * halvings)
    assert error <= steps_error <= 1.25 * error + 1e-12
    assert steps_error <= 0.9e-3
    assert halvings == 0 or 2.0**order * error * 1.25 > 0.9e-3
    assert (rtol, solves_error) == (1e-2, pytest.approx(1e-4, rel=1e-3))


def test_search_tightens_rtol():
    assert search(ends(1, 1e-3, 1.0), 1e-3, 1)[1] == 1e-4


@pytest.mark.parametrize(
    ("end_of", "words"),
    [
        (lambda halvings, rtol: np.array([[(-1.0) ** halvings, 0.0, 0.0]]), "chaos"),
        (ends(1, 1e2), "steps shorter than dt / 2048"),
        (ends(1, 1e-4, 1e3), "rtol below 1e-06"),
    ],
)
def test_search_refuses(end_of, words):
    with pytest.raises(ddg.SolverError, match=words) as refused:
        search(end_of, 1e-3, 1)
    assert refused.value.outcome == "error_not_reached"


def test_rest_takes_the_longest_step():
    assert search(lambda halvings, rtol: np.zeros((2, 3)), 1e-6, 2) == (0, 1e-2, (0.0, 0.0))


def cantilever(**analysis) -> ddg.Scene:
    scene = ddg.Scene(analysis=ddg.Dynamics(DT, DURATION, **analysis))
    points = np.linspace([0.0, 0.0, 0.0], [0.2, 0.0, 0.0], 9)
    rod = scene.add_rod(points, natural="straight", section=ddg.Circle(2e-3), material=SOFT)
    scene.clamp(rod, edges=[0])
    return scene


def sheet(**analysis) -> ddg.Scene:
    scene = ddg.Scene(analysis=ddg.Dynamics(DT, DURATION, **analysis))
    shell = scene.add_shell(*meshes.rectangle(4, 4, (0.2, 0.2)), thickness=1e-3, material=SOFT, bending="hinge")
    scene.hold(shell, [0, 4])
    return scene


@cache
def reference(build, device: str) -> np.ndarray:
    """Return the nodes at the end by the midpoint rule, extrapolated from steps of dt / 32 and dt / 64."""
    coarse, fine = (
        simulate(
            build(scheme="implicit_midpoint", rtol=1e-9),
            device=device,
            precision="float64",
            dt=DT / division,
            progress=False,
        ).state.points()
        for division in (32, 64)
    )
    assert np.abs(fine - coarse).max() < 1e-5
    return fine + (fine - coarse) / 3.0


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("build", [cantilever, sheet])
def test_error_is_within_the_requested(device, build, scheme):
    """Errors at the end are within the requested and near the estimate; steps shorten by the order of the scheme."""
    halvings = []
    for error in (1e-3, 1e-4):
        result = simulate(build(scheme=scheme, error=error), device=device, precision="float64", progress=False)
        choice = result.choice
        assert not result.failure
        assert len(result.times) == 1 + round(DURATION / DT)
        assert result.state.time == pytest.approx(DURATION)
        off = np.linalg.norm(result.state.points() - reference(build, device), axis=-1).max()
        assert off <= error
        assert choice.steps_error + choice.solves_error <= error
        assert 0.6 * choice.steps_error <= off <= 1.1 * (choice.steps_error + choice.solves_error)
        assert choice.step == DT / 2**choice.halvings
        halvings.append(choice.halvings)
    assert abs(halvings[1] - halvings[0] - np.log2(10.0) / SCHEMES[scheme]) < 1.0


def test_run_is_that_of_the_chosen_step_and_rtol(device):
    """Summary and line state the choice; a run with dt and rtol of the choice ends equally, to the bit."""
    result = simulate(cantilever(error=1e-3), device=device, progress=False)
    choice = result.choice
    assert choice.halvings > 0
    again = simulate(cantilever(rtol=choice.rtol), device=device, dt=choice.step, progress=False)
    np.testing.assert_array_equal(result.state.points(), again.state.points())
    entry = summary("cantilever", {}, result, [])["choice"]
    assert (entry["error"], entry["step"], entry["rtol"]) == (1e-3, choice.step, choice.rtol)
    assert f"steps of {choice.step:g} s, rtol {choice.rtol:g}" in choice.line()
    assert "choice" not in summary("cantilever", {}, again, [])


def test_unreachable_error_ends_the_run(device, tmp_path):
    result = simulate(cantilever(error=1e-9), device=device, out=tmp_path / "run", progress=False)
    assert result.outcome == "error_not_reached"
    assert result.choice is None
