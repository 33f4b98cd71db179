"""Load increments with large rotations of supports or obstacles are split, as time steps are (`test_turns`)."""

import numpy as np
import pytest
from turn_cases import LAST, OBSTACLES, RADIUS, angles_ahead, polar_point, rotation_control, substeps_needed

import ddg_warp as ddg


def rod_before_blade(motion, centre, search_distance=None) -> ddg.Scene:
    """Return a soft rod fixed at both ends, in the path of a rotating capsule."""
    made = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    line = np.linspace((*centre, -0.1), (*centre, 0.1), 11)
    rod = made.add_rod(line, section=ddg.Circle(RADIUS), material=ddg.Material(young=1e5, density=1000.0), twist=False)
    made.fix(rod, [0, -1])
    made.add_obstacle(OBSTACLES["capsule"], motion=motion, name="blade")
    made.contact(stiffness=100.0, range=search_distance)
    return made


@pytest.mark.parametrize("drive", ["motion", "grip"])
def test_load_increments_are_split_by_rotation(device, drive):
    """The blade ends beyond the undeformed rod, which is bent ahead, in one load step or three. A chord would pass."""
    turns = 1 / 3
    motion = ddg.Motion(angle=lambda t: 2.0 * np.pi * turns * t) if drive == "motion" else ddg.Grip()
    controls = {"controls": rotation_control(turns)} if drive == "grip" else {}
    model = rod_before_blade(motion, polar_point(0.19, 1.9 * np.pi * turns)).build(device=device)
    for load_steps in (1, 3) if drive == "motion" else (1,):
        path = []
        state = ddg.statics.solve(model, load_steps=load_steps, way=path, **controls)
        assert len(path) >= load_steps * substeps_needed(2.0 * np.pi * turns / load_steps, LAST)
        lead = angles_ahead(state.points()[5:6], 2.0 * np.pi * turns)
        assert 0.0 < lead[0] < 0.02


def test_unresolved_increments_are_refused_with_sufficient_load_steps(device):
    motion = ddg.Motion(angle=lambda t: 80.0 * np.pi * t)
    model = rod_before_blade(motion, polar_point(0.1, 1.0), search_distance=2e-5).build(device=device)
    with pytest.raises(ddg.SolverError, match=r"obstacle 0 \('blade'\) rotates by 40 turns in a step") as error:
        ddg.statics.solve(model)
    assert error.value.outcome == "turned_too_far"
    load_steps = int(str(error.value).split("load_steps = ")[1].split()[0])
    arcs = ddg.statics.Equilibrium(model).coupled.arcs
    count = arcs.increments(model.state(), None, 0.0, 1.0, load_steps)
    assert count % load_steps == 0
    with pytest.raises(ddg.SolverError, match="load_steps = "):
        arcs.increments(model.state(), None, 0.0, 1.0, load_steps - 2)


def test_final_poses_beyond_half_a_revolution_are_refused(device):
    model = rod_before_blade(ddg.Grip(), polar_point(0.1, 1.0)).build(device=device)
    with pytest.raises(ddg.SolverError, match="poses of grip 0 differ by 1 turns"):
        ddg.statics.solve(model, controls=rotation_control(1.0))
