"""Forces of a step with a quadratic potential, as differentiable tensors."""

from contextlib import nullcontext
from types import SimpleNamespace

import torch
import warp as wp

from ddg_warp.adjoint.forces import ForceCotangents, force_adjoints, quadratic_of
from ddg_warp.kernels.adjoint.quadratic_force import stiffness_kernel


def torch_stream(like: torch.Tensor):
    """Return a context for Warp launches on torch's stream."""
    if not like.is_cuda:
        return nullcontext()
    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(like.device)))


class QuadraticForces(torch.autograd.Function):
    """Function `forces(potential, step, x0, v0, theta0, x, theta, coefficients)` -> K (x - a), and moments about twist angles.

    `potential`: see `QuadraticPotential`; `step`: its end and its length [s]. Tensors are in the layout of a state.
    """

    @staticmethod
    def forward(ctx, potential, step, *values):
        ctx.potential, ctx.step = potential, step
        ctx.save_for_backward(*values)
        with torch_stream(values[0]):
            return potential.forces(step, *values)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *cotangents):
        with torch_stream(cotangents[0]):
            return None, None, *ctx.potential.vjp(ctx.step, ctx.saved_tensors, *cotangents)


class QuadraticPotential:
    """Quadratic potential of a force on a rod group or on the coupled system, in steps of implicit Euler.

    Twist angles of the coupled system are dof blocks, without moments of their own.

    Attributes:
        force: the force with this potential.
    """

    def __init__(self, model, part):
        self._part, self._is_coupled, real = part, part is model.coupled, model.types.real
        self._adjoint = quadratic_of(force_adjoints(model, part, False))
        self.force = self._adjoint.force
        nodes = part.nodes if self._is_coupled else part.kind.nodes
        self._real, self._vector, self._multiply = real, wp.types.vector(nodes.dim, real), stiffness_kernel(nodes, real)

    def forces(self, step: tuple[float, float], x0, v0, theta0, x, theta, coefficients) -> tuple:
        """Return forces on nodes, and moments about angles."""
        self._resist(step, self._state(x0, v0, theta0), coefficients)
        return self._product(x, theta - theta0, 1.0)

    def vjp(self, step: tuple[float, float], values: tuple, by_force, by_moment) -> tuple:
        """Return the gradients by all tensors of `forces`."""
        x0, v0, theta0, x, theta, coefficients = values
        before, by_start = self._state(x0, v0, theta0), [torch.zeros_like(value) for value in (x0, v0, theta0)]
        rate = self._resist(step, before, coefficients)
        by_x, by_theta = self._product(by_force.contiguous(), by_moment.contiguous(), 0.0)
        if self._is_coupled:
            w = self._array(-by_force)
        else:
            moments = [by_moment[None]] if self._part.kind.twist else []
            w = wp.from_torch(-torch.cat([by_force.permute(2, 0, 1), *moments]))
        rate = wp.full(self._part.columns, rate, dtype=self._real, device=w.device)
        self._adjoint.by_coefficients.zero_()
        by_rate = wp.zeros(tuple(x0.shape[:-1]), dtype=self._real, device=w.device)
        read = before, None, self._state(x, v0, theta), w, rate
        self._adjoint.vjp(ForceCotangents(*read, wp.zeros_like(w), self._state(*by_start), by_rate, None))
        return *by_start, by_x, by_theta, wp.to_torch(self._adjoint.by_coefficients).clone()

    def _resist(self, step: tuple[float, float], before, coefficients: torch.Tensor) -> float:
        """Write the stiffness of a step; return its inverse length."""
        (end, length), rate = step, 1.0 / step[1]
        self.force.upload(end - length, end)
        self.force.coefficients = wp.from_torch(coefficients.detach().contiguous())
        self._adjoint.inertia = self.force.inertia(before, rate)
        return rate

    def _product(self, x: torch.Tensor, rotation: torch.Tensor, relative: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return K (x - a) with `relative` 1, and K x with 0; and the product of the rotation."""
        result = torch.empty_like(x), torch.zeros_like(rotation)
        nodes, out, inertia = self._array(x), self._array(result[0]), self._adjoint.inertia
        if self._is_coupled:
            nodes, out, inertia = self._part.points(nodes), self._part.points(out), inertia.transpose((1, 0))
        rotation, moments = (wp.from_torch(values.detach()) for values in (rotation, result[1]))
        wp.launch(
            self._multiply, nodes.shape, [inertia, nodes, rotation, relative], [out, moments], device=nodes.device
        )
        return result

    def _state(self, x: torch.Tensor, v: torch.Tensor, theta: torch.Tensor) -> SimpleNamespace:
        if self._is_coupled:
            return SimpleNamespace(q=self._array(x), v=self._array(v))
        angles = wp.from_torch(theta.detach())
        return SimpleNamespace(x=self._array(x), v=self._array(v), theta=angles, omega=angles)

    def _array(self, values: torch.Tensor) -> wp.array:
        return wp.from_torch(values.detach(), dtype=self._vector, requires_grad=False)
