"""Sections given by stiffnesses have no radius: contact and drag require one, drawing reports a default."""

import numpy as np
import pytest

import ddg_warp as ddg

POINTS = np.linspace((0.0, 0.0, 0.1), (1.0, 0.0, 0.1), 6)
GIVEN = {"EA": 1e3, "EI1": 1e-2, "GJ": 1e-2, "mass_per_length": 0.1, "rotary_inertia": 1e-6}


def scene(**section) -> ddg.Scene:
    made = ddg.Scene()
    made.add_rod(POINTS, section=ddg.Stiffness(**GIVEN, **section), name="cable")
    return made


def rod_on_a_plane(radius=None, **section) -> ddg.Scene:
    made = scene(**section)
    made.add_obstacle(ddg.Plane())
    made.contact(radius=radius)
    return made


def viscous(**section) -> ddg.Scene:
    made = scene(**section)
    made.drag(0, ddg.Viscous(1.0))
    return made


def test_contact_requires_a_radius():
    with pytest.raises(ddg.SceneError, match=r"rod 0 \('cable'\) .* give Stiffness\(radius=...\)"):
        rod_on_a_plane().build("cpu")
    assert rod_on_a_plane(radius={"cable": 0.02}).build("cpu").coupled.host.contact_parameters.bodies[0].radius == 0.02
    made = scene(radius=0.03)
    made.add_obstacle(ddg.Plane())
    made.contact()
    assert made.build("cpu").coupled.host.contact_parameters.bodies[0].radius == 0.03


def test_viscous_drag_requires_a_radius():
    with pytest.raises(ddg.SceneError, match=r"rods 'cable'.* no radius.* Stiffness\(radius=...\)"):
        viscous().build("cpu")
    viscous(radius=0.01).build("cpu")
    made = scene()
    made.drag(0, tangential=1.0, normal=2.0)
    made.build("cpu")


def test_default_drawing_radius_is_reported():
    model = scene().build("cpu")
    assert (model.curves.radius == 1e-3).all()
    assert "drawn 0.002 m thick, as their section has no radius: cable" in model.report()
    assert "no radius" not in scene(radius=0.02).build("cpu").report()
