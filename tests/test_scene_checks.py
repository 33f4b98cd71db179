"""Checks of scenes: failures on wrong results, refused parameters, and named skips of short runs."""

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.run.check import Check, once_reached
from ddg_warp.run.cli import main
from ddg_warp.run.scene_registry import load_scene
from ddg_warp.run.simulate import Result, simulate
from ddg_warp.run.summary import checks_table


def run(name: str, duration=None, **parameters) -> list[Check]:
    """Return the checks of a scene."""
    module = load_scene(name)
    observe = getattr(module, "observe", None)
    scene = module.build(**parameters)
    return module.check(simulate(scene, device="cpu", duration=duration, observe=observe, progress=False))


def test_a_coarse_plate_fails():
    """A plate of 8 cells is 17 % too soft and fails, one of 16 cells is 4 % too soft and passes."""
    (coarse,) = run("plate_square", cells=8)
    assert coarse.error > 0.1 and coarse.failed
    (fine,) = run("plate_square", cells=16)
    assert fine.error < 0.045 and fine.passed


# Parameters at which the loaded or measured node is not at its position, and the words that name them.
REFUSED = {
    "plate_square": ({"cells": 7}, {"cells": 6, "mesh": "equilateral"}),
    "deep_arch": ({"n": 31},),
    "lee_frame": ({"n": 12},),
    "localized_helix": ({"n": 51},),
    "michell_ring": ({"n": 42}, {"n": 4}),
    "post_buckling": ({"n": 31},),
    "whirling": ({"n": 31},),
    "bilayer_strip": ({"cells": 5},),
    "right_angle_frame": ({"sense": 0}, {"sense": 2}),
    "hanging_chain": ({"mode": 4}, {"mode": 0}),
}


@pytest.mark.parametrize("name", REFUSED)
def test_parameters_without_a_meaning_are_refused(name):
    for parameters in REFUSED[name]:
        key, value = next(iter(parameters.items()))
        with pytest.raises(ValueError, match=f"{key} = {value}"):
            load_scene(name).build(**parameters)


@pytest.mark.parametrize("flags", [["tip_load", "--n", "0"], ["roll_up", "--n", "-3"], ["strands", "--count", "-1"]])
def test_parameters_that_break_the_build_are_reported_in_one_line(flags, capsys, tmp_path):
    assert main(["run", *flags, "--device", "cpu", "--out", str(tmp_path)]) == 2
    (message,) = capsys.readouterr().err.splitlines()
    assert message.startswith("ddg-warp: ") and (
        "with n = -3" in message or "1 nodes" in message or "strands: take" in message
    )


# Scene, a duration that is too short [s], and the checks that need more.
SHORT = {
    "cantilever": (0.2, 4),
    "steel_wire": (0.1, None),
    "flying_beam": (0.5, 3),
    "hanging_sheet": (0.1, 3),
    "parachute": (0.1, 3),
}


@pytest.mark.parametrize("name", SHORT)
def test_checks_beyond_the_duration_are_skipped(name):
    duration, count = SHORT[name]
    checks = run(name, duration)
    skipped = [check for check in checks if check.skipped]
    assert skipped and (count is None or len(skipped) == count)
    assert all(check.skipped.startswith("needs ") and check.skipped.endswith(" s") for check in skipped)
    assert not any(check.failed for check in checks)


def test_a_skipped_check_neither_passes_nor_fails():
    check = Check.skip("drift", "needs 2 s")
    assert not check.passed and not check.failed
    assert check.as_dict()["skipped"] == "needs 2 s" and "skipped" not in Check("a", 1.0, 1.0, 0.0).as_dict()
    table = checks_table([check, Check("tip [m]", 1.5, 1.0, 0.1)])
    assert "skipped: needs 2 s" in table and "FAILED" in table and "nan" not in table


def test_once_reached():
    """Times count to a thousandth of a step; in statics the load counts."""
    made = [Check("a", 1.0, 1.0, 0.0)]
    for dt, times, t, reached in (
        (0.1, [0.0, 0.1], 0.1 + 5e-5, True),
        (0.1, [0.0, 0.1], 0.2, False),
        (None, [0.0, 1.0], 1.0, True),
    ):
        result = Result(None, None, None, times=times, dt=dt)
        checks = once_reached(result, t, ["a"], lambda: made)
        assert (checks is made) == reached and [check.name for check in checks] == ["a"]


def test_numbers_without_a_reference_are_skipped():
    (check,) = run("cantilever", 0.02, n=20)
    assert "50 and 100 nodes" in check.skipped
    assert np.isnan(check.measured) and isinstance(check, ddg.Check)


def test_the_precision_of_a_scene_is_that_of_its_models(device):
    """A requested precision comes first; without any, the device decides."""
    usual = "mixed" if wp.get_device(device).is_cuda else "float64"
    for scene_precision, requested, expected in (
        (None, None, usual),
        ("float32", None, "float32"),
        ("mixed", None, "mixed"),
        ("mixed", "float64", "float64"),
    ):
        scene = ddg.Scene(analysis=ddg.Dynamics(precision=scene_precision))
        scene.add_rod(
            [[0.0, 0.0, 0.1 * i] for i in range(4)],
            section=ddg.Circle(0.01),
            material=ddg.Material(young=1e5, density=1e3, poisson=0.5),
        )
        assert scene.build(device, requested).precision == expected
    with pytest.raises(ddg.SceneError, match="Dynamics: precision"):
        ddg.Dynamics(precision="double")


def test_the_tolerance_of_a_scene_is_that_of_its_run(device):
    """A looser tolerance takes fewer iterations; options of the run come first."""
    work, rubber = {}, ddg.Material(young=1e6, density=1000.0, poisson=0.5)
    for rtol, options in ((1e-6, {}), (1e-1, {}), (1e-1, {"rtol": 1e-6})):
        scene = ddg.Scene(analysis=ddg.Dynamics(dt=0.02, duration=0.2, rtol=rtol))
        rod = scene.add_rod([[0.05 * i, 0.0, 0.0] for i in range(21)], section=ddg.Circle(5e-3), material=rubber)
        scene.clamp(rod, edges=[0])
        result = simulate(scene, device=device, options=options, progress=False)
        work[rtol, bool(options)] = result.statistics["newton_iterations"]["mean"]
    assert work[1e-1, False] < work[1e-6, False] == work[1e-1, True]
    with pytest.raises(ddg.SceneError, match="Dynamics: rtol"):
        ddg.Dynamics(rtol=0.0)
