"""User order of nodes and edges: rods whose neighbours have other ghosts, lengths or dimensions, and several worlds."""

import numpy as np
import pytest

import ddg_warp as ddg

SECTION = ddg.Stiffness(EA=1e3, EI1=1e-3, GJ=1e-3, mass_per_length=0.1, rotary_inertia=1e-6, radius=0.005)


@pytest.mark.parametrize(("dimension", "worlds"), [(3, 1), (3, 2), (2, 1)])
def test_states_keep_the_order_of_the_user(device, dimension, worlds):
    """States return the points, velocities and angles that they are given."""
    scene = ddg.Scene(dimension=dimension)
    for count in (5, 7, 5):
        points = np.zeros((4, count, 3))
        points[:, :, 0], points[:, :, 2] = np.linspace(0.0, 1.0, count), np.arange(4)[:, None]
        rods = scene.add_rods(points, section=SECTION)
        scene.clamp_end(rods[::2])  # every other rod has a ghost
    model = scene.build(device, "float64", worlds=worlds)
    rng = np.random.default_rng(0)
    rest = model.state().points()
    shift, velocities = 1e-3 * rng.normal(size=(2, *rest.shape))
    angles = rng.normal(size=(*rest.shape[:-2], model.order.edges_count))
    if dimension == 2:
        shift[..., 1] = velocities[..., 1] = 0.0
        angles = None
    state = model.state(rest + shift, velocities, angles=angles)
    np.testing.assert_array_equal(state.points(), rest + shift)
    np.testing.assert_array_equal(state.velocities(), velocities)
    if angles is None:
        assert state.angles() is None
    else:
        np.testing.assert_array_equal(state.angles(), angles)
