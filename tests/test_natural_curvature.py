"""Bending and twist directions of positive natural curvatures, as documented by `Scene.add_rods`."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.solve.equilibrium import statics

SECTION = ddg.Stiffness(EA=1e6, EI1=1.0, EI2=2.0, GJ=1.5)
X, Y, Z = np.eye(3)
RATE = 0.8  # 1/m


def at_rest(device, natural, dimension: int = 3, director=Y, joined: bool = False):
    """Return the relaxed state of a rod of length 1 along x, clamped at its first end, with a natural shape."""
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0), dimension=dimension)
    options = {"section": SECTION, "natural": natural, "director": director}
    points = np.linspace(0.0 * X, X, 33)
    if joined:
        rods = [scene.add_rod(half, **options) for half in (points[:17], points[16:])]
        scene.join([(rods[0], -1), (rods[1], 0)])
    else:
        scene.add_rod(points, **options)
    scene.clamp_end(0)
    return statics.solve(scene.build(device, "float64"), load_steps=2)


# The tip of an arc of length 1 and curvature k is at sin k / k along and (1 - cos k) / k across.
@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
@pytest.mark.parametrize(("natural", "towards"), [((RATE, 0.0, 0.0), Y), ((0.0, RATE, 0.0), np.cross(X, Y))])
def test_curvature_bends_towards_its_director(device, natural, towards, joined):
    """Positive curvature 1 bends towards the first director, 2 towards the second, tangent x first."""
    tip = at_rest(device, natural, joined=joined).points()[-1]
    np.testing.assert_allclose(tip, (np.sin(RATE) * X + (1.0 - np.cos(RATE)) * towards) / RATE, atol=1e-3)


@pytest.mark.parametrize("joined", [False, True], ids=["alone", "joined"])
def test_twist_rotates_directors_right_handed(device, joined):
    """Directors rotate from y towards z about a tangent along x."""
    directors = at_rest(device, (0.0, 0.0, RATE), joined=joined).directors()
    middle = RATE * (np.arange(32) + 0.5) / 32
    np.testing.assert_allclose(directors, np.outer(np.cos(middle), Y) + np.outer(np.sin(middle), Z), atol=1e-6)


def test_planar_curvature_bends_x_towards_z(device):
    tip = at_rest(device, (np.full(31, RATE),), dimension=2, director=None).points()[-1]
    np.testing.assert_allclose(tip, (np.sin(RATE) * X + (1.0 - np.cos(RATE)) * Z) / RATE, atol=1e-3)


@pytest.mark.parametrize("closed", [False, True], ids=["open", "closed"])
@pytest.mark.parametrize(
    ("dimension", "curvature"),
    [(3, "tangent"), (2, "tangent"), *(pytest.param(d, "angle", marks=pytest.mark.slow) for d in (2, 3))],
)
def test_natural_shape_is_free_of_stress(device, dimension, curvature, closed):
    """The natural shape is bent and twisted at random; stresses of unit strains would be of order one."""
    random, angle = np.random.default_rng(5), np.linspace(0.0, 2.0 * np.pi, 7)[:-1, None]
    points = np.concatenate([np.cos(angle), np.sin(angle), np.sin(angle)], -1) + 0.1 * random.normal(size=(6, 3))
    if dimension == 2:
        points[:, 1] = 0.0
    scene = ddg.Scene(dimension=dimension)
    section = ddg.Stiffness(EA=2.0, EI1=0.9, EI2=0.7 if dimension == 3 else 0.9, GJ=0.8)
    scene.add_rod(points, section=section, closed=closed, natural="shape", curvature=curvature)
    model = scene.build(device, "float64")
    for stress in model.stresses(model.state()).values():
        np.testing.assert_allclose(np.concatenate([np.ravel(values) for values in stress]), 0.0, atol=1e-13)
