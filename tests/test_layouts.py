"""Layouts of many rods: batched random sequential addition against trials one by one."""

import numpy as np
import pytest

from ddg_warp.scenes import _layouts

LENGTH, SEPARATION = 0.1, 3e-3


def one_by_one(rng, count: int, size, height: float) -> np.ndarray:
    """Return rods as `placed_apart` with one trial at a time."""
    placed, failed = [], 0
    while len(placed) < count:
        direction = rng.normal(size=3)
        direction *= LENGTH / np.linalg.norm(direction)
        spare = np.array([*size, height]) - SEPARATION - np.abs(direction)
        failed += 1
        if failed > _layouts.PATIENCE:
            failed, height = 0, height + 0.25 * LENGTH
        if (spare < 0.0).any():
            continue
        start = 0.5 * SEPARATION + rng.uniform(size=3) * spare + np.maximum(0.0, -direction)
        rod = np.array([start, start + direction])
        if not placed or _layouts.distances(*rod, np.array(placed)).min() >= SEPARATION:
            placed.append(rod)
            failed = 0
    return np.array(placed)


@pytest.mark.parametrize(("width", "seed", "batch"), [(1.5, 1, 1000), (1.0, 2, 1000), (1.2, 3, 40)])
def test_placed_apart(monkeypatch, width, seed, batch):
    """Trials that are tested together give the same positions of rods, in boxes that grow and in several batches of neighbours."""
    monkeypatch.setattr(_layouts, "BATCH", batch)
    size = (width * LENGTH, width * LENGTH)
    expected = one_by_one(np.random.default_rng(seed), 150, size, 0.25 * LENGTH)
    placed = _layouts.placed_apart(np.random.default_rng(seed), 150, LENGTH, SEPARATION, size, 0.25 * LENGTH)
    np.testing.assert_array_equal(placed, expected)
