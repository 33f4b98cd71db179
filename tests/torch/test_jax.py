"""The simulator in JAX: gradients through `from_torch` against central differences, and arrays that pass without a copy (DLPack)."""

import numpy as np
import pytest

import ddg_warp as ddg
from ddg_warp.errors import SceneError
from tests.adjoint.differences import CLOSE, TIGHT, built
from tests.adjoint.test_adjoint import DT, SCENES

torch = pytest.importorskip("torch")
from ddg_warp.torch import Simulator  # noqa: E402

NAME = "rod_bend_twist.stiffness_1"


def simulator() -> Simulator:
    return Simulator(built(SCENES["twisted"]()), DT, **TIGHT)


@pytest.fixture
def jax():
    """JAX in double precision."""
    jax = pytest.importorskip("jax")
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    yield jax
    jax.config.update("jax_enable_x64", before)


def function(sim: Simulator):
    """A number of a roll-out, of a stiffness and of the forces on all points."""
    weight = torch.linspace(0.5, 2.0, sim.model.points_count * 3, dtype=torch.float64).reshape(-1, 3)

    def loss(stiffness, forces):
        *_, state = sim.rollout(sim.initial_state(), {NAME: stiffness}, {"forces": forces}, steps=3)
        return (weight * state.positions).sum() + 0.1 * (state.velocities**2).sum()

    return loss


def test_gradients_in_jax_are_those_of_differences(jax):
    """Gradients by both inputs through a jitted function with operations of JAX on both sides."""
    from ddg_warp.torch.jax import from_torch

    sim = simulator()
    of_torch = function(sim)
    call = from_torch(of_torch, ())
    stiffness = float(sim.parameter(NAME)[0, 0])

    def loss(factor, forces):
        return jax.numpy.sin(call(stiffness * jax.numpy.exp(factor), forces))

    factor = np.float64(0.3)
    forces = 1e-3 * np.random.default_rng(0).normal(size=(sim.model.points_count, 3))
    value, (by_factor, by_forces) = jax.jit(jax.value_and_grad(loss, (0, 1)))(factor, forces)
    with torch.no_grad():
        wanted = of_torch(torch.tensor(stiffness * np.exp(0.3)), torch.tensor(forces))
    assert float(value) == pytest.approx(float(torch.sin(wanted)), rel=1e-12)
    direction = np.where(np.asarray(by_forces) < 0.0, -1.0, 1.0) * (np.asarray(by_forces) != 0.0)
    for gradient, along in (
        (by_factor, lambda x: loss(factor + x, forces)),
        ((by_forces * direction).sum(), lambda x: loss(factor, forces + 1e-2 * x * direction) * 1e2),
    ):
        assert float(gradient) != 0.0
        step = 1e-3
        near, far = (float(along(x * step) - along(-x * step)) / (2.0 * x * step) for x in (1.0, 2.0))
        assert float(gradient) == pytest.approx((4.0 * near - far) / 3.0, rel=CLOSE)


def test_batches_in_jax(jax):
    """vmap calls one after the other, as a loop does."""
    from ddg_warp.torch.jax import from_torch

    sim = simulator()
    call = from_torch(lambda k: sim.step(sim.initial_state(), {NAME: k}).positions[0], (sim.model.points_count, 3))
    factors = np.array([1e-4, 2e-4])
    many = jax.vmap(call)(factors)
    np.testing.assert_array_equal(many, np.stack([call(k) for k in factors]))


def test_another_shape_is_refused(jax):
    from ddg_warp.torch.jax import from_torch

    call = from_torch(lambda x: torch.stack([x, x]), (3,))
    with pytest.raises(Exception, match=r"the function gives \(2,\); give a tensor of shape \(3,\)") as error:
        jax.block_until_ready(call(1.0))
    assert "SceneError" in str(error.value) or isinstance(error.value, SceneError)


def test_states_of_torch_pass_without_a_copy(jax):
    """Positions, and gradients by them."""
    sim = simulator()
    first = torch.tensor(sim.model.state().points()).expand(1, -1, -1).clone().requires_grad_()
    state = sim.step(sim.initial_state(positions=first))
    (gradient,) = torch.autograd.grad((state.positions**2).sum(), first)
    for tensor in (state.detach().positions, gradient):
        array = jax.dlpack.from_dlpack(tensor)
        assert array.unsafe_buffer_pointer() == tensor.data_ptr()
        np.testing.assert_array_equal(array, tensor.cpu().numpy())


@pytest.mark.parametrize("name", ["twisted", "sheet"])
def test_arrays_of_states_pass_without_a_copy(name, device):
    """Arrays pass to torch, and to NumPy on the CPU; exported arrays are not overwritten by later steps."""
    model = built(SCENES[name]())
    integrator, state = ddg.Integrator(model), model.state()
    state = integrator.step(state, DT)
    arrays = state.arrays()
    assert len(arrays) > 1
    for key, array in arrays.items():
        tensor = torch.from_dlpack(array)
        assert tensor.data_ptr() == array.ptr, key
        if device == "cpu":
            assert np.from_dlpack(array).__array_interface__["data"][0] == array.ptr, key
    key = next(iter(arrays))
    shared = torch.from_dlpack(arrays[key])
    before = shared.clone()
    del arrays, array, tensor
    for _ in range(3):
        state = integrator.step(state, DT)
    assert torch.equal(shared, before)
    assert not torch.equal(torch.from_dlpack(state.arrays()[key]), before)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((None, (2,)), "None is no function"),
        ((abs, (-1,)), "shape"),
        ((abs, "ab"), "shape"),
        ((abs, (1.5,)), "shape"),
        ((abs, None), "shape"),
    ],
)
def test_invalid_functions_and_shapes_are_refused(jax, arguments, said):
    from ddg_warp.torch.jax import from_torch

    with pytest.raises(SceneError, match=f"from_torch: .*{said}"):
        from_torch(*arguments)
