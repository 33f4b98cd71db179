"""Colors of pictures and scenes."""

from __future__ import annotations

import numpy as np

SCALE = ("#c9d6e8", "#6f9bd1", "#3b5fa8", "#7a2f79", "#d1495b")
"""Colors of a scale from low to high, at equal distances."""
PALETTE = ((0.12, 0.47, 0.71), (0.89, 0.47, 0.20), (0.17, 0.63, 0.42), (0.74, 0.27, 0.35), (0.55, 0.42, 0.70))
"""RGB of batches of rods and of surfaces, in turn."""
OBSTACLE, CONTACT = (0.62, 0.63, 0.65), (0.86, 0.15, 0.13)
"""RGB of obstacles, and of points in contact."""


def on_scale(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return RGB (n, 3) of values (n,) on the scale from low to high; values beyond an end get its color."""
    anchors = np.array([[int(color[k : k + 2], 16) for k in (1, 3, 5)] for color in SCALE]) / 255.0
    nodes = np.linspace(low, high, len(SCALE))
    return np.stack([np.interp(values, nodes, anchors[:, channel]) for channel in range(3)], axis=1)
