"""Shared fixtures: the device under test, and strict floating-point errors."""

import sys
from importlib.machinery import PathFinder

import numpy as np
import pytest

from ddg_warp import device_arrays


class PackageFinder(PathFinder):
    """Finder of modules that does not take the folder `tests/torch` for torch where that is missing."""

    @classmethod
    def find_spec(cls, name, path=None, target=None):
        spec = super().find_spec(name, path, target)
        return None if name == "torch" and spec is not None and spec.origin is None else spec


sys.meta_path[sys.meta_path.index(PathFinder)] = PackageFinder


def pytest_addoption(parser):
    parser.addoption("--device", default="cpu", help="Warp device that the tests run on (default: cpu)")
    parser.addoption(
        "--many-threads",
        action="store_true",
        help="have kernels take a thread a thing on the CPU, too, as they do on CUDA",
    )


def pytest_configure(config):
    if config.getoption("--many-threads"):
        device_arrays.serial = lambda device: False


def pytest_collection_modifyitems(config, items):
    if not config.getoption("--device").startswith("cuda"):
        skip = pytest.mark.skip(reason="needs `--device cuda:0`")
        for item in items:
            if "gpu" in item.keywords:
                item.add_marker(skip)


@pytest.fixture(scope="session")
def device(request) -> str:
    """Return the Warp device under test."""
    return request.config.getoption("--device")


@pytest.fixture(autouse=True)
def strict_numpy():
    """Fail the test on overflow, invalid operation or division by zero on the host."""
    with np.errstate(over="raise", invalid="raise", divide="raise"):
        yield
