"""Incidence lists of nodes in thousands of pairs: order, and agreement of thread mappings."""

import numpy as np
import pytest
import warp as wp
from pair_cases import hessian_product, move, state, terms

from ddg_warp import device_arrays
from ddg_warp.kernels.collision.contact import assembly
from ddg_warp.kernels.collision.contact.incidence import list_kernels
from ddg_warp.kernels.collision.primitives import EDGES, POINT_TRIANGLE, Kind
from ddg_warp.solve.collision.collision_mesh import CollisionMesh

MU, RATE, SIDE = 0.4, 100.0, 50


def star() -> tuple[CollisionMesh, np.ndarray]:
    """Return 2,500 short rods that lie on one triangle with both points, some along a side."""
    x, y = np.meshgrid(0.02 + 0.03 * np.arange(SIDE), 0.02 + 0.03 * np.arange(SIDE))
    first = np.stack([x, y, np.full_like(x, 0.0058)], -1).reshape(-1, 3)
    corners = [[-1.0, 0.018, 0.0], [5.0, 0.018, 0.0], [-1.0, 5.0, 0.0]]
    points = np.concatenate([corners, np.stack([first, first + [0.01, 0.004, 0.0003]], 1).reshape(-1, 3)])
    shapes = CollisionMesh(points)
    shapes.shell(np.array([[0, 1, 2]]), 0.004)
    for rod in range(len(first)):
        shapes.rod([3 + 2 * rod, 4 + 2 * rod], 0.003)
    return shapes, points


def test_thread_mappings_agree_for_a_node_in_thousands_of_pairs(device, monkeypatch):
    """One thread per pair and one for all agree on energies, forces, products and blocks of contact and friction."""
    shapes, x = star()
    v = np.random.default_rng(1).normal(size=x.shape)
    slip = 3e-6 * np.random.default_rng(2).normal(size=x.shape)

    def run():
        result, positions = terms(shapes, x, device, friction=MU)
        result.lag(positions)
        move(result, positions, x + slip)
        result.evaluate(positions, wp.full(1, RATE, dtype=wp.float64, device=device))
        _, points = result.lists
        assert points.numbers.numpy()[:3].tolist() == [2 * SIDE**2] * 3
        for pair_list in (points, result.frictions[1]):
            for node in (0, 1, 2, 3):
                start, number = (array.numpy()[node] for array in (pair_list.places, pair_list.numbers))
                items = pair_list.items.numpy()[start : start + number]
                targets = pair_list.factor.nodes.numpy()[items // assembly.ITEMS, items % assembly.ITEMS]
                assert (np.diff(items) > 0).all() and (targets == node).all()
        return [
            *state(result),
            hessian_product(result, v),
            hessian_product(result, v, positions),
            result.dissipated.numpy(),
        ]

    one = run()
    monkeypatch.setattr(device_arrays, "serial", lambda device: False)
    many = run()
    for first, second in zip(one, many, strict=True):
        assert np.abs(first).max() > 0.0
        assert (first == second).all()


@pytest.mark.parametrize("kind", [EDGES, POINT_TRIANGLE, Kind(2, 1)])
def test_incidence_items_are_sorted(device, kind):
    """5,000 pairs have one node in common, at any local index."""
    count, size, rng = 5000, kind.first + kind.second, np.random.default_rng(3)
    nodes = np.column_stack([np.zeros(count, int), rng.integers(1, 4000, (count, size - 1))])
    nodes = rng.permuted(nodes, axis=1)  # some pairs have a node twice, which does not matter here
    nodes = np.column_stack([nodes, np.repeat(nodes[:, :1], 4 - size, 1)])
    items = (assembly.ITEMS * np.arange(count)[:, None] + np.arange(size)).ravel()
    targets = nodes[:, :size].ravel()
    numbers = np.bincount(targets, minlength=4000)
    starts = np.cumsum(numbers) - numbers
    wanted = items[np.argsort(targets, kind="stable")]
    mixed = rng.permutation(len(items))
    mixed = items[mixed][np.argsort(targets[mixed], kind="stable")]
    assert (mixed[:count] != wanted[:count]).any()
    inputs = [wp.array(values, dtype=int, device=device) for values in ([count], starts, numbers, mixed)]
    inputs.insert(1, wp.array(nodes, dtype=wp.vec4i, device=device))
    none = wp.zeros(0, dtype=wp.vec2i, device=device)
    inputs[2:2] = none, none, wp.zeros(4000, dtype=wp.uint8, device=device)
    ordered = wp.zeros(len(items), dtype=int, device=device)
    ranks = wp.zeros(count, dtype=wp.vec4i, device=device)
    *_, sort = list_kernels(kind, False)
    wp.launch(sort, count, [count, *inputs], [ordered, ranks, none, none], device=device)
    assert (ordered.numpy() == wanted).all()
    assert (wanted[ranks.numpy()[:, :size]].ravel() == items).all()
