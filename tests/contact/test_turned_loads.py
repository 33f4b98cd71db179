"""Load increments with large rotations of supports or obstacles are split, as time steps are (`test_turns`)."""

import numpy as np
import pytest
from turn_cases import LAST, OBSTACLES, RADIUS, ahead, needed, place, posed

import ddg_warp as ddg


def bent(motion, centre, reach=None) -> ddg.Scene:
    """Return a soft rod fixed at both ends, in the path of a rotating capsule."""
    made = ddg.Scene(gravity=(0.0, 0.0, 0.0))
    line = np.linspace((*centre, -0.1), (*centre, 0.1), 11)
    rod = made.add_rod(line, section=ddg.Circle(RADIUS), material=ddg.Material(young=1e5, density=1000.0), twist=False)
    made.fix(rod, [0, -1])
    made.add_obstacle(OBSTACLES["capsule"], motion=motion, name="blade")
    made.contact(stiffness=100.0, range=reach)
    return made


@pytest.mark.parametrize("drive", ["motion", "grip"])
def test_increments_of_static_loads_are_cut_likewise(device, drive):
    """The blade ends beyond the undeformed rod, which is bent ahead, in one load step or three. A chord would pass."""
    turns = 1 / 3
    motion = ddg.Motion(angle=lambda t: 2.0 * np.pi * turns * t) if drive == "motion" else ddg.Grip()
    controls = {"controls": posed(turns)} if drive == "grip" else {}
    model = bent(motion, place(0.19, 1.9 * np.pi * turns)).build(device=device)
    for load_steps in (1, 3) if drive == "motion" else (1,):
        path = []
        state = ddg.statics.solve(model, load_steps=load_steps, way=path, **controls)
        assert len(path) >= load_steps * needed(2.0 * np.pi * turns / load_steps, LAST)
        lead = ahead(state.points()[5:6], 2.0 * np.pi * turns)
        assert 0.0 < lead[0] < 0.02


def test_increments_that_are_not_resolved_are_refused_with_load_steps_that_would_do(device):
    motion = ddg.Motion(angle=lambda t: 80.0 * np.pi * t)
    model = bent(motion, place(0.1, 1.0), reach=2e-5).build(device=device)
    with pytest.raises(ddg.SolverError, match=r"obstacle 0 \('blade'\) turns by 40 turns in a step") as error:
        ddg.statics.solve(model)
    assert error.value.outcome == "turned_too_far"
    load_steps = int(str(error.value).split("load_steps = ")[1].split()[0])
    arcs = ddg.statics.Equilibrium(model).net.arcs
    count = arcs.increments(model.state(), None, 0.0, 1.0, load_steps)
    assert count % load_steps == 0
    with pytest.raises(ddg.SolverError, match="load_steps = "):
        arcs.increments(model.state(), None, 0.0, 1.0, load_steps - 2)


def test_poses_at_the_end_say_nothing_of_more_than_half_a_turn(device):
    model = bent(ddg.Grip(), place(0.1, 1.0)).build(device=device)
    with pytest.raises(ddg.SolverError, match="poses of grip 0 differ by 1 turns"):
        ddg.statics.solve(model, controls=posed(1.0))
