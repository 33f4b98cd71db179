"""Helpers of accuracy tests: equilibria solved to the rounding of forces, and observed orders."""

import numpy as np

from ddg_warp.solve.equilibrium.statics import Equilibrium, StaticsOptions


def equilibrium(scene, device, **options):
    """Return model and state of a static scene, solved to the rounding of forces: errors here are small."""
    model = scene.build(device, "float64")
    solver = Equilibrium(model, StaticsOptions(floor_factor=1.0, **options))
    return model, solver.load(model.state(), scene.analysis.load_steps)


def order(edges, errors) -> float:
    """Return the observed order in the edge length, by least squares."""
    return -np.polyfit(np.log(edges), np.log(np.abs(errors)), 1)[0]
