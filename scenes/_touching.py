"""What scenes with contact share: that nothing passed through anything, and pictures of rods as thick as they are on obstacles."""

import numpy as np

import ddg_warp as ddg
from ddg_warp.io.tube import SIDES, tube_points


def kept_apart(result) -> list[ddg.Check]:
    """Nothing passed through anything, and surfaces that a barrier keeps apart never overlapped."""
    found = result.statistics["contact"]
    checks = [ddg.Check("pairs that passed through each other", found["refused_crossings"], 0.0, 0.0)]
    if result.model.scene.touching.law == "barrier":
        overlap = max(0.0, -found["smallest_gap"])
        checks.append(ddg.Check("largest overlap of surfaces [m]", overlap, 0.0, 0.0, "the barrier"))
    return checks


def jitter(shape: tuple, seed: int) -> np.ndarray:
    """Random numbers between -1 and 1, the same for the same seed; zeros for one below 0."""
    return np.random.default_rng(seed).uniform(-1.0, 1.0, shape) if seed >= 0 else np.zeros(shape)


def smallest_gap(model, state) -> float:
    """The smallest gap of what is within the range of contact [m], the range where nothing is."""
    gap = model.contacts(state).gap
    return float(gap.min()) if len(gap) else float(model.scene.touching.range)


def tubes(model, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n, 3) [m] and triangles (t, 3) of all rods of the first world, as thick as they are."""
    curves = model.curves
    counts, closed = np.asarray(curves.counts), np.asarray(curves.closed)
    radius = np.concatenate(
        [np.full(batch.rods * batch.nodes, np.max(batch.section.radius)) for batch in model.scene.batches]
    )
    around, next_one = np.arange(SIDES), np.roll(np.arange(SIDES), -1)
    start = np.delete(np.arange(counts.sum()), np.cumsum(counts)[~closed] - 1)[:, None]
    a, b = SIDES * start, SIDES * (start + 1)
    quads = np.stack([a + around, a + next_one, b + next_one, b + around], axis=-1).reshape(-1, 4)
    return tube_points(points, counts, closed, radius), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def joined(*bodies: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """One mesh of several."""
    first = np.cumsum([0] + [len(points) for points, _ in bodies])
    return np.concatenate([points for points, _ in bodies]), np.concatenate(
        [triangles + offset for (_, triangles), offset in zip(bodies, first[:-1], strict=True)]
    )
