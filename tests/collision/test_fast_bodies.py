"""Thick bodies that pass each other within a step, apart at the start and at the end."""

import numpy as np
import pytest

import ddg_warp as ddg

RADIUS, THICK, DT = 2e-3, 0.02, 0.01
SOFT = ddg.Material(young=1e6, density=1000.0)


def passing_body(shape: str, offset: float) -> ddg.Scene:
    """Return a rod along z and a body that passes along x by five widths in a step.

    `offset` is the distance of the centrelines along y [m].
    """
    scene = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    line = np.linspace((0.0, 0.0, -0.05), (0.0, 0.0, 0.05), 11)
    scene.add_rod(line, section=ddg.Circle(RADIUS), material=SOFT)
    motion, start = ddg.Motion(translation=lambda t: (0.1 * t / DT, 0.0, 0.0)), np.array([-0.05, offset, 0.0])
    end = start + [0.0, 0.1, 0.0]
    if shape == "ball":
        scene.add_obstacle(ddg.Sphere(tuple(start), THICK), motion=motion)
    elif shape == "capsule":
        scene.add_obstacle(ddg.Capsule(tuple(start), tuple(end), THICK), motion=motion)
    else:
        body = scene.add_rod(np.linspace(start, end, 5), section=ddg.Circle(THICK), material=SOFT)
        scene.fix(body, np.arange(5), motion=motion)
    scene.contact(stiffness=1e4)
    return scene


@pytest.mark.parametrize("shape", ["ball", "capsule", "rod"])
def test_surfaces_collide_where_centrelines_pass(device, shape):
    """Surfaces collide where centrelines pass at less than the thickness, in decoupled steps, too."""
    for off in (0.98 * THICK, 1.2 * THICK + RADIUS):
        model, ends = passing_body(shape, off).build(device=device), []
        for whole in (False, True):
            integrator = ddg.Integrator(model)
            if whole:
                integrator.step_whole()
            ends.append(integrator.step(model.state(), DT).points()[:11])
            moved = np.abs(ends[-1] - model.state().points()[:11]).max()
            assert (moved > 1e-3) == (off < THICK + RADIUS)
        np.testing.assert_array_equal(*ends)
