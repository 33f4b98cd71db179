"""Reactions of supports and obstacles balance the loads in the equilibria of every scene."""

import numpy as np
import pytest

from ddg_warp.run.scene_registry import load_scene, scene_files
from ddg_warp.solve.equilibrium.statics import Equilibrium

FAST = {
    "greenhill",
    "helical_spring",
    "tip_load",
    "bend_twist",
    "plate_buckling",
    "gridshell_dome",
    "cantilever_plate_shear",
}


# Scenes are read, not built: some of them learn in `build`, for a minute in all.
STATICS = [name for name, path in scene_files().items() if "analysis=ddg.Statics(" in path.read_text()]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in FAST else pytest.mark.slow)
        for name in STATICS
        if name != "identify_from_statics"
    ],
)
def test_reactions_carry_the_loads(device, name):
    """The sum of reactions is minus the sum of loads, up to `State.unbalanced`, for all rods, shells and obstacles."""
    scene = load_scene(name).build()
    model = scene.build(device, "float64")
    solver = Equilibrium(model)
    state = solver.load(model.state(), scene.analysis.load_steps)
    tangent = solver.tangent
    loads = np.where(tangent.angle, 0.0, tangent.loads(1.0, tangent.dofs(state)))
    if model.coupled is None:
        loads = tangent.at_points(loads).reshape(-1, 3)
    else:  # joined rods have common nodes, of which `at_points` has one a rod
        assert not model.groups
        loads = tangent.parts[-1].back(loads).reshape(-1, 3)
    size = np.abs(loads).sum()
    assert state.outcome in ("converged", "converged_to_rounding")
    assert state.unbalanced <= (1e-8 if state.outcome == "converged" else 1e-3)
    if size == 0.0:
        assert state.unbalanced == 0.0
        return
    forces = np.sum([reaction.force for reaction in model.reactions(state)], axis=0)
    np.testing.assert_allclose(forces + loads.sum(0), 0.0, rtol=0.0, atol=(1e-7 + 3.0 * state.unbalanced) * size)
