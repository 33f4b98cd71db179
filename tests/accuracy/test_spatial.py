"""Rods bent and twisted in space against boundary value problems and exact helices: observed order at three resolutions."""

import numpy as np
import pytest
from convergence import equilibrium, order
from scipy.optimize import newton

from ddg_warp.scenes import bend_45, helical_spring


# Tip of the 45-degree bend [in], by shooting and by collocation. Inextensible: EA R^2 / EI = 1.2e9; extensible: EA = 1e7 lbf.
@pytest.mark.parametrize(
    ("torsion", "extensible", "load", "tip"),
    [
        pytest.param("polar", False, 300.0, (22.24503474, 58.77968539, 40.18828384), marks=pytest.mark.slow),
        pytest.param("polar", False, 450.0, (18.50846405, 52.23929842, 48.49798262), marks=pytest.mark.slow),
        ("polar", False, 600.0, (15.68507816, 47.1512944, 53.46859844)),
        ("st_venant", False, 300.0, (22.11286663, 58.53649165, 40.47666523)),
        pytest.param("st_venant", False, 450.0, (18.36955748, 51.97044992, 48.69985312), marks=pytest.mark.slow),
        pytest.param("st_venant", False, 600.0, (15.55806009, 46.89277135, 53.60111399), marks=pytest.mark.slow),
        pytest.param("polar", True, 300.0, (22.24528854, 58.7802483, 40.18938842), marks=pytest.mark.slow),
        ("polar", True, 600.0, (15.68535578, 47.15215022, 53.47176295)),
    ],
)
def test_45_degree_bend_tip_converges(device, torsion, extensible, load, tip):
    edges, errors = (32, 64, 128), []
    for n in edges:
        _, state = equilibrium(bend_45.build(load, torsion, extensible, n), device)
        errors.append(state.points()[-1] - tip)
    assert np.all(np.abs(errors[0]) < 1e-3 * np.array(tip))  # at 32 edges already
    assert order(edges, np.linalg.norm(errors, axis=1)) == pytest.approx(2.0, abs=0.1)


# Axial force and moment of the spring, uniform helix; EA L^2 / B = 4e8. The number of coils is the rest value.
@pytest.mark.parametrize(
    ("stretch", "force", "moment"),
    [
        (0.9, -0.01167318525, 0.001043499558),
        (1.1, 0.01183522072, -0.0009352540469),
        (1.5, 0.06119410428, -0.003528030331),
        (2.0, 0.1291750055, -0.003859121097),
        (3.0, 0.3022162361, 0.008478190012),
    ],
)
def test_helical_spring_force_and_moment_with_fixed_ends(device, stretch, force, moment):
    assert helical_spring.exact(stretch, 10.0) == pytest.approx((force, moment), rel=1e-8)
    edges = (400, 800, 1600)
    springs = [equilibrium(helical_spring.build(stretch, 10.0, n), device, mode="follow") for n in edges]
    errors = np.array([helical_spring.measure(*spring) for spring in springs]) - (force, moment)
    assert np.all(np.abs(errors[-1]) < 1e-3 * abs(force))
    assert order(edges, errors[:, 0]) == pytest.approx(2.0, abs=0.1)
    assert order(edges, errors[:, 1]) == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize("curvature", ["tangent", pytest.param("angle", marks=pytest.mark.slow)])
def test_helical_spring_at_rest_is_stress_free(device, curvature):
    spring = equilibrium(helical_spring.build(1.0, 10.0, 400, curvature), device, mode="follow")
    assert helical_spring.measure(*spring) == pytest.approx((0.0, 0.0), abs=1e-10)


# Force, and number of coils at which the axial moment vanishes.
@pytest.mark.parametrize(
    ("stretch", "force", "turns"),
    [
        (0.9, -0.0116067984, 9.989317053),
        pytest.param(1.1, 0.01178717583, 10.00961374, marks=pytest.mark.slow),
        pytest.param(1.5, 0.06110862628, 10.03665349, marks=pytest.mark.slow),
        pytest.param(2.0, 0.1292421346, 10.04082803, marks=pytest.mark.slow),
        pytest.param(3.0, 0.3009346629, 9.90534787, marks=pytest.mark.slow),
    ],
)
def test_helical_spring_force_with_free_rotation(device, stretch, force, turns):
    edges, errors = (400, 800, 1600), []
    for n in edges:

        def wrench(t, n=n):
            return helical_spring.measure(*equilibrium(helical_spring.build(stretch, t, n), device, mode="follow"))

        free = newton(lambda t: wrench(t)[1], turns, x1=turns + 0.01, tol=1e-9)
        errors.append((wrench(free)[0] - force, free - turns))
    errors = np.array(errors)
    assert abs(errors[-1, 0]) < 1e-3 * abs(force)
    assert abs(errors[-1, 1]) < 1e-3
    assert order(edges, errors[:, 0]) == pytest.approx(2.0, abs=0.1)
    assert order(edges, errors[:, 1]) == pytest.approx(2.0, abs=0.1)


def test_helical_spring_constants_converge(device):
    """dF / dH with and without end rotation, from central differences at rest."""
    edges, errors = (400, 800, 1600), []
    for n in edges:

        def wrench(stretch, turns, n=n):
            spring = equilibrium(helical_spring.build(stretch, turns, n), device, mode="follow")
            return np.array(helical_spring.measure(*spring))

        by_height = (wrench(1.002, 10.0) - wrench(0.998, 10.0)) / (0.004 * helical_spring.HEIGHT)
        by_turns = (wrench(1.0, 10.002) - wrench(1.0, 9.998)) / 0.004
        fixed = by_height[0]
        free = fixed - by_turns[0] * by_height[1] / by_turns[1]
        errors.append((fixed / 0.01060667478 - 1.0, free / 0.01055522781 - 1.0))
    errors = np.array(errors)
    assert np.all(np.abs(errors[-1]) < 1e-3)
    assert order(edges, errors[:, 0]) == pytest.approx(2.0, abs=0.1)
    assert order(edges, errors[:, 1]) == pytest.approx(2.0, abs=0.1)
