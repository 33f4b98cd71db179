"""Devices in torch: `.to` of simulators and states, their text, and networks in other precisions."""

import copy
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp

import ddg_warp as ddg
from ddg_warp.errors import SceneError

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator  # noqa: E402
from ddg_warp.torch.state_layout import view  # noqa: E402


@pytest.fixture
def simulator(device) -> Simulator:
    """Return a simulator of a cable in a grip."""
    scene = ddg.Scene()
    points = np.linspace((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), 8)
    rod = scene.add_rod(points, section=ddg.Circle(0.004), material=ddg.Material(1e6, density=1000.0))
    scene.clamp(rod, motion=ddg.Grip())
    return Simulator(scene.build(device), dt=0.01)


def test_text_is_one_line(simulator):
    state, model = simulator.step(simulator.initial_state(4)), simulator.model
    assert repr(simulator) == f"Simulator(implicit_euler, dt = 0.01 s, {model!r})"
    assert repr(state) == f"<WorldState at t = 0.01 s: 4 worlds of 8 points on {simulator.device}>"
    assert repr(copy.copy(state)) == "<WorldState at t = 0.01 s: 4 worlds, of no simulator yet>"


def test_to_the_own_device_returns_the_object(simulator):
    state = simulator.initial_state(2)
    for owner in (simulator, state):
        assert owner.to(simulator.device) is owner
        assert owner.to(simulator.device.type, torch.float64) is owner
        assert owner.to(state.positions) is owner


def test_to_elsewhere_says_how(simulator):
    state = simulator.initial_state(2)
    with pytest.raises(SceneError, match=r"a state lives on .*Simulator\(model.to\('meta'\), dt\).*world_state"):
        state.to("meta")
    with pytest.raises(SceneError, match=r"a simulator lives on .*Simulator\(model.to\('meta'\), dt\)"):
        simulator.to(device="meta")
    with pytest.raises(SceneError, match=r"float64 in the precision .*state.positions.to\(torch.float32\)"):
        state.to(torch.float32)


def test_a_state_moves_by_world_state(simulator):
    """The next step of the copy equals the original's, to the tolerance of steps."""
    state = simulator.step(simulator.initial_state(2))
    after = simulator.step(state).positions.cpu()
    with torch.device("cpu"):
        target = Simulator(simulator.model.to("cpu"), dt=0.01)
        moved = target.step(target.world_state(state)).positions
    assert moved.device.type == "cpu"
    torch.testing.assert_close(moved, after, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_networks_in_lower_precision_train(simulator, dtype):
    """Autocast networks move a grip; the gradient of a step by their weights is that in float64, to their precision."""
    torch.manual_seed(0)
    network = torch.nn.Linear(3, 6).to(simulator.device)
    state, gradients = simulator.initial_state(4), {}
    for precision in (torch.float64, dtype):
        model = copy.deepcopy(network).to(torch.float64 if precision == torch.float64 else torch.float32)
        with torch.autocast(simulator.device.type, dtype=dtype, enabled=precision == torch.bfloat16):
            motion = model(state.positions[:, -1].to(model.weight.dtype))
        poses = 1e-2 * motion[:, None].double()
        simulator.step(state, controls={"poses": poses}).positions.sum().backward()
        gradients[precision] = model.weight.grad.double()
    relative = (gradients[dtype] - gradients[torch.float64]).norm() / gradients[torch.float64].norm()
    assert relative < (1e-5 if dtype == torch.float32 else 1e-2)


@pytest.mark.slow
def test_two_processes_train_as_one(tmp_path):
    """The file of the page on devices: two processes on the CPU end with the weights of one, to rounding."""
    page = Path(__file__).parents[2] / "tools" / "docs" / "howto" / "devices.md"
    (text,) = re.findall(r"^```python file=train.py\n(.*?)^```", page.read_text(), re.M | re.S)
    (tmp_path / "train.py").write_text(text)
    quiet = os.environ | {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    several = ["-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    sums = []
    for options in ([], several):
        command = [sys.executable, *options, "train.py"]
        done = subprocess.run(command, cwd=tmp_path, env=quiet, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-2000:]
        sums.append(float(re.search(r"sum of weights (\S+)", done.stdout)[1]))
    assert sums[0] == pytest.approx(sums[1], rel=1e-12)


@pytest.mark.parametrize("default", ["cpu", "meta"])
def test_views_share_memory_whatever_the_default_device(default):
    """Models of the CPU serve where torch makes tensors elsewhere; "meta" stands for CUDA."""
    array = wp.zeros(3, dtype=wp.vec3d, device="cpu")
    with torch.device(default):
        view(array).fill_(2.0)
    np.testing.assert_array_equal(array.numpy(), 2.0)
