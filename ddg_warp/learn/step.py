"""A time step as a function that torch differentiates and batches; see `ddg_warp.learn.engine`."""

import inspect
from dataclasses import dataclass, replace

import torch

from ddg_warp.errors import SceneError
from ddg_warp.learn.poses import by_last_poses


@dataclass(frozen=True)
class Call:
    """What of a step is no tensor: who makes it, when, and what the tensors are.

    Attributes:
        simulator: whose step it is; worlds: how many there are; version: of its model's parameters.
        start, dt: time at its start and length [s].
        fields: tensors of the state.
        parameters, controls: names of those that follow; of a parameter as many as parts have it.
        graded: whether gradients may be asked for.
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
        """Of so many worlds."""
        return self.simulator.engine(self.worlds)

    def engine_as_then(self):
        """That, for a reverse.

        Raises:
            SceneError: parameters of the model have changed since the step.
        """
        if self.version != self.simulator.model.version:
            raise SceneError(
                "backward: parameters or rest shapes of the model were changed (set_parameter, set_rest) after the step whose gradient "
                "is asked for; call backward before, or hand what changes to steps as tensors"
            )
        return self.engine

    def split(self, tensors):
        """Tensors of the state, of the parameters, and those of the controls by name."""
        states, controls = len(self.fields), len(tensors) - len(self.controls)
        return tensors[:states], tensors[states:controls], dict(zip(self.controls, tensors[controls:], strict=True))

    @property
    def state_axes(self) -> list[int]:
        """Axes along which the worlds of the tensors of a state lie."""
        return [field.axis for field in self.fields]

    @property
    def axes(self) -> list[int]:
        """The same of all tensors."""
        return self.state_axes + self.engine.tables.axes(self.parameters) + [0] * len(self.controls)


class Step(torch.autograd.Function):
    """step(call, *tensors) -> the tensors of the state after it, and what else `Engine.forward` gives."""

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
        ctx.save_for_backward(*tensors, *output)
        rough = [tensor for tensor, field in zip(output, call.fields, strict=False) if not field.smooth]
        ctx.mark_non_differentiable(*rough, *output[len(call.fields) :])

    @staticmethod
    def backward(ctx, *given):
        call, saved = ctx.call, ctx.saved_tensors
        # another function of torch, for transforms and to refuse second derivatives, alone takes a fifth of the time on the host
        special = torch.is_grad_enabled() or torch._C._are_functorch_transforms_active()
        found = iter((Pull.apply if special else Pull.forward)(call, *saved, *given[: len(call.fields)]))
        count = len(saved) - ctx.results - len(call.fields)
        by_state = [next(found) if field.smooth else None for field in call.fields]
        return None, *by_state, *(next(found) for _ in range(count))

    @staticmethod
    def jvp(ctx, *tangents):
        raise NotImplementedError("steps have no forward-mode derivatives; take torch.func.grad or backward()")

    @staticmethod
    def vmap(info, in_dims, call: Call, *tensors):
        axes = call.axes
        return _folded(Step, info.batch_size, in_dims, call, tensors, axes, call.state_axes + [0] * call.engine.told)


class Balance(torch.autograd.Function):
    """balance(call, options, *tensors) -> the tensors of the equilibrium from a state, by parameters and controls; see `Step`.

    Where it starts from has no gradient: an equilibrium depends on that by where things are held alone, which `Simulator` refuses.
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
    def backward(ctx, *given):
        call, saved = ctx.call, ctx.saved_tensors
        engine, count = call.engine_as_then(), len(call.fields)
        tensors, output = saved[: -ctx.results], saved[-ctx.results :]
        first, parameters, controls = call.split(tensors)
        flags, given, found = output[count : count + engine.parts], given[:count], []
        begin, end = ctx.options.get("start", 0.0), call.start
        with engine.turn():
            engine.tables.write(call.parameters, parameters)
            for at, state, *way in reversed(engine.way(end, output)):
                inputs = engine.balance_backward(at, state, controls, given, *way)
                own = engine.tables.pull(call.parameters, inputs, flags)
                for name, value in controls.items():
                    by_load = engine.controls.pull(name, value, inputs, flags)
                    scaled = name in ("forces", "moments", "field")  # by the load parameter; gravity has been already
                    if name == "poses" and at != end:
                        by_load = by_last_poses(engine.poses_of(first), value, (at - begin) / (end - begin), by_load)
                    own.append(at * by_load if scaled else by_load)
                found = [a + b for a, b in zip(found, own, strict=True)] if found else own
                given = engine.by_equilibrium
        return None, None, *([None] * count), *found


class Pull(torch.autograd.Function):
    """pull(call, *tensors, *results, *given) -> derivatives by those tensors of a step that have some.

    Of what went into the step, of what `Step` gave, and of the derivatives by its state; one level only.
    """

    @staticmethod
    def forward(call: Call, *tensors):
        engine, count = call.engine_as_then(), len(call.fields)
        told = count + engine.told
        given, tensors = tensors[-count:], tensors[:-count]
        output, tensors = tensors[-told:], tensors[:-told]
        state, parameters, controls = call.split(tensors)
        with engine.turn():
            engine.tables.write(call.parameters, parameters)
            ends = output[:count], output[count:]
            found, inputs, flags = engine.backward(call.start, call.dt, state, *ends, given, controls)
            by_state = engine.layout.flagged(found, flags)
            by_parameters = engine.tables.pull(call.parameters, inputs, flags)
            by_controls = [engine.controls.pull(name, controls[name], inputs, flags) for name in call.controls]
        return *by_state, *by_parameters, *by_controls

    @staticmethod
    def setup_context(ctx, inputs, output):
        pass

    @staticmethod
    def backward(ctx, *given):
        raise NotImplementedError("steps have first derivatives alone; take differences of gradients for second ones")

    @staticmethod
    def vmap(info, in_dims, call: Call, *tensors):
        axes = call.axes
        smooth = [field.axis for field in call.fields if field.smooth]
        given = [*axes, *call.state_axes, *[0] * call.engine.told, *call.state_axes]
        return _folded(Pull, info.batch_size, in_dims, call, tensors, given, smooth + axes[len(call.fields) :])


# torch asks for signatures in every call, and looks for them longer than all else takes
for own in (Step, Balance, Pull):
    own.forward.__signature__ = inspect.signature(own.forward)


def _folded(function, batch: int, in_dims, call: Call, tensors, axes: list[int], axes_found: list[int]):
    """A function of a batch as that of batch x worlds, whose worlds lie along these axes of what it takes and gives."""
    wide = []
    for tensor, dim, axis in zip(tensors, in_dims[1:], axes, strict=True):
        own = tensor.unsqueeze(0).expand(batch, *tensor.shape) if dim is None else tensor.movedim(dim, 0)
        own = own.movedim(0, axis)
        wide.append(own.reshape(*own.shape[:axis], -1, *own.shape[axis + 2 :]))
    found = function.apply(replace(call, worlds=batch * call.worlds), *wide)
    result = []
    for tensor, axis in zip(found, axes_found, strict=False):
        split = tensor.reshape(*tensor.shape[:axis], batch, -1, *tensor.shape[axis + 1 :])
        result.append(split.movedim(axis, 0))
    return tuple(result), (0,) * len(result)
