"""Put models and tensors of the tests here on the device under test."""

from tests.adjoint.conftest import on_device

__all__ = ["on_device"]
