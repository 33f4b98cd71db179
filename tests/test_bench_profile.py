"""Profile of launches: counts, and bytes of arguments."""

import sys
from pathlib import Path

import warp as wp

sys.path.insert(0, str(Path(__file__).parents[1] / "tools"))
import bench_profile


@wp.struct
class Pair:
    first: wp.array(dtype=wp.float64)
    second: wp.array(dtype=wp.float32)


@wp.kernel
def double(pair: Pair, out: wp.array(dtype=wp.vec3d)):
    i = wp.tid()
    out[i] = wp.vec3d(pair.first[i] * wp.float64(2.0))


def test_bytes_of_a_launch_count_each_array_once():
    """Count 8 n bytes of float64, 4 n of float32 and 24 n of vectors, each array once, and nothing after the context."""
    n, pair = 5, Pair()
    pair.first, pair.second = wp.zeros(n, dtype=wp.float64, device="cpu"), wp.zeros(n, dtype=wp.float32, device="cpu")
    out, launch = wp.zeros(n, dtype=wp.vec3d, device="cpu"), wp.launch
    with bench_profile.Launches() as launches:
        wp.launch(double, n, inputs=[pair], outputs=[out], device="cpu")
        wp.launch(double, dim=n, inputs=[pair, out], device="cpu")
    assert wp.launch is launch
    assert dict(launches.count) == {"double": 2}
    assert launches.bytes["double"] == 2 * n * (8 + 4 + 24)
