"""Put models and tensors of the tests of gradients on the device under test."""

import pytest

from tests.adjoint import differences


@pytest.fixture(autouse=True)
def on_device(device, monkeypatch):
    monkeypatch.setattr(differences, "DEVICE", device)
    if device.startswith("cuda"):
        torch = pytest.importorskip("torch")
        torch.set_default_device(device)
        yield
        torch.set_default_device("cpu")
    else:
        yield
