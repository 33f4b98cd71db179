"""Functions of torch tensors, such as roll-outs of a `Simulator`, as functions of JAX arrays with gradients.

    def tip(stiffness):  # of torch
        return simulator.rollout(start, {"rod_bend_twist.stiffness_1": stiffness}, steps=10)[-1].positions[:, -1]

    tip = from_torch(tip, (2, 3))
    gradient = jax.grad(lambda stiffness: tip(stiffness).sum())(3e-4)

They are host callbacks (`jax.pure_callback`), work inside jitted functions, and have first derivatives in reverse mode.
"""

from collections.abc import Callable

import numpy as np

from ddg_warp.errors import MissingPackageError, SceneError

try:
    import jax
    import torch
except ModuleNotFoundError as error:
    raise MissingPackageError("functions of JAX need", error, "jax") from error

from ddg_warp import argument_checks


def from_torch(function: Callable, shape: tuple[int, ...], dtype=None) -> Callable:
    """Wrap a function of torch tensors as one of JAX arrays, with the gradient that torch computes.

    Values pass through host memory, in float64 if JAX has `jax_enable_x64`; set it, since gradients are float32 otherwise.

    Args:
        function: from tensors, all of floating point, to one tensor.
        shape: of the result.
        dtype: of the result; by default JAX's own, float32 or float64.

    Raises:
        SceneError: the function returns another shape, when called.
    """
    if not callable(function):
        raise SceneError(f"from_torch: {function!r} is no function; give one of torch tensors")
    shape = tuple(
        argument_checks.count("from_torch: shape", size, 0) for size in (shape if np.iterable(shape) else [shape])
    )
    kind = jax.dtypes.canonicalize_dtype(dtype or float)
    result = jax.ShapeDtypeStruct(shape, kind)

    def value(*arrays) -> np.ndarray:
        with torch.no_grad():
            return found([_tensor(array) for array in arrays]).cpu().numpy().astype(kind)

    def gradients(arrays, cotangent) -> tuple[np.ndarray, ...]:
        inputs = [_tensor(array).requires_grad_() for array in arrays]
        with torch.enable_grad():
            output = found(inputs)
        returned = torch.autograd.grad(
            output, inputs, _tensor(cotangent).to(output), allow_unused=True, materialize_grads=True
        )
        return tuple(
            gradient.cpu().numpy().astype(array.dtype) for gradient, array in zip(returned, arrays, strict=True)
        )

    def found(inputs: list) -> torch.Tensor:
        output = function(*inputs)
        if not isinstance(output, torch.Tensor) or tuple(output.shape) != shape:
            returned = tuple(output.shape) if isinstance(output, torch.Tensor) else repr(output)
            raise SceneError(
                f"from_torch: the function gives {returned}; give a tensor of shape {shape}, or say another shape"
            )
        return output

    @jax.custom_vjp
    def call(*arrays):
        return jax.pure_callback(value, result, *arrays, vmap_method="sequential")

    def forward(*arrays):
        return call(*arrays), arrays

    def backward(arrays, cotangent):
        alike = tuple(jax.ShapeDtypeStruct(jax.numpy.shape(array), jax.numpy.result_type(array)) for array in arrays)
        return jax.pure_callback(gradients, alike, arrays, cotangent, vmap_method="sequential")

    call.defvjp(forward, backward)
    return call


def _tensor(array) -> torch.Tensor:
    """Return a copy as a tensor in float64."""
    return torch.tensor(np.asarray(array), dtype=torch.float64)
