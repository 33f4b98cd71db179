"""Snap-through and lateral buckling of arches and frames: limit points and bifurcations at three resolutions, with the order."""

import numpy as np
import pytest
from convergence import order

from ddg_warp.scene.equilibrium_path import StopCriterion
from ddg_warp.scenes import deep_arch, lee_frame, right_angle_frame
from ddg_warp.solve.equilibrium.continuation import Continuation


def path_of(scene, device, stop=None, **options):
    """Return the continuation and path of a scene, solved to the rounding of forces."""
    analysis = scene.analysis
    settings = {name: getattr(analysis, name) for name in ("step", "max_step", "load_scale")}
    model = scene.build(device, "float64")
    continuation = Continuation(model, analysis.watch, floor_factor=1.0, **{**settings, **options})
    return continuation, continuation.trace(stop=stop or analysis.stop)


def relative(values, references) -> np.ndarray:
    """Return relative errors (resolutions, quantities)."""
    return np.array(values) / np.array(references) - 1.0


# Inextensible elastica by collocation, residual 9e-11; 897 in DaDeppo & Schmidt, J. Appl. Mech. 42, 1975. EA R^2 / EI = 1e7.
# Measured: at 40 edges vertex angles reach 25 degrees, and the error of the load is 6 %.
@pytest.mark.slow
def test_limit_load_of_a_deep_arch(device):
    edges, values = (60, 120, 240), []
    for n in edges:
        _, path = path_of(deep_arch.build(n), device)
        (limit,) = path.limit_points
        assert (path.negative[:-1] == 0).all()
        values.append((1000.0 * limit.load, limit.values["drop"], limit.values["shift"]))
    errors = relative(values, (897.3089968, 113.7320631, 61.14146579))
    assert np.abs(errors[-1]).max() < 2e-3
    assert order(edges, errors[:, 0]) == pytest.approx(2.0, abs=0.1)
    assert order(edges, errors[:, 1]) == pytest.approx(2.0, abs=0.1)


# Inextensible elastica by collocation, residual 3e-12; P L^2 / EI = 18.55 at the first limit in Lee, Manuel & Rossow 1968.
# Load [t], v and u of the loaded point [cm] at both limits. EA is 1000 times that of the section.
@pytest.mark.slow
def test_limit_points_of_lee_frame(device):
    edges, values = (20, 40, 80), []
    for n in edges:
        _, path = path_of(lee_frame.build(n), device)
        first, second = path.limit_points
        assert not path.bifurcations
        count = [point.negative for point in path.points if point.kind == "regular"]
        assert set(count) == {0, 1}  # stable up to the first limit point only
        assert (np.diff(count) >= 0).all()
        values.append([p for point in (first, second) for p in (point.load, point.values["v"], point.values["u"])])
    errors = relative(values, (1.855874654, 48.73945421, 26.88685253, -0.9421287454, 58.20048419, 90.21191386))
    assert np.abs(errors[-1]).max() < 2e-3
    for quantity in range(6):
        assert order(edges, errors[:, quantity]) == pytest.approx(2.0, abs=0.1)


# Points of the path before the limit: load [t] and u [cm] at given v [cm]; residual 5e-12.
@pytest.mark.slow
def test_displacement_control_of_lee_frame(device):
    edges, values = (20, 40, 80), []
    for n in edges:
        scene = lee_frame.build(n)
        continuation = Continuation(scene.build(device, "float64"), scene.analysis.watch, floor_factor=1.0)
        path = continuation.control("v", (10.0, 20.0, 30.0, 40.0))
        np.testing.assert_allclose(path.values("v"), (10.0, 20.0, 30.0, 40.0), rtol=1e-11)
        assert not path.negative.any()
        values.append(np.concatenate([path.load, path.values("u")]))
    loads = (0.9644022038, 1.346201687, 1.595529009, 1.780953366)
    rights = (1.712219493, 5.258081932, 10.33771697, 17.56033423)
    errors = relative(values, loads + rights)
    assert np.abs(errors[-1]).max() < 2e-3
    for quantity in range(8):
        assert order(edges, errors[:, quantity]) == pytest.approx(2.0, abs=0.1)


# Second variation of Kirchhoff rods, rigid in the plane, by a spectral Ritz method; with torsion b t^3 G / 3 [N].
# 1.088 in Argyris et al. 1979, Simo & Vu-Quoc 1986.
@pytest.mark.parametrize(("sense", "load"), [pytest.param(1, 1.086757492, marks=pytest.mark.slow), (-1, 0.6802353021)])
def test_lateral_buckling_of_a_right_angle_frame(device, sense, load):
    edges, errors = (10, 20, 40), []
    for n in edges:
        _, path = path_of(right_angle_frame.build(n, sense, 1e4), device)
        (point,) = path.bifurcations
        assert not path.limit_points
        errors.append(point.load / load - 1.0)
        deflection = np.abs(point.mode.reshape(-1, 3)[:, 1]).max()  # the mode leaves the plane, the path does not
        assert deflection > 0.1 * np.abs(point.mode).max()
        assert np.abs(path.values("deflection")).max() < 1e-9
    assert np.abs(errors[-1]) < 1e-3
    assert order(edges, errors) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(("sense", "load"), [(1, 1.086757492), pytest.param(-1, 0.6802353021, marks=pytest.mark.slow)])
def test_finite_in_plane_stiffness_changes_buckling_little(device, sense, load):
    """The load with the in-plane stiffness of a strip of 30 x 0.6 is within 1 % at 10 edges per leg."""
    _, path = path_of(right_angle_frame.build(10, sense), device)
    assert path.bifurcations[0].load == pytest.approx(load, rel=1e-2)


# Past the first bifurcation the frame deflects out of plane at a nearly constant load (Simo & Vu-Quoc 1986, figure 13).
def test_postbuckling_branches_are_stable_and_symmetric(device):
    continuation, path = path_of(right_angle_frame.build(10), device)
    (point,) = path.bifurcations
    sides = []
    for side in (1, -1):
        branch = continuation.switch(point, side=side, stop=StopCriterion(steps=6))
        assert not branch.negative[1:].any()  # stable
        sides.append(branch)
    left, right = (branch.values("deflection") for branch in sides)
    np.testing.assert_allclose(left, -right, atol=1e-5)
    assert abs(left[-1]) > 10.0
    assert (sides[0].load[1:] > point.load).all()
