"""Planar equilibria against closed forms: observed order at three resolutions, and errors below 1e-4 of the length."""

import numpy as np
import pytest
from convergence import equilibrium, order

import ddg_warp as ddg
from ddg_warp.scenes import post_buckling, roll_up, tip_load
from ddg_warp.solve.equilibrium import stability
from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions


# Tip of a circle of curvature `2 pi turns / L`: (sin a, 1 - cos a) L / a.
@pytest.mark.parametrize(
    ("turns", "edges", "x", "z"),
    [
        (0.25, (40, 80, 160), 0.6366197724, 0.6366197724),
        pytest.param(0.5, (60, 120, 240), 0.0, 0.6366197724, marks=pytest.mark.slow),
        pytest.param(1.0, (100, 200, 400), 0.0, 0.0, marks=pytest.mark.slow),
        pytest.param(2.0, (200, 400, 800), 0.0, 0.0, marks=pytest.mark.slow),
    ],
)
def test_end_couple_rolls_up_a_circle(device, turns, edges, x, z):
    tips, curvatures = [], []
    for n in edges:
        _, state = equilibrium(roll_up.build(turns, n), device)
        points, kappa = state.points(), roll_up.curvature(state)
        tips.append(np.linalg.norm(points[-1] - [x, 0.0, z]))
        curvatures.append(kappa.mean() / (2.0 * np.pi * turns) - 1.0)
        assert np.ptp(kappa) < 1e-6
        assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(1.0, abs=1e-9)
    assert tips[-1] < 1e-4
    assert abs(curvatures[-1]) < 1e-4
    assert order(edges, tips) == pytest.approx(2.0, abs=0.1)
    assert order(edges, curvatures) == pytest.approx(2.0, abs=0.1)


def test_roll_up_in_space_is_planar(device):
    """A spatial couple has no potential; Newton with its tangent still converges to the planar circle."""
    tips = []
    for dimension in (2, 3):
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension, analysis=ddg.Statics(load_steps=8))
        rod = scene.add_rod(roll_up.build(1.0, 40).batches[0].points[0], section=ddg.Stiffness(EA=1e6, EI1=1.0, GJ=1.0))
        scene.clamp_end(rod, "first")
        scene.add_couple(rod, -1, (0.0, -2.0 * np.pi, 0.0))
        tips.append(equilibrium(scene, device, mode="follow")[1].points()[-1])
    np.testing.assert_allclose(tips[1], tips[0], atol=1e-7)


# Elliptic integrals (as in Mattiasson 1981); EA L^2 / EI = 1e8 stands for inextensible.
@pytest.mark.parametrize(
    ("load", "x", "drop", "angle"),
    [
        pytest.param(1.0, 0.9435667637, 0.3017207738, 0.4613519497, marks=pytest.mark.slow),
        pytest.param(5.0, 0.6123716393, 0.7137915236, 1.215368118, marks=pytest.mark.slow),
        (10.0, 0.4450044022, 0.8106090249, 1.430285539),
    ],
)
def test_tip_load_matches_elastica(device, load, x, drop, angle):
    assert tip_load.exact(load) == pytest.approx((x, -drop, angle), abs=1e-9)
    edges = (100, 200, 400)
    tips = np.array([tip_load.tip(equilibrium(tip_load.build(load, n), device)[1]) for n in edges])
    errors = tips - (x, -drop, angle)
    position = np.linalg.norm(errors[:, :2], axis=1)
    assert position[0] < 1e-4  # at 100 edges already
    assert np.abs(errors[0, 2]) < 1e-4
    assert order(edges, position) == pytest.approx(2.0, abs=0.1)
    assert order(edges, errors[:, 2]) == pytest.approx(2.0, abs=0.1)


# Tip and tip angle of the heavy elastica, weight G = w L^3 / EI, by collocation and by a Legendre-Ritz method to 3e-12.
# EA L^2 / EI = 1e8, times ten where the weight pulls hardest.
@pytest.mark.parametrize(
    ("weight", "axial", "edges", "x", "drop", "angle"),
    [
        pytest.param(0.1, 1e8, (20, 40, 80), 0.9999107322, 0.01249843785, 0.01666508519, marks=pytest.mark.slow),
        pytest.param(1.0, 1e8, (25, 50, 100), 0.9912463953, 0.123471402, 0.1651155605, marks=pytest.mark.slow),
        (10.0, 1e8, (50, 100, 200), 0.6563537612, 0.7001997155, 1.052643117),
        (100.0, 1e8, (100, 200, 400), 0.1592233826, 0.9375239354, 1.564107321),
        pytest.param(1000.0, 1e9, (400, 800, 1600), 0.04598645476, 0.9811412693, 1.570796322, marks=pytest.mark.slow),
    ],
)
def test_heavy_cantilever_matches_elastica(device, weight, axial, edges, x, drop, angle):
    errors = []
    for n in edges:
        scene = ddg.Scene(gravity=(0.0, 0.0, -1.0), dimension=2, analysis=ddg.Statics(load_steps=8))
        points = np.zeros((n + 1, 3))
        points[:, 0] = np.linspace(0.0, 1.0, n + 1)
        section = ddg.Stiffness(EA=axial, EI1=1.0, GJ=1.0, mass_per_length=weight)
        scene.clamp_end(scene.add_rod(points, section=section), "first")
        tip_x, tip_z, tip_angle = tip_load.tip(equilibrium(scene, device)[1])
        errors.append((np.hypot(tip_x - x, tip_z + drop), tip_angle - angle))
    position, turn = np.array(errors).T
    assert position[-1] < 1e-4
    assert abs(turn[-1]) < 1e-4
    assert order(edges, position) == pytest.approx(2.0, abs=0.1)


# Elliptic integrals; load [EI/L^2], amplitude [L], angle of the ends [rad]. EA L^2 / EI = 1e9, as P / EA adds to the shortening.
@pytest.mark.parametrize(
    ("shortening", "load", "amplitude", "angle"),
    [
        (0.01, 9.919231635, 0.06346272176, 0.2002088584),
        (0.05, 10.12349265, 0.140110606, 0.4495725424),
        (0.1, 10.39256395, 0.1949243114, 0.6392142862),
        (0.2, 10.98229097, 0.266318588, 0.9140575374),
        (0.3, 11.65303022, 0.314312613, 1.13251432),
        (0.4, 12.42345366, 0.3487125197, 1.323636176),
    ],
)
def test_post_buckling_matches_elastica(device, shortening, load, amplitude, angle):
    reference = (load, amplitude, angle)
    assert post_buckling.exact(shortening) == pytest.approx(reference, rel=1e-8)
    edges = (40, 80, 160)
    runs = [equilibrium(post_buckling.build(shortening, 1e9, n), device) for n in edges]
    errors = np.array([post_buckling.measure(*run) for run in runs]) / reference - 1.0
    assert np.abs(errors[-1, 0]) < 2e-4  # the load
    assert np.abs(errors[-1, 1] * amplitude) < 1e-4
    assert np.abs(errors[-1, 2]) < 1e-4
    for column in errors.T:
        assert order(edges, column) == pytest.approx(2.0, abs=0.1)


# Euler loads in EI / L^2: pi^2, 4 pi^2, pi^2 / 4, and x^2 with tan x = x. EA L^2 / EI = 1e8.
@pytest.mark.parametrize(
    ("first", "last", "load"),
    [
        pytest.param("pinned", "pinned", 9.869604401, marks=pytest.mark.slow),
        ("clamped", "clamped", 39.4784176),
        pytest.param("clamped", "free", 2.4674011, marks=pytest.mark.slow),
        ("clamped", "pinned", 20.19072856),
    ],
)
def test_buckling_loads_are_euler_loads(device, first, last, load):
    edges, measured = (20, 40, 80), []
    for n in edges:
        points = np.zeros((n + 1, 3))
        points[:, 0] = np.linspace(0.0, 1.0, n + 1)
        scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=2)
        rod = scene.add_rod(points, section=ddg.Stiffness(EA=1e8, EI1=1.0, GJ=1.0))
        if first == "clamped":
            scene.clamp_end(rod, "first")
        else:
            scene.fix(rod, [0])
        if last == "clamped":
            scene.clamp_end(rod, "last", components="yz")
        elif last == "pinned":
            scene.fix(rod, [-1], "yz")
        scene.add_force(rod, -1, (-load, 0.0, 0.0))
        model = scene.build(device, "float64")
        solver = Equilibrium(model, StaticsOptions(mode="follow"))

        def compressed(factor, model=model, solver=solver):
            return model, solver.load(model.state(), 1, 0.0, factor)

        measured.append(stability.critical(compressed, 0.8, 1.2) - 1.0)
    assert abs(measured[-1]) < 1e-3
    assert order(edges, measured) == pytest.approx(2.0, abs=0.1)
