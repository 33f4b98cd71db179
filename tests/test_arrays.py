"""Order of concurrent launches and later ones, and readings of earlier launches."""

from functools import partial

import numpy as np
import warp as wp

from ddg_warp import device_arrays

LENGTH = 100_000


@wp.kernel(enable_backward=False)
def slow_sum(values: wp.array(dtype=float), rounds: int, out: wp.array(dtype=float)):
    """Add rounds * values to out, slowly enough to outlast concurrent launches."""
    i = wp.tid()
    total = out[i]
    for _ in range(rounds):
        total += values[i]
    out[i] = total


@wp.kernel(enable_backward=False)
def add(
    first: wp.array(dtype=float),
    second: wp.array(dtype=float),
    third: wp.array(dtype=float),
    out: wp.array(dtype=float),
):
    i = wp.tid()
    out[i] = first[i] + second[i] + third[i]


def test_concurrent_launches_end_before_dependent_ones(device):
    """Concurrent launches, some nested, direct, captured, and in a conditional graph."""
    values = wp.array(np.arange(LENGTH) % 7, dtype=float, device=device)
    first, second, third, total = (wp.zeros(LENGTH, dtype=float, device=device) for _ in range(4))
    device_arrays.load_kernels([slow_sum, add], device)

    def launch():
        for array in (first, second, third, total):
            array.zero_()

        def sum_up(values, rounds, out):
            wp.launch(slow_sum, LENGTH, [values, rounds], [out], device=device)

        def inner():
            device_arrays.side_by_side(
                [partial(sum_up, values, 300, first), partial(sum_up, values, 200, second)], device
            )
            sum_up(second, 2, first)  # 300 + 2 * 200

        device_arrays.side_by_side([inner, partial(sum_up, values, 100, third)], device)
        wp.launch(add, LENGTH, [first, second, third], [total], device=device)

    expected = (700 + 200 + 100) * (np.arange(LENGTH) % 7)
    launch()
    np.testing.assert_array_equal(total.numpy(), expected)
    flag = wp.ones(1, dtype=int, device=device)
    stream = wp.ScopedStream(wp.Stream(device)) if wp.get_device(device).is_cuda else wp.ScopedDevice(device)
    with stream, wp.ScopedCapture(device=device, force_module_load=False) as capture:
        total.zero_()
        wp.capture_if(flag, launch)
    for _ in range(5):
        total.fill_(-1.0)
        wp.capture_launch(capture.graph)
        np.testing.assert_array_equal(total.numpy(), expected)


def test_readings_see_earlier_launches(device):
    values = wp.zeros(5, dtype=wp.int64, device=device)
    reading = device_arrays.Reading(values)
    np.testing.assert_array_equal(reading(), 0)
    for number in (3, 4):
        values.fill_(number)
        found = reading()
        np.testing.assert_array_equal(found, number)
        assert found is reading()


def test_columns_are_views_in_the_order_of_memory(device):
    values = np.arange(2.0 * 3 * 5 * 4).reshape(6, 5, 4)  # rows, nodes, rods
    array = device_arrays.upload(values, wp.float64, device)
    order = (0, 2, 1) if device_arrays.serial(device) else (0, 1, 2)  # rod by rod on the CPU, node by node on a GPU
    expected = values.transpose(order).reshape(6, -1)
    np.testing.assert_array_equal(device_arrays.columns(array).numpy(), expected)
    np.testing.assert_array_equal(device_arrays.columns(array, 2, 3).numpy(), expected.reshape(2, 3, -1))
    device_arrays.columns(array).fill_(7.0)
    np.testing.assert_array_equal(device_arrays.download(array), 7.0)
