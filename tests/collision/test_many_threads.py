"""Thread mappings: one thread per item, as on a GPU, and one thread over all items agree."""

import numpy as np
import pytest
import warp as wp
from brute_force import candidate_pairs, scene, upload

import ddg_warp as ddg
from ddg_warp import device_arrays
from ddg_warp.solve.collision import bvh, candidate_list
from ddg_warp.solve.collision.broad_phase import BroadPhase

REACH, MARGIN = 0.004, 0.01


@pytest.fixture
def many(monkeypatch):
    """Return a switch to one thread per item, with several blocks of overlapping boxes."""

    def switch():
        monkeypatch.setattr(device_arrays, "serial", lambda device: False)
        monkeypatch.setattr(candidate_list, "LEAST", 16)

    return switch


@pytest.mark.parametrize("worlds", [1, 3])
def test_candidates_do_not_depend_on_the_thread_mapping(device, many, worlds):
    shapes, points = scene(1, 0.3)
    rng = np.random.default_rng(1)
    x = upload(np.concatenate([points + 1e-3 * rng.normal(size=points.shape) for _ in range(worlds)]), device)
    one = candidate_pairs(BroadPhase(shapes, x, worlds, search_distance=REACH, margin=MARGIN))
    many()
    search = BroadPhase(shapes, x, worlds, search_distance=REACH, margin=MARGIN)
    assert max(len(side._found) for side in search.lists) > 4
    for expected, actual in zip(one, candidate_pairs(search), strict=True):
        np.testing.assert_array_equal(expected, actual)


def test_walk_order_follows_a_morton_curve(device):
    """Keys of three times ten bits increase, world by world; boxes outside the bounds are clamped to the sides."""
    rng, count = np.random.default_rng(2), 200
    for worlds in (1, 3):
        boxes = bvh.Aabbs(count, worlds, wp.get_device(device))
        order = bvh.WalkOrder(boxes)
        for away in (0.0, 5.0):  # the second time some boxes have left the bounds, which stay
            lower = rng.uniform(size=(worlds * count, 3))
            lower[::7] += away
            boxes.lower.assign(lower.astype(np.float32))
            boxes.upper.assign((lower + 0.01).astype(np.float32))
            order()
            if not away:
                center, size = 0.5 * (lower.min(0) + lower.max(0) + 0.01), 2.0 * np.ptp(lower, axis=0).max() + 0.02
            cells = np.clip((lower + 0.005 - center + 0.5 * size) * 1024.0 / size, 0, 1023).astype(int)
            numbers = order.numbers.numpy()[: worlds * count]
            assert sorted(numbers) == list(range(worlds * count))
            assert (np.diff(numbers // count) >= 0).all()
            bits = (cells[:, :, None] >> np.arange(10)) & 1
            keys = (bits << (3 * np.arange(10) + np.arange(3)[:, None])).sum((1, 2)) >> (2 if worlds > 1 else 0)
            keys = keys[numbers].reshape(worlds, count)
            assert (np.diff(keys, axis=1) >= 0).all()


def crossed_layers() -> ddg.Scene:
    """Return two layers of rods that fall onto each other and a plane, with friction."""
    model = ddg.Scene(mass_damping=0.5)
    s = np.linspace(-0.1, 0.1, 13)
    for layer in range(2):
        for k in range(3):
            points = np.zeros((13, 3))
            points[:, layer], points[:, 1 - layer], points[:, 2] = s, 0.05 * (k - 1), 0.004 + 0.006 * layer
            points[:, 2] += 1e-3 * np.sin(20.0 * s + k)
            model.add_rod(points, section=ddg.Circle(2e-3), material=ddg.Material(1e7, 0.4, 1200.0))
    model.add_obstacle(ddg.Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    model.contact(range=1e-3, stiffness=100.0, friction=0.3, velocity=1e-2)
    return model


def test_steps_do_not_depend_on_the_thread_mapping(device, many):
    """The order of summation differs, and 40 steps with impacts amplify rounding."""
    results = []
    for _ in range(2):
        model = crossed_layers().build(device)
        integrator, state = ddg.Integrator(model, rtol=1e-9), model.state()
        for _ in range(40):
            state = integrator.step(state, 1 / 480)
        statistics = integrator.statistics()
        results.append((state.points(), state.velocities(), statistics["contact"]["contacts"]["mean"]))
        assert statistics["pcg_iterations"] > 100
        many()
    assert results[0][2] > 5
    assert results[0][2] == results[1][2]
    np.testing.assert_allclose(results[1][0], results[0][0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(results[1][1], results[0][1], rtol=0, atol=1e-6)
