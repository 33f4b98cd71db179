"""Time step as a function that torch differentiates and batches; see `ddg_warp.torch.engine`."""

import inspect
from dataclasses import dataclass, replace

import torch

from ddg_warp.errors import SceneError
from ddg_warp.torch.controls import FIELD
from ddg_warp.torch.grip_poses import by_last_poses

SCALED = "forces", "moments", "field", "torques", "wrenches"  # controls that the load parameter scales


@dataclass(frozen=True)
class Call:
    """Arguments of a step that are no tensors.

    Attributes:
        simulator: the simulator.
        worlds: number of worlds.
        version: version of its model's parameters.
        start, dt: time at its start and length [s].
        fields: fields of the tensors of the state.
        parameters, controls: names of the tensors that follow; a parameter has one tensor per storage.
        graded: True if gradients may be requested.
    """

    simulator: object
    worlds: int
    version: int
    start: float
    dt: float
    fields: tuple
    parameters: tuple
    controls: tuple
    graded: bool

    @property
    def engine(self):
        """Engine for the number of worlds."""
        return self.simulator.engine(self.worlds)

    def engine_as_then(self):
        """Return the engine for a backward pass.

        Raises:
            SceneError: parameters of the model have changed since the step.
        """
        if self.version != self.simulator.model.version:
            raise SceneError(
                "backward: parameters or rest shapes of the model were changed (set_parameter, set_rest) after the step whose gradient "
                "is requested; call backward before, or pass changing values to steps as tensors"
            )
        return self.engine

    def split(self, tensors):
        """Return tensors of the state, of the parameters, and a dict of the controls."""
        states, controls = len(self.fields), len(tensors) - len(self.controls)
        return tensors[:states], tensors[states:controls], dict(zip(self.controls, tensors[controls:], strict=True))

    @property
    def state_axes(self) -> list[int]:
        """World axes of the tensors of a state."""
        return [field.axis for field in self.fields]

    @property
    def axes(self) -> list[int]:
        """World axes of all tensors."""
        return self.state_axes + self.engine.tables.axes(self.parameters) + [0] * len(self.controls)


class Step(torch.autograd.Function):
    """Function `step(call, *tensors)` -> tensors of the state after a step, and further results of `Engine.forward`."""

    @staticmethod
    def forward(call: Call, *tensors):
        engine = call.engine
        with engine.turn():
            state, parameters, controls = call.split(tensors)
            engine.tables.write(call.parameters, parameters)
            return tuple(engine.forward(call.start, call.dt, state, controls, call.graded))

    @staticmethod
    def setup_context(ctx, inputs, output):
        call, *tensors = inputs
        ctx.call, ctx.results = call, len(output)
        ctx.set_materialize_grads(False)  # zeros would be allocated and written for results without a gradient
        ctx.save_for_backward(*tensors, *output)
        rough = [tensor for tensor, field in zip(output, call.fields, strict=False) if not field.smooth]
        ctx.mark_non_differentiable(*rough, *output[len(call.fields) :])

    @staticmethod
    def backward(ctx, *cotangent):
        call, saved = ctx.call, ctx.saved_tensors
        # Pull.apply serves transforms and refuses second derivatives. Measured: it alone takes a fifth of the host time
        special = torch.is_grad_enabled() or torch._C._are_functorch_transforms_active()
        cotangent = cotangent[: len(call.fields)]
        if special:
            after = saved[len(saved) - ctx.results :]
            cotangent = [torch.zeros_like(y) if v is None else v for v, y in zip(cotangent, after, strict=False)]
        gradients = iter((Pull.apply if special else Pull.forward)(call, *saved, *cotangent))
        count = len(saved) - ctx.results - len(call.fields)
        by_state = [next(gradients) if field.smooth else None for field in call.fields]
        return None, *by_state, *(next(gradients) for _ in range(count))

    @staticmethod
    def jvp(ctx, *tangents):
        raise NotImplementedError("steps have no forward-mode derivatives; take torch.func.grad or backward()")

    @staticmethod
    def vmap(info, in_dims, call: Call, *tensors):
        axes = call.axes
        return _folded(
            Step, info.batch_size, in_dims, call, tensors, axes, call.state_axes + [0] * call.engine.extra_outputs
        )


class Balance(torch.autograd.Function):
    """Function `balance(call, options, *tensors)` -> tensors of the equilibrium found from a state; see `Step`.

    The start state has no gradient: an equilibrium depends on it only through fixed dofs, which `Simulator` refuses.
    """

    @staticmethod
    def forward(call: Call, options: tuple, *tensors):
        engine = call.engine
        state, parameters, controls = call.split(tensors)
        with engine.turn():
            engine.tables.write(call.parameters, parameters)
            engine.tables.refuse_invalid()
            return tuple(engine.balance(state, controls, dict(options), call.graded))

    @staticmethod
    def setup_context(ctx, inputs, output):
        call, options, *tensors = inputs
        ctx.call, ctx.options, ctx.results = call, dict(options), len(output)
        ctx.save_for_backward(*tensors, *output)
        rough = [tensor for tensor, field in zip(output, call.fields, strict=False) if not field.smooth]
        ctx.mark_non_differentiable(*rough, *output[len(call.fields) :])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *cotangent):
        call, saved = ctx.call, ctx.saved_tensors
        engine, count = call.engine_as_then(), len(call.fields)
        tensors, output = saved[: -ctx.results], saved[-ctx.results :]
        first, parameters, controls = call.split(tensors)
        flags, cotangent, gradients = output[count : count + engine.parts], cotangent[:count], []
        begin, end = ctx.options.get("start", 0.0), call.start
        with engine.turn():
            engine.tables.write(call.parameters, parameters)
            for factor, state, *load_step in reversed(engine.way(end, output)):
                fraction = (factor - begin) / (end - begin) if end != begin else 1.0
                on_path = engine.controls.on_path(controls, begin, fraction)
                inputs = engine.balance_backward(factor, state, on_path, cotangent, *load_step)
                by_input = engine.tables.vjp(call.parameters, inputs, flags)
                for name, value in controls.items():
                    by_load = engine.controls.vjp(name, value, inputs, flags)
                    scaled = name in SCALED  # gravity has been already
                    if name == "poses" and factor != end:
                        by_load = by_last_poses(engine.poses_of(first), value, fraction, by_load)
                    weight = factor if scaled else fraction if name.startswith(FIELD) else 1.0
                    by_input.append(weight * by_load)
                gradients = [a + b for a, b in zip(gradients, by_input, strict=True)] if gradients else by_input
                cotangent = engine.by_equilibrium
        return None, None, *([None] * count), *gradients


class Pull(torch.autograd.Function):
    """Function `pull(call, *tensors, *results, *cotangent)` -> gradients of a step.

    Arguments are the inputs of `Step`, its results and the gradient by the state after the step. First derivatives only.
    """

    @staticmethod
    def forward(call: Call, *tensors):
        engine, count = call.engine_as_then(), len(call.fields)
        results = count + engine.extra_outputs
        cotangent, tensors = tensors[-count:], tensors[:-count]
        output, tensors = tensors[-results:], tensors[:-results]
        state, parameters, controls = call.split(tensors)
        with engine.turn():
            engine.tables.write(call.parameters, parameters)
            ends = output[:count], output[count:]
            by_start, inputs, flags = engine.backward(call.start, call.dt, state, *ends, cotangent, controls)
            by_state = engine.layout.flagged(by_start, flags)
            by_parameters = engine.tables.vjp(call.parameters, inputs, flags)
            by_controls = [engine.controls.vjp(name, controls[name], inputs, flags) for name in call.controls]
        return *by_state, *by_parameters, *by_controls

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def backward(ctx, *cotangents):
        raise NotImplementedError("steps have first derivatives alone; take differences of gradients for second ones")

    @staticmethod
    def vmap(info, in_dims, call: Call, *tensors):
        axes = call.axes
        smooth = [field.axis for field in call.fields if field.smooth]
        all_axes = [*axes, *call.state_axes, *[0] * call.engine.extra_outputs, *call.state_axes]
        return _folded(Pull, info.batch_size, in_dims, call, tensors, all_axes, smooth + axes[len(call.fields) :])


# torch inspects signatures in every call, which takes longer than all other host work
for own in (Step, Balance, Pull):
    own.forward.__signature__ = inspect.signature(own.forward)


def _folded(function, batch: int, in_dims, call: Call, tensors, axes: list[int], axes_found: list[int]):
    """Apply a batched function by folding the batch into the worlds, along given axes of arguments and results."""
    wide = []
    for tensor, dim, axis in zip(tensors, in_dims[1:], axes, strict=True):
        moved = tensor.unsqueeze(0).expand(batch, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        moved = moved.movedim(0, axis)
        wide.append(moved.reshape(*moved.shape[:axis], -1, *moved.shape[axis + 2 :]))
    outputs = function.apply(replace(call, worlds=batch * call.worlds), *wide)
    result = []
    for tensor, axis in zip(outputs, axes_found, strict=False):
        split = tensor.reshape(*tensor.shape[:axis], batch, -1, *tensor.shape[axis + 1 :])
        result.append(split.movedim(axis, 0))
    return tuple(result), (0,) * len(result)
