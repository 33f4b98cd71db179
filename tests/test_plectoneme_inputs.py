"""Plectoneme scene: accepted angles, and refused parameters."""

import numpy as np
import pytest

from ddg_warp.scenes import plectoneme


@pytest.mark.parametrize("angle", [0.3, 0.4, 0.5])
def test_loop_size_grows_as_tension_falls(angle):
    """Loop lengths under tension are proportional to sqrt(B / T)."""
    high = 2.0 * np.pi * plectoneme.WOUND * plectoneme.CLOSE * plectoneme.RADIUS / np.tan(angle)
    points = plectoneme.looped(angle, 0.07, 5e-4)
    tall = points[:, 1].max() - plectoneme.BEND - high
    expected = plectoneme.LOOP[1] * np.sqrt(plectoneme.law(0.4)[1] / plectoneme.law(angle)[1])
    assert tall == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    "arguments, match", [({"angle": 0.2}, "0.3 to 0.5"), ({"angle": 0.6}, "0.3 to 0.5"), ({"angle": 0.5}, "0.696")]
)
def test_angles_without_a_plectoneme_are_refused(arguments, match):
    with pytest.raises(ValueError, match=match):
        plectoneme.build(**arguments)
