"""Simulator: a model as a torch module of pure functions from states to states."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TypeAlias

import numpy as np
import torch
import warp as wp

from ddg_warp import argument_checks
from ddg_warp.adjoint.implicit import refuse_gyroscopic
from ddg_warp.capture_lock import alone
from ddg_warp.errors import GradientWarning, SceneError
from ddg_warp.model.controls import Controls, named_field, require_acting, shapes
from ddg_warp.model.model import Model, check_model
from ddg_warp.model.state import State, check_state
from ddg_warp.solve.equilibrium import statics
from ddg_warp.solve.newton.rod_newton import NewtonOptions
from ddg_warp.solve.stepping.integrator import SCHEMES, Integrator
from ddg_warp.torch.autograd import Balance, Call, Step
from ddg_warp.torch.compiler import graph_break
from ddg_warp.torch.controls import FIELD
from ddg_warp.torch.engine import LOAD, Engine
from ddg_warp.torch.rollout import Plan, bytes_of, plan, roll
from ddg_warp.torch.state_layout import copies, tensors
from ddg_warp.torch.world_state import WorldState, outcome_names, require_same
from ddg_warp.torch.wrenches import Wrenches, WrenchTensors
from ddg_warp.typing import Names, Numbers, Option, Scheme

Tensors: TypeAlias = torch.Tensor | Numbers
Parameters: TypeAlias = Mapping[str, Tensors]  # by name, as of `Model.set_parameter`
Inputs: TypeAlias = Mapping[str, Tensors | Mapping[str, Tensors]]  # controls by name

SETTLED = {"failures", "check_every", "energy_bound"}  # arguments of `Integrator` that the engine sets


class Simulator(torch.nn.Module):
    """Differentiable steps of a model, with the parameters and rest shapes of the model at the time of the call.

    `Model.set_parameter` and `Model.set_rest` change these.

        simulator = Simulator(model, dt=0.01)
        state = simulator.initial_state(batch=8)
        state = simulator.step(state, {"rod_bend_twist.stiffness_1": stiffness})
        loss = ((state.positions - goal) ** 2).sum()
        loss.backward()

    Args:
        model: the model to step. Worlds of a batch are copies: the model is rebuilt with the number of worlds of a state.
        dt: length of the steps [s].
        scheme, options: as of `Integrator`.

    States of a world are NaN from a failed step on. Gradients through a step are NaN, in its world only, if the step failed, was
    split into substeps or updated frames (edges rotated by more than 90 degrees). Both are reported by `outcomes`, by
    `WorldState.differentiable`, and once by a `GradientWarning`, which on CUDA comes with a later call, since nothing waits for the
    device.

    Parameters are tensors (), (B, 1), (1, E) or (B, E) by name, E the number of elements with the parameter. Names are
    "term.parameter" (see `Model.set_parameter`), or listed in `ddg_warp.torch.named_parameters`. Controls are dictionaries of "forces"
    (B, P, 3) or (P, 3), "moments" (B, edges), "gravity" and "field" (B, 3) or (3,). Grips take "poses" (B, grips, 6), hinges "angles"
    and "torques" (B, hinges), bodies "wrenches" (B, bodies, 6). "fields" is a dictionary of tensors by name, see `Controls`. A world
    with a value that `set_parameter` would refuse, or with a control that is not finite, is not stepped. The outcome is then
    "invalid_input".

    Raises:
        SceneError: the model has a feature without gradients, once one is requested.
    """

    def __init__(self, model: Model, dt: float, *, scheme: Scheme = "implicit_euler", **options: Option):
        super().__init__()
        check_model("Simulator", model)
        argument_checks.choice("scheme", scheme, SCHEMES)
        self.dt = argument_checks.number("dt", dt, "a time step that is positive and finite [s]", lambda v: v > 0.0)
        for name in SETTLED & options.keys():
            raise SceneError(f"Simulator: {name} is fixed, as outcomes() reports failed worlds; leave it out")
        integrator_names = set(argument_checks.names(Integrator)) - SETTLED - {"model", "scheme"}
        newton_options = {name: value for name, value in options.items() if name not in integrator_names}
        argument_checks.options("Simulator", NewtonOptions, newton_options, integrator_names)
        self.model, self.scheme, self.options = model, scheme, options
        self._engines: dict[int, Engine] = {}
        self._last: Engine | torch.Tensor | None = None  # source of the outcomes of the last step
        self._warned = False

    def engine(self, worlds: int) -> Engine:
        """Return the engine for a number of worlds, with the current parameters of the model; made at the first request."""
        engine = self._engines.get(worlds)
        if engine is None:
            with alone(self):
                if worlds not in self._engines:
                    self._engines[worlds] = Engine(self.model, worlds, self.scheme, self.options)
                engine = self._engines[worlds]
        engine.follow(self.model)
        return engine

    @property
    def device(self) -> torch.device:
        """Device of the tensors of states."""
        return torch.device(str(wp.device_to_torch(self.model.wp_device)))

    def to(self, *arguments: object, **options: object) -> "Simulator":
        """Return the simulator itself, on the device and with the dtype of the model; see `torch.nn.Module.to`.

        Raises:
            SceneError: another device or dtype is given; the message has the calls that build there.
        """
        require_same("a simulator", self.model, arguments, options, "leave this one where it is")
        return self

    def extra_repr(self) -> str:
        """Return scheme, time step and model."""
        return f"{self.scheme}, dt = {self.dt:g} s, {self.model!r}"

    def __getstate__(self):
        return {name: value for name, value in self.__dict__.items() if name != "_lock"} | {
            "_engines": {},
            "_last": None,
        }

    def __deepcopy__(self, memo):
        return type(self)(self.model, self.dt, scheme=self.scheme, **self.options)

    @graph_break
    def initial_state(
        self,
        batch: int | None = None,
        positions: Tensors | None = None,
        velocities: Tensors | None = None,
        body_poses: Tensors | None = None,
        body_rates: Tensors | None = None,
    ) -> WorldState:
        """Return the first state of all worlds, at rest or with given positions and velocities.

        Args:
            batch: worlds; by default the number in the other arguments, else in the model.
            positions, velocities: (P, 3) or (B, P, 3). Gradients go through both. Rest frames are transported by the first step: no
                edge may be further than 90 degrees from there. Strain-rate damping resists the motion from rest within that step;
                `world_state` makes states without it.
            body_poses: rotation and position of rigid bodies, [R | x], (bodies, 3, 4) or (B, bodies, 3, 4), as of
                `WorldState.body_poses`. Nodes that bodies carry follow. Gradients are along rotations.
            body_rates: velocity of the centre and angular velocity (bodies, 6) or (B, bodies, 6), by default the rates of the scene.

        Raises:
            SceneError: shapes do not fit, or surfaces in contact overlap (under transforms of torch, reported by steps).
        """
        moved = {"positions": positions, "velocities": velocities, "body_poses": body_poses, "body_rates": body_rates}
        for name, values in moved.items():
            if not (
                values is None or isinstance(values, torch.Tensor) or np.isfinite(argument_checks.floats(values)).all()
            ):
                raise SceneError(f"initial_state: {name} are {argument_checks.shown(values)}; give finite numbers")
        moved = {name: self._tensor(name, values) for name, values in moved.items() if values is not None}
        one = {"body_poses": 3}  # axes without worlds; others have two
        batch_sizes = [len(values) for name, values in moved.items() if values.ndim > one.get(name, 2)]
        worlds = batch_sizes[0] if batch_sizes else self.model.worlds
        worlds = worlds if batch is None else argument_checks.count("batch", batch)
        engine = self.engine(worlds)
        values = [tensor.clone() for tensor in tensors(engine.model.state(), engine.fields)]
        for name, arrays in (("positions", ("x", "q")), ("velocities", ("v", "v"))):
            if name in moved:
                values = engine.layout.put_points(values, *arrays, moved[name])
        if "body_poses" in moved or "body_rates" in moved:
            values = engine.layout.bodies.put(values, moved.get("body_poses"), moved.get("body_rates"))
        engine.check(values)
        return WorldState.begun(values, 0.0, engine)

    def world_state(self, state: State | WorldState) -> WorldState:
        """Convert a `State`, such as `model.state(points, velocities)` or a checkpoint, to a start state; gradients begin there.

        Unlike in `initial_state`, frames and the last strains of damping are taken from the state, not from rest. A `WorldState` that
        was loaded (`torch.load`, pickle), or that belongs to another simulator of the same scene, is bound to this one.

        Raises:
            SceneError: the state has another model or number of worlds, surfaces in contact overlap, or the state was given spins
                and `gyroscopic` is not set.
        """
        if isinstance(state, WorldState):
            return self._bound(state)
        check_state("world_state", self.model, state)
        if "gyroscopic" not in self.options:
            refuse_gyroscopic("world_state", state.spun)
        engine = self.engine(self.model.worlds)
        values = copies(tensors(state, engine.fields))
        engine.check(values)
        return WorldState.begun(values, state.time, engine)

    def _bound(self, state: WorldState) -> WorldState:
        """Return a `WorldState` from elsewhere bound to this simulator."""
        engine = self.engine(len(state.codes))
        wanted = tensors(engine.before, engine.fields)
        if [tuple(value.shape) for value in wanted] != [tuple(value.shape) for value in state.values]:
            raise SceneError(
                "world_state: the state is of another model: its arrays have other shapes than those of this simulator; give one of "
                "the same scene"
            )
        values = [value.detach().to(like) for value, like in zip(state.values, wanted, strict=True)]
        engine.check(values)
        codes = state.codes.to(engine.device)
        return WorldState(tuple(values), state.time, engine, codes, torch.ones_like(codes, dtype=torch.bool))

    @graph_break
    def step(
        self, state: WorldState, parameters: Parameters | None = None, controls: Inputs | None = None
    ) -> WorldState:
        """Return the state after a step of dt.

        Raises:
            SceneError: a name or shape does not fit, or a shell has a curved membrane, which only equilibria support.
        """
        engine = self._own(state)
        return self._step(state, self._full(engine, parameters), self._controls(engine, controls))

    forward = step

    @graph_break
    def wrenches(
        self,
        before: WorldState,
        after: WorldState,
        parameters: Parameters | None = None,
        controls: Inputs | None = None,
    ) -> WrenchTensors:
        """Return the wrenches of supports and grips in the step from `before` to `after`, with gradients by all arguments.

        Gradients by `after` continue through the step, whose parameters and controls must be given. See `Integrator.watch_wrenches` for
        the meaning of wrenches. Worlds whose step was split into substeps have other ones.

        Raises:
            SceneError: the scheme is the midpoint rule. The model has several friction iterations, or follower loads on supports. A
                parameter is of contact or of drag of shells. A name or shape does not fit.
        """
        engine = self._own(after)
        if self._own(before) is not engine:
            raise SceneError("wrenches: the states have different numbers of worlds")
        if engine.wrenches is None:
            engine.wrenches = Wrenches(engine)
        full, controls = self._full(engine, parameters), self._controls(engine, controls)
        with engine.turn():
            with torch.no_grad():
                engine.tables.write(tuple(name for name, _ in full), [value for _, group in full for value in group])
            return engine.wrenches(before, after, full, controls, self.dt)

    @graph_break
    def rollout(
        self,
        state: WorldState,
        parameters: Parameters | None = None,
        controls: Inputs | Callable[[int], Inputs] | None = None,
        *,
        steps: int,
        save: int = 1,
        checkpoint_every: int | None = None,
        memory: float | None = None,
    ) -> list[WorldState]:
        """Return states after every `save` steps.

        Args:
            controls: of all steps, or a function from step number to controls.
            steps: number of steps.
            save: steps per returned state.
            checkpoint_every: steps per state kept for gradients; a backward pass recomputes the steps between.
            memory: limit of memory for gradients [bytes], from which checkpoints are chosen; see `plan`.

        Returns:
            Trajectory, without the initial state.

        Raises:
            SceneError: a name or shape does not fit, or the memory limit is too small.
        """
        engine = self._own(state)

        def given(number: int) -> dict:
            return self._controls(engine, controls(number) if callable(controls) else controls)

        argument_checks.count("steps", steps)
        first = given(0)
        every = self._checkpoint_plan(state, first, steps, save, checkpoint_every, memory, callable(controls)).every
        full, version = self._full(engine, parameters), self.model.version

        def step(state: WorldState, full: list, controls: dict) -> WorldState:
            return self._step(state, full, controls, version)

        return roll(step, state, full, lambda number: given(number) if number else first, steps, save, every)

    def plan(
        self,
        state: WorldState,
        controls: Inputs | Callable[[int], Inputs] | None = None,
        *,
        steps: int,
        save: int = 1,
        checkpoint_every: int | None = None,
        memory: float | None = None,
    ) -> Plan:
        """Return the checkpointing plan of a roll-out; arguments as of `rollout`.

        A function of controls is called once, for the first step.
        """
        several = callable(controls)
        first = self._controls(self._own(state), controls(0) if several else controls)
        return self._checkpoint_plan(
            state, first, argument_checks.count("steps", steps), save, checkpoint_every, memory, several
        )

    def _checkpoint_plan(
        self, state: WorldState, controls: dict, steps: int, save: int, every, memory, several: bool
    ) -> Plan:
        """Return the plan; `several` is True if each step has controls of its own, which are all kept."""
        if argument_checks.count("save", save) > steps:
            raise SceneError(f"rollout: save = {save} of {steps} steps returns no state; give {steps} at most")
        if every is not None:
            argument_checks.count("checkpoint_every", every)
        if memory is not None:
            argument_checks.number("memory", memory, "bytes, more than none", lambda value: value > 0.0)
        flags = sum(len(part.islands) for part in state.engine.integrator._parts) * state.values[0].element_size()
        other_bytes = flags + 5 * len(state.codes) + sum(values.capacity for values in state.engine.solutions)
        shared = bytes_of(controls.values())
        return plan(
            bytes_of(state.values) + other_bytes, steps * shared if several else shared, steps, save, every, memory
        )

    @graph_break
    def equilibrium(
        self,
        parameters: Parameters | None = None,
        controls: Inputs | None = None,
        *,
        state: WorldState | None = None,
        batch: int | None = None,
        **options: Option,
    ) -> WorldState:
        """Return the equilibrium of every world, with gradients by parameters and controls.

        Twist angles are measured from frames transported along the search path. Their gradients assume a search that starts in
        the equilibrium; positions do not depend on the path. With friction, gradients go through all increments of the load
        parameter, and their states are kept.

        Args:
            parameters: as of `step`.
            controls: as of `step`. The load parameter scales loads as in the scene; poses are reached at its end.
            state: start of the search; by default the first state of `batch` worlds.
            options: as of `ddg_warp.statics.solve`.

        Raises:
            SolverError: no equilibrium was found in one of the worlds.
            SceneError: the state has a gradient history, which would end here; a name or shape does not fit.
        """
        solver_options = {name: value for name, value in options.items() if name not in LOAD}
        argument_checks.options("Simulator.equilibrium", statics.StaticsOptions, solver_options, LOAD)
        if state is not None and torch.is_grad_enabled() and any(value.requires_grad for value in state.values):
            raise SceneError(
                "equilibrium: no gradient goes to the initial state of the search, which sets positions of supports; give "
                "state.detach()"
            )
        if (
            state is not None
            and batch is not None
            and argument_checks.count("batch", batch) != self._own(state).model.worlds
        ):
            raise SceneError(f"equilibrium: batch = {batch} of a state of {len(state.codes)} worlds; leave batch out")
        state = state if state is not None else self.initial_state(batch)
        engine, end = self._own(state), argument_checks.number("end", options.get("end", 1.0))
        full, controls = self._full(engine, parameters), self._controls(engine, controls)
        call = self._call(engine, end, full, controls)
        values = [*(value for _, group in full for value in group), *controls.values()]
        results = Balance.apply(call, tuple(options.items()), *(value.detach() for value in state.values), *values)
        return WorldState.begun(results[: len(engine.fields)], end, engine)

    def outcomes(self) -> Names:
        """Return outcomes of the last step of every world in the batch stepped last (B,); see `WorldState.outcomes`.

        Raises:
            SceneError: no step was made yet.
        """
        if self._last is None:
            raise SceneError("outcomes: no step was made yet; step or roll out first")
        return outcome_names(self._last.codes if isinstance(self._last, Engine) else self._last)

    def parameter(self, name: str, batch: int | None = None) -> torch.Tensor:
        """Return the values of a parameter in the model (B, E)."""
        worlds = self.model.worlds if batch is None else argument_checks.count("batch", batch)
        return self.engine(worlds).tables.value(name)

    def _full(self, engine: Engine, parameters: dict | None) -> list:
        """Return parameters as `ParameterTensors.full`; only plain numbers are checked, since tensors may still be in computation."""
        result = []
        for name, values in _named("parameters", "term.parameter", parameters).items():
            engine.tables.of(name)  # refuses unknown names
            if isinstance(values, torch.Tensor):
                result.append((name, engine.tables.full_of(name, self._tensor(f"parameters: {name}", values))))
                continue
            try:
                values = engine.tables.valid(name, values)
            except ValueError as error:
                raise SceneError(f"parameters: {error}") from None
            result.append((name, engine.tables.full(name, self._tensor(f"parameters: {name}", values), True)))
        return result

    def _tensor(self, name: str, values) -> torch.Tensor:
        """Return numbers as a tensor, by default in the precision of states."""
        if isinstance(values, torch.Tensor):
            if values.layout != torch.strided or values.is_meta or values.is_complex() or values.dtype == torch.bool:
                kind = "meta" if values.is_meta else str(values.layout).removeprefix("torch.")
                raise SceneError(f"{name} is a {kind} tensor of {values.dtype}; give a dense one of real numbers")
            return values
        return torch.as_tensor(
            argument_checks.array(name, values, "give numbers or a tensor"),
            dtype=wp.dtype_to_torch(self.model.types.real),
        )

    def _own(self, state: WorldState) -> Engine:
        """Return the engine of a state of this simulator."""
        if not isinstance(state, WorldState) or state.engine not in self._engines.values():
            origin = "loaded, or another simulator's" if isinstance(state, WorldState) else f"{state!r:.80}"
            raise SceneError(
                f"the state is {origin}; take one that initial_state, step or equilibrium of this one gave, or that world_state(...) "
                "makes of it"
            )
        return self.engine(state.engine.model.worlds)

    def _controls(self, engine: Engine, controls: dict | None) -> dict:
        model, worlds = engine.model, engine.model.worlds
        controls = _named("controls", "forces", controls)
        real = wp.dtype_to_torch(model.types.real)
        result, shape_of = self._fields(engine, controls.pop("fields", None)), shapes(model)
        for name, values in controls.items():
            if name not in shape_of:
                raise SceneError(f"controls: there is no {name!r}; there are {', '.join(shape_of)} and fields")
            tensor, shape = self._tensor(f"controls: {name}", values), shape_of[name]
            if tuple(tensor.shape) not in (shape, (worlds, *shape)):
                raise SceneError(
                    f"controls: {name} have shape {tuple(tensor.shape)}; they are {shape} or {(worlds, *shape)}"
                )
            require_acting(model, (name,))
            if not isinstance(values, torch.Tensor):  # check that values are finite and act on existing dofs
                Controls(**{name: tensor.cpu().numpy()}).checked(model)
            result[name] = tensor.to(device=str(wp.device_to_torch(model.wp_device)), dtype=real).expand(worlds, *shape)
        return result

    def _fields(self, engine: Engine, values) -> dict:
        """Return tensors (worlds, elements) of fields, with keys as of `ddg_warp.torch.controls.FIELD`."""
        model, result = engine.model, {}
        for name, each in _named("controls: fields", "muscle", values).items():
            item, label = named_field(model, name), f"controls: fields: '{name}'"
            if not isinstance(each, torch.Tensor):
                item.given(each)  # check that values are finite
            tensor = self._tensor(label, each)
            tensor = tensor.reshape(item.flat(label, tensor.shape))
            real = wp.dtype_to_torch(model.types.real)
            result[FIELD + name] = tensor.to(device=engine.device, dtype=real).expand(engine.model.worlds, item.size)
        return result

    def _step(self, state: WorldState, full: list, controls: dict, version: int | None = None) -> WorldState:
        """Make a step; `version` is that of the model at the start of a roll-out."""
        engine = state.engine
        call = self._call(engine, state.time, full, controls)
        if version is not None:
            call = replace(call, version=version)
            call.engine_as_then()
        values = [value for _, group in full for value in group]
        results = Step.apply(call, *state.values, *values, *controls.values())
        count, codes = len(engine.fields), results[len(engine.fields) + engine.parts]
        self._last = engine if torch._C._are_functorch_transforms_active() else codes
        self._tell(engine)
        differentiable = state.differentiable & (codes == 0) if call.graded else state.differentiable
        return WorldState(tuple(results[:count]), state.time + self.dt, engine, codes, differentiable)

    def _tell(self, engine: Engine) -> None:
        """Warn once if worlds have no gradient."""
        if engine.lost and not self._warned:
            self._warned = True
            warnings.warn(
                "worlds have no gradient through a step that failed, was taken in substeps or rotated edges by more than 90 "
                "degrees, or whose reverse was not solved: their gradients are not numbers; leave these worlds out by "
                "state.differentiable (outcomes() names their outcomes), or take shorter steps",
                GradientWarning,
                stacklevel=4,
            )

    def _call(self, engine: Engine, start: float, full: list, controls: dict) -> Call:
        return Call(
            simulator=self,
            worlds=engine.model.worlds,
            version=self.model.version,
            start=start,
            dt=self.dt,
            fields=tuple(engine.fields),
            parameters=tuple(name for name, _ in full),
            controls=tuple(controls),
            graded=torch.is_grad_enabled(),
        )


def _named(label: str, example: str, values) -> dict:
    """Return a dictionary by names; empty for None."""
    if not (values is None or (isinstance(values, Mapping) and all(isinstance(name, str) for name in values))):
        raise SceneError(f"{label} are {argument_checks.shown(values)}; give a dictionary such as {{{example!r}: ...}}")
    return dict(values or {})
